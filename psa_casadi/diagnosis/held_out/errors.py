"""Errors of base and extended model in training and held-out samples, and the gain between them."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy import special

from psa_casadi.diagnosis.noise.colour import rms, uncertain
from psa_casadi.diagnosis.result import Errors, Gain
from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.records.split import Experiment

FloatArray = npt.NDArray[np.float64]

#: Held-out records from which on they give the gain's interval; else so many blocks of them do.
_FEWEST, _BLOCKS = 4, 8


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


def whole_residuals(
    experiments: Sequence[Experiment], predicted: Sequence[FloatArray]
) -> list[FloatArray]:
    """Return measured minus predicted [m] of every record, nan where nothing was measured."""
    return [measured(e.record) - y for e, y in zip(experiments, predicted, strict=True)]


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


def explained_share(
    experiments: Sequence[Experiment],
    before: Sequence[FloatArray],
    after: Sequence[FloatArray],
    floor: float,
) -> float:
    """Share of the excess power that the predictions `after` remove from those `before`, 0 to 1.

    Judged by what is left in the held-out samples, against the excess there or that over the whole
    records, whichever is larger: what an effect does in a few blocks of one record may be little by
    chance. What the noise's own power is uncertain by is no excess.
    """
    errors = np.concatenate(whole_residuals(experiments, before))
    valid = errors[np.isfinite(errors)]
    noise = floor**2 * (1.0 + uncertain(valid))
    powers = (float(np.mean(valid**2)), held_out_rms(experiments, before) ** 2)
    excess = max(powers) - noise
    left = held_out_rms(experiments, after) ** 2 - noise
    return float(np.clip(1.0 - left / excess, 0.0, 1.0)) if excess > 0 else float(left <= 0)


def gain_of(
    experiments: Sequence[Experiment],
    base: Sequence[FloatArray],
    extended: Sequence[FloatArray],
) -> Gain:
    """Return the reduction of the held-out rms, with a jackknife interval of the errors' ratio.

    With L the logarithm of the ratio over all parts and L_i that without part i of k, the interval
    is L +- t_(k-1) sqrt((k-1)/k sum (L_i - mean)^2) (Efron and Tibshirani 1993, chapter 11). The
    parts are the held-out experiments where there are at least four, else eight blocks of the
    held-out samples.
    """
    before = held_out_residuals(experiments, base)
    after = held_out_residuals(experiments, extended)
    pairs = [(b, a) for b, a in zip(before, after, strict=True) if len(b)]
    records = len(pairs) if len(pairs) >= _FEWEST else 0
    if not records:
        pairs = [
            (b, a)
            for whole_b, whole_a in pairs
            for b, a in zip(
                np.array_split(whole_b, _BLOCKS), np.array_split(whole_a, _BLOCKS), strict=True
            )
            if len(b)
        ]
    sums = np.array([[float(b @ b), float(a @ a)] for b, a in pairs]).reshape(-1, 2)
    centre = _log_ratio(np.sum(sums, axis=0))
    half, k = 0.0, len(sums)
    if k > 1:
        without = np.array([_log_ratio(np.sum(np.delete(sums, i, 0), axis=0)) for i in range(k)])
        spread = float(np.sqrt((k - 1) * np.var(without)))
        half = float(special.stdtrit(k - 1, 0.975)) * spread
    low, high = (100.0 * (1.0 - float(np.exp(centre + side * half))) for side in (1.0, -1.0))
    return Gain(100.0 * (1.0 - float(np.exp(centre))), (low, high), records)


def _log_ratio(sums: FloatArray) -> float:
    """Logarithm of the errors' ratio [-], from their sums of squares before and after [m^2]."""
    before, after = (max(float(s), 1e-300) for s in sums)
    return 0.5 * float(np.log(after / before))
