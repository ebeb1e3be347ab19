"""Errors of base and extended model in training and held-out samples, and the gain between them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from psa_casadi.diagnosis.colour import rms
from psa_casadi.diagnosis.held_out.parts import FEWEST_RECORDS, jackknife, parts_of
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.fitting.further import predicted_further
from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.records.split import Experiment

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Errors:
    """Errors of one model [m], in training and held-out samples; percent of the measured range."""

    train_rms_m: float
    holdout_rms_m: float
    holdout_max_m: float
    holdout_nrmse_percent: float


@dataclass(frozen=True)
class Gain:
    """Reduction of the held-out rms by the extended model [%], with a 95 % interval.

    `held_out_records` is the number of records that the interval is taken over, 0 where it is
    blocks of fewer ones: then it speaks for their voltages only.
    """

    holdout_rms_reduction_percent: float
    interval: tuple[float, float]
    held_out_records: int = 0


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


def held_out_further(fit: Fit, experiments: Sequence[Experiment]) -> tuple[float, ...]:
    """Return the root mean square errors of the further columns over all held-out samples.

    In their SI units; those of the fitted samples where none is held out. Raises PsaError.
    """
    found = []
    theta = fit.placed(experiments)
    for f in fit.further:
        shown = predicted_further(fit.model, experiments, fit.unknowns, theta, f, way=fit.way)
        parts = [
            (getattr(experiments[k].record, f.column) - x)[experiments[k].held_out]
            for k, x in shown.items()
        ]
        held = np.concatenate(parts)
        found.append(rms(held) if held.size else f.rms)
    return tuple(found)


def output_gain(samples: float, before: float, after: float, straight: float = 0.0) -> float:
    """Return m ln(E0 / E): what held-out samples of one output give a model over another one.

    `samples` are m, counted as those of white noise; E0 and E the rms errors `before` and `after`,
    each with what cannot be told of the output, `straight`, in the output's unit.
    """
    old, new = (max(float(np.hypot(e, straight)), 1e-300) for e in (before, after))
    return samples * float(np.log(old / new))


def whole_residuals(
    experiments: Sequence[Experiment], predicted: Sequence[FloatArray]
) -> list[FloatArray]:
    """Return measured minus predicted [m] of every record, nan where nothing was measured."""
    return [measured(e.record) - y for e, y in zip(experiments, predicted, strict=True)]


def errors_of(experiments: Sequence[Experiment], predicted: Sequence[FloatArray]) -> Errors:
    """Return the errors of a model's predictions of whole records.

    A record whose displacement rests counts over the largest range of all.
    """
    largest = max(e.record.range_m for e in experiments)
    train = np.concatenate(
        [(measured(e.record) - y)[e.used] for e, y in zip(experiments, predicted, strict=True)]
    )
    held = np.concatenate(held_out_residuals(experiments, predicted))
    squares = shares = 0.0
    for e, part in zip(experiments, held_out_residuals(experiments, predicted), strict=True):
        squares += float(np.sum((part / (e.record.range_m or largest)) ** 2))
        shares += len(part)
    if not len(held):
        held = train
        squares, shares = float(np.mean(train**2)) / largest**2, 1.0
    return Errors(
        train_rms_m=rms(train),
        holdout_rms_m=rms(held),
        holdout_max_m=float(np.max(np.abs(held))),
        holdout_nrmse_percent=100.0 * float(np.sqrt(squares / shares)),
    )


def held_out_parts(
    experiments: Sequence[Experiment], *predicted: Sequence[FloatArray]
) -> tuple[FloatArray, npt.NDArray[np.int64]]:
    """Return sums of squares (parts, models) [m^2] and sample counts (parts,) of held-out parts.

    The parts are those of `psa_casadi.diagnosis.held_out.parts`.
    """
    sums, counts = parts_of(*(held_out_columns(experiments, p) for p in predicted))
    return sums[:, :, 0], counts[:, 0]


def held_out_columns(
    experiments: Sequence[Experiment], predicted: Sequence[FloatArray]
) -> list[FloatArray]:
    """Return `held_out_residuals` as columns (n, 1): the displacement is the one output."""
    return [r[:, None] for r in held_out_residuals(experiments, predicted)]


def gain_of(
    experiments: Sequence[Experiment],
    base: Sequence[FloatArray],
    extended: Sequence[FloatArray],
) -> Gain:
    """Return the reduction of the held-out rms, with a jackknife interval of the errors' ratio.

    The interval is that of the ratio's logarithm over the parts of `held_out_parts`.
    """
    sums, counts = held_out_parts(experiments, base, extended)
    records = sum(bool(len(r)) for r in held_out_residuals(experiments, base))

    def of(kept: npt.NDArray[np.bool_]) -> float:
        return _log_ratio(np.sum(sums[kept], axis=0))

    centre, half = jackknife(of, np.ones(len(counts), dtype=bool))
    low, high = (100.0 * (1.0 - float(np.exp(centre + side * half))) for side in (1.0, -1.0))
    told = len(counts) if records >= FEWEST_RECORDS else 0
    return Gain(100.0 * (1.0 - float(np.exp(centre))), (low, high), told)


def lost_elsewhere(
    experiments: Sequence[Experiment],
    base: Sequence[FloatArray],
    extended: Sequence[FloatArray],
    inflation: float,
) -> float:
    """Return what held-out samples lose, but for the part that gains most [nats].

    That is m ln(E/E_0) over the other parts of `held_out_parts`: m their samples over the noise's
    `inflation`, E_0 and E the errors' rms. Infinite where there is only one part.
    """
    sums, counts = held_out_parts(experiments, base, extended)
    if len(sums) < 2:
        return np.inf
    others = np.arange(len(sums)) != int(np.argmax(sums[:, 0] - sums[:, 1]))
    return float(counts[others].sum()) / inflation * _log_ratio(np.sum(sums[others], axis=0))


def _log_ratio(sums: FloatArray) -> float:
    """Logarithm of the errors' ratio [-], from their sums of squares before and after [m^2]."""
    before, after = (max(float(s), 1e-300) for s in sums)
    return 0.5 * float(np.log(after / before))
