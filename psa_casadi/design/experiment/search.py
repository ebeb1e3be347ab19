"""The search for the best inputs: many drawn waveforms, the best of them improved by SLSQP."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy

from psa_casadi.common.errors import PsaError
from psa_casadi.common.progress import Progress, silent
from psa_casadi.common.units import FloatArray
from psa_casadi.design.experiment.criteria import Criterion, Point, SensorNoise
from psa_casadi.design.experiment.limits import KINDS, Drive, Kind, Limits, draw
from psa_casadi.diagnosis.colour import Colour
from psa_casadi.records.signals import Signals
from psa_casadi.simulation.side_by_side import one_thread_of_algebra, side_by_side
from psa_casadi.simulation.stepper import SimulationError

#: Makes a planned record: its name, instants (n,) [s], inputs (n,) by name.
Make = Callable[[str, FloatArray, Mapping[str, FloatArray]], Signals]

#: Samples of the grid on which inputs are compared, at most, and a cycle's samples on it.
GRID, _CYCLE = 500, 8
#: Samples of the grid on which the result is judged, at most.
FINE = 2000
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


#: A search that takes a few seconds: enough where any good voltage separates.
BRIEF = Effort(draws=6, starts=1, steps=5)


@dataclass(frozen=True)
class Plan:
    """What a search may do: limits of every input, noise of every output, the usual records.

    `limits` have `rate` as the steepest change; `make` makes a record.
    """

    limits: Mapping[str, Limits]
    noise: tuple[SensorNoise, ...]
    make: Make
    usual: Mapping[str, Signals]

    @property
    def whole(self) -> Limits:
        """Limits of which duration and samples count."""
        return next(iter(self.limits.values()))

    def colours(self, most: int) -> tuple[Colour, ...]:
        """Return the noise of every output on a grid of at most this many samples."""
        return tuple(n.on_grid(self.whole, min(self.whole.samples, most)) for n in self.noise)

    def coarse(self, record: Signals, most: int = FINE) -> Signals:
        """Return a record on a grid of at most this many samples."""
        samples = min(self.whole.samples, most)
        if record.n <= samples:
            return record
        spacing = record.sample_time * record.n / samples
        time: FloatArray = spacing * np.arange(samples, dtype=np.float64)
        inputs = {n: np.interp(time, record.time, c) for n, c in record.columns.items()}
        return self.make(record.name, time, inputs)


@dataclass(frozen=True, eq=False)
class Best:
    """The best record in full, its family, and values and gradients it took."""

    record: Signals
    kind: str
    evaluations: int


@one_thread_of_algebra()
def search(
    criterion: Criterion,
    plan: Plan,
    *,
    kinds: Sequence[Kind] = KINDS,
    effort: Effort | None = None,
    enough: Callable[[Signals], bool] = lambda _: False,
    progress: Progress = silent,
) -> Best:
    """Draw waveforms of the families, improve the best ones, return the best of all.

    A usual record that is better than all is returned in place of them. Once the best record, on
    the comparison's grid, is `enough`, nothing is improved any more.

    Gradients are exact in the trajectories' derivatives by delta and differences by the waveform's
    coordinates, evaluated side by side. Raises SimulationError where no waveform can be simulated.
    """
    effort = effort or Effort()
    problem, rng = _Problem(criterion, plan), np.random.default_rng(effort.seed)
    # no faster than the grid of the comparison can show
    band = len(problem.time) / plan.whole.duration / _CYCLE
    slower = {n: replace(each, bandwidth=min(each.band, band)) for n, each in plan.limits.items()}
    pool = [
        Drive(kind, {n: draw(kind, item, item.rate, rng) for n, item in slower.items()})
        for kind in kinds
        for _ in range(effort.draws)
    ]
    progress(f"comparing {len(pool)} inputs")
    values = np.array(side_by_side(lambda d: problem.of(problem.record(d, d.start)).value, pool))
    order = np.argsort(values)[::-1]
    if values[order[0]] <= _POOR:
        raise SimulationError(
            "None of the drawn inputs could be simulated with the models; parameter values far"
            " from physical ones are the likely cause: check them."
        )
    best, winner, better = values[order[0]], (pool[order[0]], pool[order[0]].start), True
    for number, k in enumerate(order[: effort.starts]):
        if better and enough(problem.record(*winner)):
            break
        progress(f"improving {number + 1} of {effort.starts}: {pool[k].kind}")
        p, value = problem.improve(pool[k], effort.steps)
        better = value > best
        if better:
            best, winner = value, (pool[k], p)
    record = replace(problem.record(*winner, plan.whole.grid()), name="designed")
    kind = str(winner[0].kind)
    for other in plan.usual.values():
        value = problem.of(plan.coarse(other, GRID)).value
        if value > best:
            best, record, kind = value, other, other.name
    return Best(record, kind, problem.evaluations)


@dataclass
class _Problem:
    """The criterion as a function of a drive's coordinates, with its gradient."""

    criterion: Criterion
    plan: Plan
    evaluations: int = 0
    time: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        self.time = self.plan.whole.grid(min(self.plan.whole.samples, GRID))

    def record(self, drive: Drive, p: FloatArray, time: FloatArray | None = None) -> Signals:
        """Return the planned record on the grid, or at instants [s]."""
        at = self.time if time is None else time
        columns = drive.columns(p, at)
        ends = {n: (each.low, each.high) for n, each in self.plan.limits.items()}
        return self.plan.make(drive.kind, at, {n: np.clip(c, *ends[n]) for n, c in columns.items()})

    def of(self, record: Signals) -> Point:
        """Return the criterion at a record; a poor value where the models cannot follow."""
        self.evaluations += 1
        try:
            return self.criterion.at(record)
        except PsaError:
            return Point(_POOR, lambda _: 0.0)

    def gradient(self, drive: Drive, p: FloatArray, point: Point) -> FloatArray:
        """Return d value / d p (k,) by steps of the frozen function, into the bounds."""
        self.evaluations += 1
        steps = np.full(len(p), _STEP)
        steps = np.where(p + steps > drive.bounds[1], -steps, steps)
        here = point.frozen(self.record(drive, p))

        def along(k: int) -> float:
            moved = p.copy()
            moved[k] += steps[k]
            try:
                return (point.frozen(self.record(drive, moved)) - here) / float(steps[k])
            except PsaError:
                return 0.0

        return np.array(side_by_side(along, range(len(p))))

    def improve(self, drive: Drive, steps: int) -> tuple[FloatArray, float]:
        """Return the best allowed coordinates that SLSQP comes to, and their value."""
        points: dict[bytes, Point] = {}
        best = (drive.start, -np.inf)

        def at(p: FloatArray) -> Point:
            nonlocal best
            key = p.tobytes()
            if key not in points:
                points[key] = self.of(self.record(drive, np.clip(p, *drive.bounds)))
                if points[key].value > best[1] and np.all(drive.slack(p) >= -1e-9):
                    best = (np.clip(p, *drive.bounds), points[key].value)
            return points[key]

        def cost(p: FloatArray) -> float:
            return -at(p).value

        def slope(p: FloatArray) -> FloatArray:
            return np.asarray(-self.gradient(drive, p, at(p)))

        constraints: Any = []
        if drive.slack(drive.start).size > 0:
            constraints = [scipy.optimize.NonlinearConstraint(drive.slack, 0.0, np.inf)]
        scipy.optimize.minimize(
            cost,
            drive.start,
            jac=slope,
            method="SLSQP",
            bounds=scipy.optimize.Bounds(*drive.bounds),
            constraints=constraints,
            options={"maxiter": steps, "ftol": 1e-3},
        )
        return best
