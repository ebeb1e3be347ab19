"""Profile likelihood: how the best fit worsens as one parameter is held away from its estimate."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from psa_casadi.errors import InputError
from psa_casadi.identification.certainty.profile_fits import HeldFits, Point, Progress
from psa_casadi.identification.determinacy import covariance_of, weighted_rows
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.model.compose import Model
from psa_casadi.records.split import Experiment
from psa_casadi.units import FloatArray, convert

#: The 95 % quantile of chi-square with one degree of freedom.
PROFILE_LIMIT = 3.841458820694124


@dataclass(frozen=True, eq=False)
class Profile:
    """The profile likelihood of one parameter, all other unknowns fitted anew at every value.

    `values` (points,) ascend, in `unit`; `increase` (points,) is that of the cost over its minimum,
    in units of the residuals' variance: `PROFILE_LIMIT` bounds the 95 % interval [`low`, `high`].
    An end is None where the increase stays below the limit up to `bounds`, or as far as the model
    can be simulated. `standard_error` is the one of the linearised fit, for comparison; `log` says
    that the parameter is searched on a logarithmic scale.
    """

    name: str
    unit: str
    display_unit: str
    log: bool
    bounds: tuple[float, float]
    estimate: float
    standard_error: float
    values: FloatArray
    increase: FloatArray
    low: float | None
    high: float | None


def profile(
    fit: Fit,
    experiments: Sequence[Experiment],
    name: str,
    *,
    points: int = 10,
    progress: Progress = lambda _: None,
) -> Profile:
    """Return the profile likelihood of a free parameter of a fit, with up to `points` on each side.

    The parameter is held on a grid that grows outwards until the limit is crossed; every point is
    fitted from its neighbours. The limit on the cost is 3.84 times the ratio of the parameter's
    variance (`covariance_of`, residuals as they are) to that of white residuals at the level that
    weighted them, so that a quadratic cost gives the linearised interval. The parameter's own
    weak prior does not count. Raises InputError for a parameter that was not free.

    Source: Murphy and van der Vaart 2000 (profile likelihood); Chandler and Bate 2007 (its vertical
    adjustment for residuals that are not independent).
    """
    if name not in fit.unknowns.names:
        raise InputError(
            [
                f"'{name}' was not searched in this fit, so it has no profile; choose one of"
                f" {', '.join(fit.unknowns.names)}."
            ]
        )
    spread, ratio = _spread(fit, experiments, name)
    held = HeldFits(fit, experiments, name, ratio * PROFILE_LIMIT, progress)
    centre = held.minimum(held.coordinate(held.estimate), [])
    if centre is None:
        raise InputError([f"The fit cannot be simulated where it ended; fit again before '{name}'"])
    first = held.first_step(spread)
    sides = [held.side(centre, sign * first, points) for sign in (-1.0, 1.0)]
    return _profile(fit.model, held, spread, [*sides[0][::-1], centre, *sides[1]])


def _profile(model: Model, held: HeldFits, spread: float, points: Sequence[Point]) -> Profile:
    z = np.array([p.z for p in points])
    cost = np.array([p.cost for p in points])
    level: FloatArray = np.sqrt((cost - cost.min()) / held.limit)
    least = int(np.argmin(cost))
    ends = [
        _crossing(z[: least + 1][::-1], level[: least + 1][::-1]),
        _crossing(z[least:], level[least:]),
    ]
    low, high = (None if end is None else held.value(end) for end in ends)
    parameter = model.parameter(held.name)
    return Profile(
        name=held.name,
        unit=parameter.unit,
        display_unit=parameter.display_unit or parameter.unit,
        log=held.log,
        bounds=parameter.bounds,
        estimate=held.estimate,
        standard_error=spread,
        values=np.array([held.value(float(q)) for q in z]),
        increase=PROFILE_LIMIT * level**2,
        low=low,
        high=high,
    )


def _crossing(z: FloatArray, level: FloatArray) -> float | None:
    """Return where the level first reaches 1 outwards, linear between points; None if it never."""
    beyond = np.flatnonzero(level >= 1.0)
    if not len(beyond):
        return None
    last = int(beyond[0])
    inner, outer = level[last - 1], level[last]
    return float(z[last - 1] + (1.0 - inner) / (outer - inner) * (z[last] - z[last - 1]))


def _spread(fit: Fit, experiments: Sequence[Experiment], name: str) -> tuple[float, float]:
    """Return a parameter's standard error, and its variance over that at white residuals."""
    unknowns = fit.unknowns
    count = len(unknowns.names)
    gradient = np.zeros(unknowns.size)
    gradient[:count] = unknowns.slopes(fit.theta)[unknowns.names.index(name)]
    curvature = np.diag(1.0 / unknowns.prior**2)
    variance, samples = 0.0, 0
    for scaled, residuals in weighted_rows(fit, experiments):
        curvature += scaled.T @ scaled
        variance += float(np.sum(residuals**2))
        samples += len(residuals)
    white = float(gradient @ np.linalg.pinv(curvature, hermitian=True) @ gradient)
    found = max(float(gradient @ covariance_of(fit, experiments) @ gradient), 1e-12 * white)
    # a parameter that the prior holds has no ratio of its own: the residuals' variance stands in
    return float(np.sqrt(found)), max(found / white, variance / samples)


def profile_sentences(p: Profile) -> tuple[str, ...]:
    """Return a profile in words: its interval with open ends, and what is odd about it."""
    low, high = (None if end is None else _shown(p, end) for end in (p.low, p.high))
    if low and high:
        text = f"{p.name} lies between {low} and {high}"
    elif low:
        text = f"{p.name} is above {low}; nothing bounds it from above"
    elif high:
        text = f"{p.name} is below {high}; nothing bounds it from below"
    else:
        text = f"{p.name} is not determined: values from {_span(p)} fit as well as"
        return (f"{text} {_shown(p, p.estimate)} (profile likelihood, 95 %).",)
    sentences = [f"{text} (profile likelihood, 95 %); the estimate is {_shown(p, p.estimate)}."]
    at_estimate = float(np.interp(p.estimate, p.values, p.increase))
    if at_estimate > 0.1 * PROFILE_LIMIT:
        best = _shown(p, float(p.values[np.argmin(p.increase)]))
        sentences.append(
            f"The fit had not reached its minimum: with {p.name} = {best} the cost is lower by"
            f" {at_estimate:.2g} (limit {PROFILE_LIMIT:.3g}); start a fit from there."
        )
    return tuple(sentences)


def _span(p: Profile) -> str:
    return f"{_shown(p, float(p.values[0]))} to {_shown(p, float(p.values[-1]))}"


def _shown(p: Profile, value: float) -> str:
    number = f"{convert(value, p.unit, p.display_unit):.4g}"
    return number if p.unit == "1" else f"{number} {p.display_unit}"
