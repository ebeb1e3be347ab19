"""Many sets of parameters under one record: `psa.simulate_many`, and others on a part of the work.

All integrate the full stack from the same states under a voltage that is linear between its
samples. A method runs at the loosest tolerance of one list at which it is as accurate as asked; the
error is against the reference, which shares no code with any of them.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from importlib import import_module
from importlib.util import find_spec
from math import inf
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt
from scipy.integrate import solve_ivp

from psa_casadi.errors import InputError
from psa_casadi.model.compose import Model
from psa_casadi.model.stacks import stack_model
from psa_casadi.records import Record, multisine, time_grid
from psa_casadi.reference import from_samples, simulate
from psa_casadi.report.words.phrases import number
from psa_casadi.report.words.tables import Table
from psa_casadi.simulation import device
from psa_casadi.simulation.many import simulate_many
from psa_casadi.simulation.side_by_side import threads
from psa_casadi.simulation.start import start_on
from tests.studies.benchmarks.identify import rates
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable, table_of

#: Sets on the GPU for each one on the cores, and those whose ranges are compared.
MORE, _COMPARED = 100, 64


def on_gpu(
    progress: Progress,
    model: Model,
    records: Sequence[tuple[Record, float]],
    draw: Callable[[int], list[dict[str, float]]],
    count: int,
) -> tuple[tuple[TitledTable, ...], str]:
    """Return a table of `count` drawn sets under records with their tolerances, or why not."""
    try:
        cupy = device.device_module()
    except InputError as error:
        return (), f" No rows of a GPU: {error}"
    sets, rows = draw(count), []
    columns = {name: np.array([values[name] for values in sets]) for name in sets[0]}
    for record, rtol in records:
        progress(f"{record.name}: GPU, {count} sets")
        keep = partial(simulate_many, model, record=record, rtol=rtol, reduce="range")
        ours = keep(sets[:_COMPARED])
        keep(sets[:_COMPARED], device="cuda")  # compiles
        begin = time.perf_counter()
        found = keep(columns, device="cuda")
        wall = time.perf_counter() - begin
        apart = np.max(np.abs(found[: len(ours)] - ours) / ours)
        figures = (
            f"{rtol:.0e}",
            f"{apart:.1e}",
            number(wall),
            number(1e9 * wall / count / record.n),
        )
        rows.append((record.name, str(count), str(record.n), *figures))
    name = cupy.cuda.runtime.getDeviceProperties(cupy.cuda.Device().id)["name"].decode()
    head = (
        "voltage", "sets", "samples", "tolerance", "largest difference of a range from the cores'",
        "wall [s]", "ns per sample and set",
    )  # fmt: skip
    note = (
        f"One set a thread of {name}; of each set the range is kept, on the device. The starts of"
        " the sets are in the times, compiling is not."
    )
    return (TitledTable("Many sets on a GPU", Table(head, tuple(rows)), note),), ""


FloatArray = npt.NDArray[np.float64]

#: Runs all sets of a work: displacements (sets, n) [m]; not finite where one cannot be integrated.
Solve = Callable[[], FloatArray]
#: Makes the run at a tolerance.
At = Callable[[float], Solve]


@dataclass(frozen=True)
class Work:
    """Models (sets of one structure) under a voltage (n,) [V] at regular times (n,) [s] from 0."""

    models: tuple[Model, ...]
    times: FloatArray
    voltage: FloatArray

    @property
    def step(self) -> float:
        """Return the sample time [s]."""
        return float(self.times[-1]) / (len(self.times) - 1)

    @property
    def scale(self) -> FloatArray:
        """Return the states' usual sizes (nx,)."""
        return self.models[0].state_nominals()

    @cached_property
    def starts(self) -> FloatArray:
        """Return the initial states (sets, nx)."""
        u = np.column_stack([self.voltage, np.zeros_like(self.voltage)])
        return np.array([start_on(m, self.times, u).x for m in self.models])

    def first(self, count: int) -> "Work":
        """Return the same of the first sets alone."""
        return Work(self.models[:count], self.times, self.voltage)

    def reference(self, rtol: float) -> FloatArray:
        """Return the displacements (sets, n) [m] of the independent reference: LSODA, restarted at
        every sample and every reversal."""
        names, given = self.models[0].state_names, from_samples(self.times, self.voltage)
        marks = list(self.times)
        rows = [
            simulate(
                m.values, given, self.times, initial=dict(zip(names, x0, strict=True)),
                breakpoints=marks, rtol=rtol,
            ).displacement
            for m, x0 in zip(self.models, self.starts, strict=True)
        ]  # fmt: skip
        return np.array(rows)


@dataclass(frozen=True)
class Peer:
    """A way by name: `prepare(work)` and what it returns build and compile, a `Solve` is timed.

    It runs `sets` sets at a time.
    """

    name: str
    prepare: Callable[[Work], At]
    sets: int


def _scipy(work: Work) -> At:
    """LSODA on plain numbers, one set after the other."""
    t, h, scale = work.times, work.step, work.scale
    v, slope = work.voltage.tolist(), (np.diff(work.voltage) / h).tolist()

    def one(model: Model, x0: FloatArray, tolerance: float) -> FloatArray:
        p, last = model.values, len(slope) - 1

        def slopes(now: float, x: FloatArray) -> tuple[float, ...]:
            k = min(int(now / h), last)
            return rates(p, v[k] + (now - k * h) * slope[k], x.tolist(), math)

        how: Any = {"rtol": tolerance, "atol": tolerance * scale}
        found = solve_ivp(slopes, (0.0, t[-1]), x0, "LSODA", t, **how)
        return found.y[5] if found.success else np.full(len(t), np.nan)

    pairs = list(zip(work.models, work.starts, strict=True))
    return lambda tolerance: lambda: np.array([one(m, x, tolerance) for m, x in pairs])


def _cvodes(work: Work) -> At:
    """CVODES with CasADi's exact derivatives, built once for all sets, which are its parameters."""
    s, scale, t = work.models[0].structure, work.scale, ca.MX.sym("t")
    z, p = ca.MX.sym("z", len(scale)), ca.MX.sym("p", s.p.numel())
    slopes = ca.Function("slopes", [s.time, s.x, s.u, s.p], [s.xdot], {"cse": True})
    line = ca.interpolant("line", "linear", [work.times], work.voltage, {"lookup_mode": ["exact"]})
    given = ca.vertcat(line(t), 0.0)
    dae = {"x": z, "p": p, "t": t, "ode": slopes(t, z * scale, given, p) / scale}
    values = [m.parameter_vector() for m in work.models]
    starts, place = work.starts / scale, work.models[0].state_names.index("x")

    def at(tolerance: float) -> Solve:
        options = {"abstol": tolerance, "reltol": tolerance, "max_num_steps": 1_000_000}
        solver = ca.integrator("solver", "cvodes", dae, 0.0, work.times[1:], options)

        def one(x0: FloatArray, p: FloatArray) -> FloatArray:
            found = solver(x0=x0, p=p)["xf"].full()[place]
            return np.asarray(scale[place] * np.concatenate([x0[place : place + 1], found]))

        return lambda: np.array([one(x0, p) for x0, p in zip(starts, values, strict=True)])

    return at


def _diffrax(work: Work) -> At:
    """Kvaerno5 (implicit: the mechanics are stiff), all sets in one `vmap`, compiled by XLA."""
    jax: Any = import_module("jax")
    dfx: Any = import_module("diffrax")
    jax.config.update("jax_enable_x64", True)
    jnp, scale, h = jax.numpy, jax.numpy.asarray(work.scale), work.step
    v, times = jnp.asarray(work.voltage), jnp.asarray(work.times)
    slope, last = jnp.diff(v) / h, len(work.voltage) - 2

    def field(now: Any, z: Any, p: Any) -> Any:
        k = jnp.clip((now / h).astype(int), 0, last)
        return jnp.stack(rates(p, v[k] + (now - k * h) * slope[k], z * scale, jnp)) / scale

    def one(x0: Any, p: Any, tolerance: Any) -> Any:
        return dfx.diffeqsolve(
            dfx.ODETerm(field), dfx.Kvaerno5(), 0.0, times[-1], h, x0 / scale, p,
            saveat=dfx.SaveAt(ts=times, fn=lambda _, z, __: z[5] * scale[5]),
            stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance),
            max_steps=10_000_000, throw=False,
        ).ys  # fmt: skip

    every = {n: jnp.array([m.values[n] for m in work.models]) for n in work.models[0].values}
    starts = jnp.asarray(work.starts)
    many = jax.jit(jax.vmap(one, (0, 0, None))).lower(starts, every, 1.0).compile()
    return lambda tolerance: lambda: np.asarray(many(starts, every, tolerance))


def peers() -> tuple[tuple[Peer, ...], str]:
    """Return the ways that run here, and a sentence on those that do not."""
    always = (
        Peer("scipy solve_ivp, LSODA", _scipy, 4),
        Peer("CVODES through CasADi", _cvodes, 4),
    )
    if find_spec("diffrax") is None:
        return always, " diffrax is not installed: `pip install --group ensembles` adds its row."
    return (*always, Peer("diffrax, vmap, Kvaerno5", _diffrax, 32)), ""


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
    model, rows, doubts, done = stack_model("P-885.51"), list[Row](), [], []
    sets = drawn(model, max(count, *(way.sets for way in ways)))
    for case in given:
        progress(f"{case.name}: reference")
        models = tuple(model.with_values(s) for s in sets[: max(way.sets for way in ways)])
        work = Work(models, case.times[:part], case.voltage[:part])
        truth = work.first(_JUDGED).reference(_TRUTH)
        apart = np.abs(work.first(1).reference(_CHECK)[0] - truth[0])
        doubts.append(float(np.max(apart) / np.ptp(truth[0])))
        progress(f"{case.name}: {OURS}, {count} sets")
        short = Record(name="part", time=work.times, voltage=work.voltage)
        ours = loosest(partial(_judged, model, sets[:_JUDGED], short), truth)
        done.append((case.record, ours.tolerance))
        how: Any = {"rtol": ours.tolerance, "reduce": np.ptp}
        wall, spent = least_times(partial(simulate_many, model, sets[:count], case.record, **how))
        each, size = spent / count / len(case.times), len(case.times)
        rows.append(Row(case.name, OURS, count, size, ours, each, 1.0, wall))
        for way in ways:
            progress(f"{case.name}: {way.name}")
            found = loosest(way.prepare(work.first(way.sets)), truth)
            theirs = least_times(found.solve)[1] / way.sets / part
            rows.append(Row(case.name, way.name, way.sets, part, found, theirs, theirs / each))
    gpu, missing = on_gpu(progress, model, done, partial(drawn, model), MORE * count)
    start: dict[str, Callable[[Row], str]] = {"voltage": lambda r: r.case}
    whole = table_of(
        "Many sets of parameters of a full stack",
        [r for r in rows if r.way == OURS],
        start
        | {
            "sets": lambda r: str(r.sets),
            "samples": lambda r: str(r.samples),
            "tolerance": lambda r: f"{r.reached.tolerance:.0e}",
            "largest error / range": lambda r: number(r.reached.error, 2),
            "wall [s]": lambda r: number(r.wall),
            "processor [s]": lambda r: number(r.each * r.sets * r.samples),
            "ns per sample and set": lambda r: number(1e9 * r.each),
        },
        f"Threads: {threads()}. Of each set the range is kept. The starts of the sets are in the"
        f" times, compiling is not. The error is the largest of {_JUDGED} sets over {part} samples,"
        " against the reference at 1e-11, which differs from that at 1e-10 by"
        f" {number(max(doubts), 2)}.{missing}",
    )
    beside = table_of(
        "Others on a part of the work, at equal error",
        rows,
        start
        | {
            "way": lambda r: r.way,
            "sets x samples": lambda r: f"{r.sets} x {r.samples}",
            "tolerance": lambda r: f"{r.reached.tolerance:.0e}",
            "largest error / range": lambda r: (
                number(r.reached.error, 2) + ("" if r.reached.accurate else " (missed)")
            ),
            "us per sample and set": lambda r: number(1e6 * r.each),
            "over simulate_many": lambda r: number(r.over, 2),
        },
        "Every way has the loosest of the tolerances 1e-3, 3e-4, 1e-4, ... at which its error is"
        f" below {WANTED:.0e} of the range. Times are processor time over all threads, building and"
        " compiling left out. CVODES runs CasADi's virtual machine; LSODA calls Python." + absent,
    )
    return Outcome((whole, *gpu, beside))


def _judged(model: Model, sets: Sequence[dict[str, float]], record: Record, rtol: float) -> Solve:
    return lambda: simulate_many(model, sets, record, rtol=rtol)


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


@dataclass(frozen=True)
class Row:
    """What a way did of a case: sets, samples, seconds of a sample and set, and over ours."""

    case: str
    way: str
    sets: int
    samples: int
    reached: "Reached"
    each: float
    over: float
    wall: float = 0.0


def least_times(solve: Solve) -> tuple[float, float]:
    """Return the least wall and processor time of a run [s] over repeats; a slow run has one."""
    least = [inf, inf]
    for _ in range(_REPEATS):
        wall, spent = time.perf_counter(), time.process_time()
        solve()
        now = time.perf_counter() - wall, time.process_time() - spent
        least = [min(pair) for pair in zip(least, now, strict=True)]
        if least[1] > _SLOW:
            break
    return least[0], least[1]
