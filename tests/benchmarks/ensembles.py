"""Many sets of parameters under one record: `psa.simulate_many`, and others on a part of the work.

All integrate the full stack from the same states under a voltage that is linear between its
samples. A method runs at the loosest tolerance of one list at which it is as accurate as asked; the
error is against the reference, which shares no code with any of them.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from math import inf

import numpy as np
import numpy.typing as npt

from psa_casadi.model.compose import Model
from psa_casadi.model.stacks import stack_model
from psa_casadi.records import Record, multisine, time_grid
from psa_casadi.report.words.phrases import number
from psa_casadi.report.words.tables import Table
from psa_casadi.simulation.many import simulate_many
from psa_casadi.simulation.side_by_side import threads
from tests.benchmarks.ensembles_gpu import MORE, on_gpu
from tests.benchmarks.ensembles_peers import At, Peer, Solve, Work, peers
from tests.benchmarks.outcome import Outcome, Progress, TitledTable

FloatArray = npt.NDArray[np.float64]

SETS, QUICK, SAMPLES, SAMPLE_TIME = 10_000, 200, 10_000, 2e-4
#: Error over the range that is asked for, and the tolerances of which the loosest is taken.
WANTED, TOLERANCES = 1e-5, tuple(10.0 ** (-k / 2) for k in range(6, 21))
OURS = "psa.simulate_many"
#: Parameters that differ between the sets, each by 10 %.
_FREE = ("k_L", "A", "beta", "gamma", "tau", "R_s", "k_B", "m_B")
#: What peers run of the work: so many samples; the error is that of so many sets.
_PART, _JUDGED = 500, 3
_TRUTH, _CHECK = 1e-11, 1e-10
_REPEATS, _SLOW = 3, 2.0


@dataclass(frozen=True)
class Case:
    """A voltage (n,) [V] at regular times (n,) [s]."""

    name: str
    times: FloatArray
    voltage: FloatArray

    @property
    def record(self) -> Record:
        """Return it as a record."""
        return Record(name=self.name, time=self.times, voltage=self.voltage)


@dataclass(frozen=True)
class Reached:
    """The loosest tolerance at which a way is accurate, its error over the range, its run.

    `tolerance` and `error` are those of the tightest one where none is accurate enough.
    """

    tolerance: float
    error: float
    solve: Solve

    @property
    def accurate(self) -> bool:
        """Return whether the error is as small as asked."""
        return self.error <= WANTED


def run(progress: Progress, quick: bool) -> Outcome:
    """Measure the usual number of sets."""
    return run_sized(progress, QUICK if quick else SETS)


def run_sized(progress: Progress, count: int) -> Outcome:
    """Measure `count` sets of 10^4 samples."""
    ways, absent = peers()
    return measured(progress, cases(SAMPLES), count, _PART, ways, absent)


def cases(samples: int) -> tuple[Case, ...]:
    """Return a slow sine, of which a sample is one step, and a multisine that turns often."""
    t = time_grid(samples * SAMPLE_TIME, SAMPLE_TIME)[:samples]
    part = multisine(t[:_PART], 0.0, 100.0, (10.0, 250.0), seed=1)
    return (
        Case("sine of 10 Hz", t, 50.0 - 50.0 * np.cos(20.0 * np.pi * t)),
        Case("multisine to 250 Hz", t, np.resize(part, samples)),
    )


def measured(
    progress: Progress, given: Sequence[Case], count: int, part: int, ways: Sequence[Peer],
    absent: str = "",
) -> Outcome:  # fmt: skip
    """Measure all sets of each case by `simulate_many`, and `part` samples of it by the others.

    Where there is a GPU, it runs 100 times as many.
    """
    model, whole, beside, doubts, done = stack_model("P-885.51"), [], [], [], []
    sets = drawn(model, max(count, *(way.sets for way in ways)))
    for case in given:
        progress(f"{case.name}: reference")
        models = tuple(model.with_values(s) for s in sets[: max(way.sets for way in ways)])
        work = Work(models, case.times[:part], case.voltage[:part])
        truth = work.first(_JUDGED).reference(_TRUTH)
        apart = np.abs(work.first(1).reference(_CHECK)[0] - truth[0])
        doubts.append(float(np.max(apart) / np.ptp(truth[0])))
        progress(f"{case.name}: {OURS}, {count} sets")
        ours = loosest(partial(_of_many, model, sets, work), truth)
        done.append((case.record, ours.tolerance))
        wall, spent = _whole(model, sets[:count], case.record, ours.tolerance)
        each = spent / count / len(case.times)
        whole.append((
            case.name, str(count), str(len(case.times)), f"{ours.tolerance:.0e}",
            number(ours.error, 2), number(wall), number(spent), number(1e9 * each),
        ))  # fmt: skip
        beside.append(_row(case, OURS, count, len(case.times), ours, each, each))
        for way in ways:
            progress(f"{case.name}: {way.name}")
            found = loosest(way.prepare(work.first(way.sets)), truth)
            theirs = least_time(found.solve) / way.sets / part
            beside.append(_row(case, way.name, way.sets, part, found, theirs, each))
    gpu, missing = on_gpu(progress, model, done, partial(drawn, model), MORE * count)
    return Outcome((
        TitledTable("Many sets of parameters of a full stack", Table(_HEAD, tuple(whole)),
                    _NOTE.format(threads(), _JUDGED, part, number(max(doubts), 2)) + missing),
        *gpu,
        TitledTable("Others on a part of the work, at equal error",
                    Table(_BESIDE, tuple(beside)), _BESIDE_NOTE.format(WANTED) + absent),
    ))  # fmt: skip


def drawn(model: Model, count: int) -> list[dict[str, float]]:
    """Return sets of parameters around a model's; the first are the same for any count."""
    rng = np.random.default_rng(5)
    return [
        {n: model.values[n] * float(np.exp(0.1 * rng.standard_normal())) for n in _FREE}
        for _ in range(count)
    ]


def loosest(at: At, truth: FloatArray) -> Reached:
    """Return the loosest tolerance at which the error of the sets in `truth` (m, n) is accepted."""
    size = np.ptp(truth, axis=1)[:, None]
    for tolerance in TOLERANCES:
        solve = at(tolerance)
        error = np.max(np.abs(solve()[: len(truth)] - truth) / size)
        found = Reached(tolerance, float(error) if np.isfinite(error) else inf, solve)
        if found.accurate:
            break
    return found


def least_time(solve: Solve) -> float:
    """Return the least processor time of a run [s] over repeats, of which a slow run has one."""
    least = inf
    for _ in range(_REPEATS):
        begin = time.process_time()
        solve()
        least = min(least, time.process_time() - begin)
        if least > _SLOW:
            break
    return least


def _of_many(model: Model, sets: Sequence[dict[str, float]], work: Work, tolerance: float) -> Solve:
    """Return the run of the judged sets by `simulate_many`."""
    record = Record(name="part", time=work.times, voltage=work.voltage)
    return lambda: simulate_many(model, sets[:_JUDGED], record, rtol=tolerance)


def _whole(
    model: Model, sets: Sequence[dict[str, float]], record: Record, tolerance: float
) -> tuple[float, float]:
    """Return the least wall and processor time [s] of all sets; the range of each is kept.

    A slow run is not repeated.
    """
    least = [inf, inf]
    for _ in range(_REPEATS):
        wall, spent = time.perf_counter(), time.process_time()
        simulate_many(model, sets, record, rtol=tolerance, reduce=np.ptp)
        now = time.perf_counter() - wall, time.process_time() - spent
        least = [min(pair) for pair in zip(least, now, strict=True)]
        if least[1] > _SLOW:
            break
    return least[0], least[1]


def _row(
    case: Case, name: str, sets: int, samples: int, reached: Reached, each: float, ours: float
) -> tuple[str, ...]:  # fmt: skip
    error = number(reached.error, 2) + ("" if reached.accurate else " (missed)")
    return (
        case.name, name, f"{sets} x {samples}", f"{reached.tolerance:.0e}", error,
        number(1e6 * each), number(each / ours, 2),
    )  # fmt: skip


_HEAD = (
    "voltage", "sets", "samples", "tolerance", "largest error / range", "wall [s]",
    "processor [s]", "ns per sample and set",
)  # fmt: skip
_NOTE = (
    "Threads: {}. Of each set the range is kept. The starts of the sets are in the times,"
    " compiling is not. The error is the largest of {} sets"
    " over {} samples, against the reference at 1e-11, which differs from that at 1e-10 by {}."
)
_BESIDE = (
    "voltage", "way", "sets x samples", "tolerance", "largest error / range",
    "us per sample and set", "over simulate_many",
)  # fmt: skip
_BESIDE_NOTE = (
    "Every way has the loosest of the tolerances 1e-3, 3e-4, 1e-4, ... at which its error is below"
    " {:.0e} of the range. Times are processor time over all threads, building and compiling left"
    " out. CVODES runs CasADi's virtual machine; LSODA calls Python."
)
