"""The search for the best voltage: many drawn waveforms, the best of them improved by SLSQP."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from psa_casadi.design.experiment.criteria import Criterion, Point
from psa_casadi.design.experiment.limits import KINDS, Kind, Limits, Waveform, draw
from psa_casadi.errors import PsaError
from psa_casadi.records.record import Record
from psa_casadi.simulation.side_by_side import one_thread_of_algebra, side_by_side
from psa_casadi.simulation.stepper import SimulationError
from psa_casadi.units import FloatArray

Progress = Callable[[str], None]

#: Samples of the grid on which voltages are compared, at most, and a cycle's samples on it.
GRID, _CYCLE = 500, 8
#: Step of the gradient by a coordinate, of which 1 is a whole range.
_STEP = 1e-3
_POOR = -1e3


@dataclass(frozen=True)
class Effort:
    """How long to search: waveforms drawn of each family, how many improved (most), steps."""

    draws: int = 6
    starts: int = 2
    steps: int = 10
    seed: int = 1


#: A search that takes a few seconds: enough where any good voltage tells.
BRIEF = Effort(draws=6, starts=1, steps=5)


@dataclass(frozen=True, eq=False)
class Best:
    """The best voltage found: its record in full, its family, and values and gradients it took."""

    record: Record
    kind: str
    evaluations: int


@one_thread_of_algebra()
def search(
    criterion: Criterion,
    limits: Limits,
    steepest: float,
    *,
    usual: Sequence[Record] = (),
    kinds: Sequence[Kind] = KINDS,
    effort: Effort | None = None,
    enough: Callable[[Record], bool] = lambda _: False,
    progress: Progress = lambda _: None,
) -> Best:
    """Draw waveforms of the families, improve the best ones, return the best of all.

    A `usual` record within the limits that is better than all of them is returned in their place.
    Once the best record, on the comparison's grid, is `enough`, nothing is improved any more.

    Gradients are exact in the trajectories' derivatives by delta and differences by the waveform's
    coordinates, evaluated side by side. Raises SimulationError where no waveform can be simulated.
    """
    effort = effort or Effort()
    problem, rng = _Problem(criterion, limits), np.random.default_rng(effort.seed)
    # no faster than the grid of the comparison can show
    rate = min(limits.samples, GRID) / limits.duration
    slower = replace(limits, bandwidth=min(limits.band, rate / _CYCLE))
    pool = [draw(kind, slower, steepest, rng) for kind in kinds for _ in range(effort.draws)]
    progress(f"comparing {len(pool)} voltages")
    values = np.array(side_by_side(lambda w: problem.point(w, w.start).value, pool))
    order = np.argsort(values)[::-1]
    if values[order[0]] <= _POOR:
        raise SimulationError(
            "None of the drawn voltages could be simulated with the models; parameter values far"
            " from physical ones are the likely cause: check them."
        )
    best, found, better = values[order[0]], (pool[order[0]], pool[order[0]].start), True
    for number, k in enumerate(order[: effort.starts]):
        if better and enough(problem.record(*found)):
            break
        progress(f"improving {number + 1} of {effort.starts}: {pool[k].kind}")
        p, value = problem.improve(pool[k], effort.steps)
        better = value > best
        if better:
            best, found = value, (pool[k], p)
    record = replace(problem.record(*found, limits.grid()), name="designed")
    kind = str(found[0].kind)
    for other in usual:
        value = problem.of(coarse(other, len(problem.time))).value
        if value > best:
            best, record, kind = value, other, other.name
    return Best(record, kind, problem.evaluations)


def coarse(record: Record, samples: int) -> Record:
    """Return a record on a grid of at most so many samples."""
    if record.n <= samples:
        return record
    spacing = record.sample_time * record.n / samples
    time: FloatArray = spacing * np.arange(samples, dtype=np.float64)
    return Record(name=record.name, time=time, voltage=np.interp(time, record.time, record.voltage))


class _Problem:
    """The criterion as a function of a waveform's coordinates, with its gradient."""

    def __init__(self, criterion: Criterion, limits: Limits) -> None:
        self._criterion, self._limits = criterion, limits
        self.time = limits.grid(min(limits.samples, GRID))
        self.evaluations = 0

    def record(self, wave: Waveform, p: FloatArray, time: FloatArray | None = None) -> Record:
        """Return the planned record on the grid, or at instants [s]."""
        at = self.time if time is None else time
        voltage = np.clip(wave.voltage(p, at), self._limits.low, self._limits.high)
        return Record(name=wave.kind, time=at, voltage=voltage)

    def point(self, wave: Waveform, p: FloatArray) -> Point:
        """Return the criterion at p."""
        return self.of(self.record(wave, p))

    def of(self, record: Record) -> Point:
        """Return the criterion at a record; a poor value where the models cannot follow."""
        self.evaluations += 1
        try:
            return self._criterion.at(record)
        except PsaError:
            return Point(_POOR, lambda _: 0.0)

    def gradient(self, wave: Waveform, p: FloatArray, point: Point) -> FloatArray:
        """Return d value / d p (k,) by steps of the frozen function, into the bounds."""
        self.evaluations += 1
        steps = np.full(len(p), _STEP)
        steps = np.where(p + steps > wave.upper, -steps, steps)
        here = point.frozen(self.record(wave, p))

        def along(k: int) -> float:
            moved = p.copy()
            moved[k] += steps[k]
            try:
                return (point.frozen(self.record(wave, moved)) - here) / float(steps[k])
            except PsaError:
                return 0.0

        return np.array(side_by_side(along, range(len(p))))

    def improve(self, wave: Waveform, steps: int) -> tuple[FloatArray, float]:
        """Return the best allowed coordinates that SLSQP comes to, and their value."""
        points: dict[bytes, Point] = {}
        best = (wave.start, -np.inf)

        def at(p: FloatArray) -> Point:
            nonlocal best
            key = p.tobytes()
            if key not in points:
                points[key] = self.point(wave, np.clip(p, wave.lower, wave.upper))
                if points[key].value > best[1] and np.all(wave.slack(p) >= -1e-9):
                    best = (np.clip(p, wave.lower, wave.upper), points[key].value)
            return points[key]

        def cost(p: FloatArray) -> float:
            return -at(p).value

        def slope(p: FloatArray) -> FloatArray:
            downhill: FloatArray = -self.gradient(wave, p, at(p))
            return downhill

        constraints: Any = []
        if wave.slack(wave.start).size > 0:
            constraints = [scipy.optimize.NonlinearConstraint(wave.slack, 0.0, np.inf)]
        scipy.optimize.minimize(
            cost,
            wave.start,
            jac=slope,
            method="SLSQP",
            bounds=scipy.optimize.Bounds(wave.lower, wave.upper),
            constraints=constraints,
            options={"maxiter": steps, "ftol": 1e-3},
        )
        return best
