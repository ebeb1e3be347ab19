"""Does the displacement follow the voltage at all, with this sign and in this unit?"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from psa_casadi.diagnosis.base_fit.variants import from_resonances
from psa_casadi.diagnosis.task import shows_ringing
from psa_casadi.diagnosis.thresholds import thresholds
from psa_casadi.errors import PsaError
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.identification.refitting import Progress
from psa_casadi.identification.search import fit_base
from psa_casadi.identification.start.doubts import (
    correlation,
    doubtful_quantity,
    doubtful_time,
    doubtful_unit,
    doubtful_voltage,
)
from psa_casadi.model.compose import Model
from psa_casadi.records.split import Experiment

FloatArray = npt.NDArray[np.float64]

#: A voltage with less of its variance about a parabola over time is not told from a drift.
_TREND = 0.05
#: Samples that a linear filter of the voltage looks back, and that it needs for each of them.
_TAPS, _EACH = 128, 8


_FILTERED = (
    "A linear filter of the voltage explains {:.0f} % of the displacement's variance, the base"
    " model {:.0f} %: the two belong together, but with dynamics that the base model does not have"
    " (several resonances, a delay, perhaps the other sign). No causes were sought."
)


@dataclass(frozen=True)
class Driven:
    """Whether a displacement follows the voltage, and what of sign and unit is wrong, in words.

    `filtered` says that it does not follow by the base model, but by another linear one.
    """

    follows: bool
    notes: tuple[str, ...]
    filtered: bool = False


def driven(
    base: Fit, model: Model, experiments: Sequence[Experiment], progress: Progress
) -> Driven:
    """Return whether the `base` fit explains the displacement; else what the other sign explains.

    `model` is where the base fit started.
    """
    if shows_ringing(experiments) and explained(base, experiments) < thresholds().follows:
        base = from_resonances(base, experiments, progress) or base
    share = explained(base, experiments)
    records = [e.record for e in experiments]
    doubts = (doubtful_unit, doubtful_voltage, doubtful_time, doubtful_quantity)
    notes = tuple(s for doubt in doubts if (s := doubt(records)))
    if share >= thresholds().follows and correlation(records) > thresholds().falling:
        return Driven(follows=True, notes=notes)
    progress("the displacement with its sign flipped")
    other = _flipped(model, experiments)
    if other > max(share, thresholds().follows):
        said = (
            f"With the sign of the displacement flipped the base model explains"
            f" {100 * other:.2f} % of its variance, as given {100 * max(share, 0.0):.2f} %: the"
            " sensor or the voltage is probably connected the other way round.",
        )
        return Driven(follows=False, notes=(*said, *notes))
    if share < thresholds().follows:
        linear = filtered(experiments)
        if linear > thresholds().follows:
            return Driven(
                follows=False,
                notes=(_FILTERED.format(100 * linear, 100 * max(share, 0.0)), *notes),
                filtered=True,
            )
        said = (
            f"The voltage explains {100 * max(share, 0.0):.0f} % of the displacement's variance,"
            " and no more with the other sign: check that both columns are of the same device and"
            " the same time.",
        )
        quantity = doubtful_quantity(records)
        return Driven(follows=False, notes=(*said, quantity) if quantity else said)
    return Driven(follows=True, notes=notes)


def explained(base: Fit, experiments: Sequence[Experiment]) -> float:
    """Share of the displacements' variance that a fit explains over whole records; 1 is all.

    A drift does not count, a parabola over time: a base can make one from its start alone. It does
    where the voltage itself is hardly more than that.
    """
    left = total = 0.0
    for e, y in zip(experiments, base.predicted(experiments), strict=True):
        given = measured(e.record)
        valid = np.isfinite(given)
        time, v = e.record.time[valid], e.record.voltage[valid]
        moving = np.sum(_about_trend(time, v) ** 2) > _TREND * np.sum((v - np.mean(v)) ** 2)
        about = _about_trend if moving else _about_mean
        left += float(np.sum(about(time, (given - y)[valid]) ** 2))
        total += float(np.sum(about(time, given[valid]) ** 2))
    return 1.0 - left / total if total > 0 else 0.0


def _about_mean(_: FloatArray, signal: FloatArray) -> FloatArray:
    found: FloatArray = signal - np.mean(signal)
    return found


def _about_trend(time: FloatArray, signal: FloatArray) -> FloatArray:
    t = (time - time[0]) / max(float(time[-1] - time[0]), 1e-300)
    columns = np.column_stack([np.ones_like(t), t, t**2])
    found: FloatArray = signal - columns @ np.linalg.lstsq(columns, signal, rcond=None)[0]
    return found


def filtered(experiments: Sequence[Experiment]) -> float:
    """Share of the displacements' variance that linear filters of the voltage explain.

    A finite impulse response for each record beside a parabola over time; variances per degree of
    freedom, so that a filter of what has nothing to do with the voltage explains nothing.
    """
    left = total = 0.0
    for e in experiments:
        record, y = e.record, measured(e.record)
        taps = max(1, min(_TAPS, record.n // _EACH))
        past = np.concatenate([np.full(taps - 1, record.voltage[0]), record.voltage])
        lagged = np.lib.stride_tricks.sliding_window_view(past, taps)[record.mask]
        time = record.time[record.mask]
        shown, columns = _about_trend(time, y[record.mask]), _about_trend(time, lagged)
        rest = shown - columns @ np.linalg.lstsq(columns, shown, rcond=None)[0]
        left += record.n * float(np.sum(rest**2)) / max(rest.size - taps - 3, 1)
        total += record.n * float(np.sum(shown**2)) / max(rest.size - 3, 1)
    return 1.0 - left / total if total > 0 else 0.0


def _flipped(model: Model, experiments: Sequence[Experiment]) -> float:
    other = [
        replace(e, record=replace(e.record, displacement=-measured(e.record))) for e in experiments
    ]
    try:
        return explained(fit_base(model, other), other)
    except PsaError:
        return 0.0
