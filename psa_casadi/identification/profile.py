"""Profile likelihood: how the best fit worsens as one parameter is held away from its estimate."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from psa_casadi.common.errors import InputError, PsaError
from psa_casadi.common.progress import Progress, silent
from psa_casadi.common.units import FloatArray
from psa_casadi.identification.determinacy import covariance_of, weighted_rows
from psa_casadi.identification.fitting.fit import Fit, fit
from psa_casadi.model.variables import NORMAL_95

_EVALUATIONS = 40
#: A step out is at most this many times the distance that has been covered.
_GROWTH = 3.0
#: Levels, in roots of the limit, that the next point aims at before and at the crossing.
_BEFORE, _AT = 0.7, 1.08
#: A crossing is interpolated from points whose levels lie no further apart than this.
_FINE = 0.6
#: Each fit ends when a step lowers the cost by less than this share of the limit.
_CLOSE = 3e-3
#: Where a step raised the level by less, the cost levels off: the next step is twice as long.
_FLAT = 0.05
_RETRIES = 3


class _HeldFits:
    """The fits of all other unknowns while one parameter is held; z is its logarithm or itself."""

    def __init__(self, best: Fit, name: str, limit: float, progress: Progress) -> None:
        self.best, self.name, self.limit = best, name, limit
        self._progress, parameter = progress, best.model.parameter(name)
        self.log = parameter.log
        self._tolerance = float(np.clip(_CLOSE * limit / best.cost, 1e-9, 1e-5))
        self._free = [n for n in best.unknowns.names if n != name]
        k = best.unknowns.names.index(name)
        low, high = (float(edge[k]) for edge in (best.unknowns.low, best.unknowns.high))
        self.edges = (self.coordinate(low), self.coordinate(high))

    def coordinate(self, value: float) -> float:
        """Return ln value, or the value itself."""
        return float(np.log(max(value, 1e-300))) if self.log else value

    def value(self, z: float) -> float:
        """Return the value at a coordinate."""
        return float(np.exp(z)) if self.log else z

    def z(self, result: Fit) -> float:
        """Return the coordinate of a fit."""
        return self.coordinate(result.model.values[self.name])

    def minimum(self, z: float, before: Fit) -> Fit | None:
        """Fit all other unknowns at z from the fit before; None if that cannot be simulated."""
        low, high = before.model.parameter(self.name).bounds
        value = float(np.clip(self.value(z), low, high))
        self._progress(f"profile of {self.name}, {value:.4g}")
        try:
            result = fit(
                self.best.model.with_values({self.name: value}), self.best.experiments, self._free,
                sigma=self.best.sigma, start={n: before.model.values[n] for n in self._free},
                start_states=before.starts(), evaluations=_EVALUATIONS,
                tolerance=self._tolerance,
            )  # fmt: skip
        except PsaError:
            return None
        if result.interrupted:
            raise KeyboardInterrupt
        return result

    def side(self, centre: Fit, step: float, points: int) -> list[Fit]:
        """Return fits outwards from the centre until the limit is crossed or a bound is met."""
        result, failures = [centre], 0
        edge = self.edges[1] if step > 0 else self.edges[0]
        while len(result) <= points and failures < _RETRIES:
            last = result[-1]
            here = self.z(last)
            outside = (here + step - edge) * step > 0
            z = edge if outside else here + step
            if abs(z - here) <= 1e-9 * max(abs(z), abs(step)):
                break
            point = self.minimum(z, last)
            if point is None:
                failures, step = failures + 1, 0.3 * step
                continue
            result.append(point)
            level = self._level(point, result)
            if level > 1.0:
                return self._refined(result)[1:]
            distance = abs(z - self.z(centre))  # the next level should be reached by proportion
            aim = _BEFORE if level < 0.5 * _BEFORE else _AT
            flat = len(result) > 2 and level - self._level(last, result) < _FLAT
            least, most = (2.0 if flat else 0.1) * abs(step), _GROWTH * distance
            wanted = distance * (aim / max(level, 1e-9) - 1.0)
            step = float(np.copysign(np.clip(wanted, min(least, most), most), z - self.z(centre)))
        return result[1:]

    def _level(self, point: Fit, fits: Sequence[Fit]) -> float:
        """Return sqrt(increase / limit), which grows in proportion to the distance at first."""
        least = min(p.cost for p in fits)
        return float(np.sqrt(max(point.cost - least, 0.0) / self.limit))

    def _refined(self, fits: list[Fit]) -> list[Fit]:
        """Put points where the limit should be crossed, until those around it are close."""
        outer = fits.pop()
        beyond = [outer]
        for _ in range(_RETRIES):
            inner = fits[-1]
            levels = self._level(inner, fits), self._level(outer, fits)
            if levels[1] - levels[0] <= _FINE:
                break
            # a cost that turns steep all at once would hold an interpolation back at the inside
            share = max((1.0 - levels[0]) / (levels[1] - levels[0]), 0.25)
            here = self.z(inner)
            middle = self.minimum(here + share * (self.z(outer) - here), inner)
            if middle is None:
                break
            if self._level(middle, fits) > 1.0:
                outer = middle
                beyond.insert(0, middle)
            else:
                fits.append(middle)
        return [*fits, *beyond]


#: The 95 % quantile of chi-square with one degree of freedom.
PROFILE_LIMIT = NORMAL_95**2


@dataclass(frozen=True, eq=False)
class Profile:
    """The profile likelihood of one parameter, all other unknowns fitted anew at every value.

    `values` (points,) ascend, in `unit`; `increase` (points,) is that of the cost over its minimum,
    in units of the residuals' variance: `PROFILE_LIMIT` bounds the 95 % interval [`low`, `high`].
    An end is None where the increase stays below the limit up to `bounds`, or as far as the model
    can be simulated. `standard_error` is the one of the linearised fit, for comparison; `log`:
    the parameter is searched on a logarithmic scale.
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


def profile(fit: Fit, name: str, *, points: int = 10, progress: Progress = silent) -> Profile:
    """Return the profile likelihood of a free parameter of a fit, with up to `points` on each side.

    The parameter is held on a grid that grows outwards until the limit is crossed; every point is
    fitted from its neighbours. The limit on the cost is 3.84 times the ratio of the parameter's
    variance (`covariance_of`, residuals as they are) to that of white residuals at the level that
    weighted them, so that a quadratic cost gives the linearised interval. The parameter's
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
    spread, ratio = _spread(fit, name)
    held = _HeldFits(fit, name, ratio * PROFILE_LIMIT, progress)
    parameter, estimate = fit.model.parameter(name), fit.model.values[name]
    centre = held.minimum(held.coordinate(estimate), fit)
    if centre is None:
        raise InputError([f"The fit cannot be simulated where it ended; fit again before '{name}'"])
    ordinary = 1.0 if held.log else abs(float(fit.unknowns.scale[fit.unknowns.names.index(name)]))
    first = spread / estimate if held.log else spread  # one standard error
    first = float(np.clip(first, 1e-6 * ordinary, ordinary))
    below, above = (held.side(centre, sign * first, points) for sign in (-1.0, 1.0))
    fits = [*below[::-1], centre, *above]
    z, cost = (np.array([of(p) for p in fits]) for of in (held.z, lambda p: p.cost))
    level: FloatArray = np.sqrt((cost - cost.min()) / held.limit)
    least = int(np.argmin(cost))
    ends = [
        _crossing(z[: least + 1][::-1], level[: least + 1][::-1]),
        _crossing(z[least:], level[least:]),
    ]
    low, high = (None if end is None else held.value(end) for end in ends)
    return Profile(
        name=name,
        unit=parameter.unit,
        display_unit=parameter.display_unit or parameter.unit,
        log=held.log,
        bounds=parameter.bounds,
        estimate=estimate,
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


def _spread(best: Fit, name: str) -> tuple[float, float]:
    """Return a parameter's standard error, and its variance over that at white residuals."""
    unknowns = best.unknowns
    count = len(unknowns.names)
    gradient = np.zeros(unknowns.size)
    gradient[:count] = unknowns.slopes(best.theta)[unknowns.names.index(name)]
    white, coloured = (
        float(gradient @ covariance_of(best, white=w) @ gradient) for w in (True, False)
    )
    result = max(coloured, 1e-12 * white)
    # a parameter that the prior holds has no ratio: the residuals' variance takes its place
    rows = np.concatenate([residuals for _, residuals in weighted_rows(best)])
    return float(np.sqrt(result)), max(result / white, float(np.mean(rows**2)))
