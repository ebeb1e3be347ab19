"""Errors of base and extended model in training and held-out samples, and the gain between them."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy import stats

from psa_casadi.diagnosis.result import Errors, Gain
from psa_casadi.experiment.split import Experiment
from psa_casadi.identification.prediction import measured

FloatArray = npt.NDArray[np.float64]

_BLOCKS = 8


def held_out_residuals(
    experiments: Sequence[Experiment], predicted: Sequence[FloatArray]
) -> list[FloatArray]:
    """Return measured minus predicted over the held-out samples of every experiment [m]."""
    parts = []
    for e, y in zip(experiments, predicted, strict=True):
        parts.append((measured(e.record) - y)[e.held_out])
    return parts


def held_out_rms(experiments: Sequence[Experiment], predicted: Sequence[FloatArray]) -> float:
    """Return the root mean square over all held-out samples [m]."""
    return rms(np.concatenate(held_out_residuals(experiments, predicted)))


def errors_of(experiments: Sequence[Experiment], predicted: Sequence[FloatArray]) -> Errors:
    """Return the errors of a model's predictions of whole records."""
    train = np.concatenate(
        [(measured(e.record) - y)[e.used] for e, y in zip(experiments, predicted, strict=True)]
    )
    held = np.concatenate(held_out_residuals(experiments, predicted))
    squares = shares = 0.0
    for e, part in zip(experiments, held_out_residuals(experiments, predicted), strict=True):
        squares += float(np.sum((part / e.record.range_m) ** 2))
        shares += len(part)
    if not len(held):
        held = train
        squares, shares = float(np.mean(train**2)) / experiments[0].record.range_m ** 2, 1.0
    return Errors(
        train_rms_m=rms(train),
        holdout_rms_m=rms(held),
        holdout_max_m=float(np.max(np.abs(held))),
        holdout_nrmse_percent=100.0 * float(np.sqrt(squares / shares)),
    )


def gain_of(
    experiments: Sequence[Experiment],
    base: Sequence[FloatArray],
    extended: Sequence[FloatArray],
) -> Gain:
    """Return the reduction of the held-out rms, with a t-interval on the logarithm of the ratio.

    The interval runs over the held-out experiments where there are at least four, else over eight
    blocks of the held-out samples.
    """
    before = held_out_residuals(experiments, base)
    after = held_out_residuals(experiments, extended)
    ratio = rms(np.concatenate(after)) / max(rms(np.concatenate(before)), 1e-300)
    pairs = [(b, a) for b, a in zip(before, after, strict=True) if len(b)]
    if len(pairs) < 4:
        pairs = [
            (b, a)
            for whole_b, whole_a in pairs
            for b, a in zip(
                np.array_split(whole_b, _BLOCKS), np.array_split(whole_a, _BLOCKS), strict=True
            )
            if len(b)
        ]
    logs = np.array([np.log(max(rms(a), 1e-300) / max(rms(b), 1e-300)) for b, a in pairs])
    half = 0.0
    if len(logs) > 1:
        half = float(stats.t.ppf(0.975, len(logs) - 1) * np.std(logs, ddof=1) / np.sqrt(len(logs)))
    centre = float(np.log(ratio))
    return Gain(
        100.0 * (1.0 - ratio),
        (
            100.0 * (1.0 - float(np.exp(centre + half))),
            100.0 * (1.0 - float(np.exp(centre - half))),
        ),
    )


def rms(values: FloatArray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0
