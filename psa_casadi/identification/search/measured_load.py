"""A measured load as an input without its noise: the load as a curve over the displacement.

The noise of an input moves the model, so that a fit prefers whatever explains the displacement
without that input. A load that is a function of the displacement is known better by its curve over
the displacement that a model without it predicts from the voltage: an instrument whose error has
nothing to do with the load cell's (instrumental variables; Fuller, Measurement Error Models 1987).
A straight line is what a stiffer stack does: it tells nothing of the stiffness that it meets.
Where the displacement's sensor bends, that model is bent with it, and the load may be a straighter
curve over what the same model predicts that is fitted to the load itself.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from psa_casadi.identification.search.multistart import fit_base
from psa_casadi.model.compose import Model
from psa_casadi.records.noise import high_frequency_noise
from psa_casadi.records.split import Experiment

FloatArray = npt.NDArray[np.float64]

#: The column, and the highest order of the curve.
LOAD, _ORDER = "load_force", 8
#: The curve stands for the load where it misses no more than its noise, with this margin, and this
#: share of its range.
_NOISE, _SHARE = 1.1, 1e-3


def is_measured(experiments: Sequence[Experiment]) -> bool:
    """Whether the load on the stack is measured in every record."""
    return all(e.record.load_force is not None for e in experiments)


def without_column(experiments: Sequence[Experiment], column: str) -> tuple[Experiment, ...]:
    """Return the experiments as if a column had not been measured."""
    gone: dict[str, Any] = {column: None}
    return tuple(
        replace(
            e,
            record=replace(e.record, **gone),
            further=tuple(q for q in e.further if q.column != column),
        )
        for e in experiments
    )


def loads_as_curves(
    start: Model, experiments: Sequence[Experiment], progress: Callable[[str], None]
) -> tuple[Experiment, ...]:
    """Return the experiments with loads that are curves over the displacement as these curves.

    Of a fit without the load, from `start`. Where all of them are straight lines they are 0: the
    model's stiffness stands for them. Other loads stay as they were measured. Without a load that
    changes nothing is fitted.
    """
    loads = [np.asarray(e.record.load_force, dtype=float) for e in experiments]
    if not is_measured(experiments) or all(np.ptp(load) == 0.0 for load in loads):
        return tuple(experiments)
    progress("base fit without the measured load")
    unloaded = without_column(experiments, LOAD)
    ways = [
        fit_base(start, own, progress=progress).predicted(own)
        for own in (unloaded, tuple(map(_as_displacement, experiments)))
    ]
    curves = [_curve(load, own) for load, *own in zip(loads, *ways, strict=True)]
    straight = all(c is not None and c[1] == 1 for c in curves)
    found = []
    for e, load, own in zip(experiments, loads, curves, strict=True):
        curve = np.zeros(e.record.n) if straight else load if own is None else own[0]
        found.append(replace(e, record=replace(e.record, load_force=curve)))
    return tuple(found)


def _as_displacement(e: Experiment) -> Experiment:
    """Return an experiment whose displacement is its load, to the size and sign of the first."""
    load, y = np.asarray(e.record.load_force), np.asarray(e.record.displacement)
    span = max(float(np.ptp(load)), 1e-300)
    seen = np.isfinite(y)
    sign = np.sign(np.cov(load[seen], y[seen])[0, 1]) or 1.0
    shown = np.where(seen, load * sign * e.record.range_m / span, np.nan)
    return replace(e, record=replace(e.record, displacement=shown, load_force=None), further=())


def _curve(load: FloatArray, ways: Sequence[FloatArray]) -> tuple[FloatArray, int] | None:
    """Return the polynomial that stands for a load (n,) [N], and its order; None if all are far.

    Over one of the displacements x (n,) [m]; of the smallest n ln S + order ln n (Schwarz 1978).
    """
    found = []
    for x in ways:
        middle, half = 0.5 * (float(x.max()) + float(x.min())), 0.5 * float(np.ptp(x))
        powers = np.polynomial.chebyshev.chebvander((x - middle) / max(half, 1e-300), _ORDER)
        for order in range(1, _ORDER + 1):
            columns = powers[:, : order + 1]
            curve = columns @ np.linalg.lstsq(columns, load, rcond=None)[0]
            left = max(float(np.sum((load - curve) ** 2)), 1e-300)
            found.append((load.size * np.log(left) + order * np.log(load.size), order, curve))
    _, order, curve = min(found, key=lambda f: f[0])
    missed = float(np.std(load - curve))
    allowed = np.hypot(_NOISE * high_frequency_noise(load), _SHARE * float(np.ptp(load)))
    return (curve, order) if missed <= allowed else None
