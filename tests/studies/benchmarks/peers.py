"""Speed against others: one fit against SciPy, and many sets of parameters against three solvers.

All integrate the full stack under a voltage that is linear between its samples. The peers are what
one would write without this package: `scipy.integrate.solve_ivp` (LSODA) on the reference's
equations, CVODES through CasADi, diffrax.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from importlib import import_module
from importlib.util import find_spec
from math import inf
from typing import Any
from unittest.mock import patch

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

import psa_casadi as psa
from psa_casadi import reference
from psa_casadi.common.units import FloatArray
from psa_casadi.identification.fitting import fit as fitting
from psa_casadi.records import multisine, time_grid
from psa_casadi.records.split import whole
from psa_casadi.report.words.phrases import number
from psa_casadi.simulation import device
from psa_casadi.simulation.side_by_side import threads
from psa_casadi.simulation.start import start_on
from tests.studies.benchmarks.records import noisy
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable, least_times


def rates(p: Mapping[str, Any], v: Any, state: Sequence[Any], m: Any) -> tuple[Any, ...]:
    """Return the rates of (u, f_H, f_out, y, y', x, x') at the command v [V], paper eqs. (4)-(9).

    `m` has the functions: `math`, or jax.numpy for arrays of sets.
    """
    u, f_H, f_out, y, v_y, x, v_x = state
    du = (p["G"] * v - u) / (p["R_s"] * p["C_p"])
    sign = du / m.sqrt(du * du + p["hold_rate"] ** 2)
    power = (abs(f_H) / p["h_ref"]) ** p["n"]
    bend = du * (p["beta"] * sign * m.copysign(power, f_H) + p["gamma"] * power)
    passed_on = p["c_P"] * v_y + p["k_P"] * y
    pull = p["c_B"] * (v_x - v_y) + p["k_B"] * (x - y)
    return (
        du, p["A"] * du - bend + p["delta"] * u * sign, (p["k_L"] * u + f_H - f_out) / p["tau"],
        v_y, (f_out - passed_on) / p["m_P"], v_x, (passed_on - pull) / p["m_B"],
    )  # fmt: skip


def by_lsoda(
    p: Mapping[str, float], record: psa.Record, start: FloatArray, rtol: float, atol: FloatArray
) -> FloatArray:
    """Return the displacement (n,) [m] by solve_ivp at regular times, nan where it fails."""
    t = record.time - record.time[0]
    v, h = record.voltage.tolist(), float(t[-1]) / (len(t) - 1)
    slope, last = (np.diff(record.voltage) / h).tolist(), len(t) - 2

    def slopes(now: float, x: FloatArray) -> tuple[float, ...]:
        k = min(int(now / h), last)
        return rates(p, v[k] + (now - k * h) * slope[k], x.tolist(), math)

    how: Any = {"rtol": rtol, "atol": atol}
    result = solve_ivp(slopes, (0.0, t[-1]), start, "LSODA", t, **how)
    return np.asarray(result.y[5]) if result.success else np.full(len(t), np.nan)


FREE = ("k_L", "A", "beta", "gamma", "delta", "n", "tau", "R_s", "c_P", "c_B", "m_P")
_STACK, _NOISE, _SAMPLE_TIME = "WYDS0808020", 1e-3, 2e-5
_WRONG = {"k_L": 1.01, "A": 0.98, "beta": 0.98, "gamma": 1.05, "tau": 1.05, "R_s": 1.1}
#: The final cost counts as reached at this factor above the lowest that both of them reach.
_REACHED = 1.001


def identify(progress: Progress, quick: bool) -> Outcome:
    """Measure both on one record.

    Both start at the same point near the truth (from farther away the peer stays in a side valley),
    search the same parameters with the same residuals, and stop when they will.
    """
    tables = [_compared_with_scipy(2000 if quick else 20_000, progress)]
    if find_spec("jax_sysid"):
        tables.append(_compared_with_jax_sysid(500 if quick else 2000, progress))
    else:
        progress("jax-sysid is not installed: `pip install --group jax-sysid` adds its table")
    return Outcome(tables)


def _record(samples: int) -> psa.Record:
    """Return a multisine with noise, simulated by this package, from rest."""
    t, model = time_grid(samples * _SAMPLE_TIME, _SAMPLE_TIME), psa.stack_model(_STACK)
    band = (2.0 / t[-1], max(40.0 / t[-1], 200.0))
    voltage = multisine(t, 0.0, model.values["u_rated"], band, seed=1)
    voltage = voltage * np.minimum(10.0 * t / t[-1], 1.0)
    voltage[:4] = 0.0  # at rest at first, which both take for granted
    x = psa.simulate(model, t, voltage).displacement
    clean = psa.Record(name=f"{samples} samples", time=t, voltage=voltage, displacement=x)
    return noisy(clean, _NOISE * clean.range_m, np.random.default_rng(1))


#: Time [s] and cost of every evaluation.
Trace = list[tuple[float, float]]


def _fitted(record: psa.Record) -> tuple[int, Trace]:
    """Fit a record from the wrong values; return simulations and trace."""
    model, began, trace = psa.stack_model(_STACK), time.process_time(), Trace()
    made: Any = fitting.Objective

    def traced(*arguments: Any) -> Callable[[FloatArray], Any]:
        evaluate = made(*arguments)

        def wrapped(theta: FloatArray) -> Any:
            fit = evaluate(theta)
            if fit is not None:
                trace.append((time.process_time() - began, float(fit[0] @ fit[0])))
            return fit

        return wrapped

    start = {name: factor * model.values[name] for name, factor in _WRONG.items()}
    with patch.object(fitting, "Objective", traced):
        sigma = [_NOISE * record.range_m]
        fit = fitting.fit(model, [whole(record)], FREE, sigma=sigma, start=start)
    return fit.evaluations, trace


def _compared_with_scipy(samples: int, progress: Progress) -> TitledTable:
    record = _record(samples)
    _fitted(record)  # compiles the model once, as on any first use
    runs, ours = _fitted(record)
    progress(f"least_squares with solve_ivp on {samples} samples (minutes)")
    theirs = _scipy(record, _NOISE * record.range_m)
    ways = {"psa_casadi, fit": (runs, ours),
            "scipy, least_squares with solve_ivp": (len(theirs), theirs)}  # fmt: skip
    lowest = [min(c for _, c in trace) for _, trace in ways.values()]
    target = _REACHED * max(lowest)
    spent = [next(t for t, c in trace if c <= target) for _, trace in ways.values()]
    rows = [
        {"who": who, "CPU time to the final cost [s]": f"{t:.3g}", "simulations": n,
         "lowest cost": f"{c:.1f}"}
        for (who, (n, _)), t, c in zip(ways.items(), spent, lowest, strict=True)
    ]  # fmt: skip
    return TitledTable(
        f"One fit of {len(FREE) + 1} parameters to {samples} samples",
        rows,
        f"The fit here takes 1/{spent[1] / spent[0]:.0f} of the time, until each first has the cost"
        f" that both reach. Both search the offset and {', '.join(FREE)} from one start, in one"
        f" process of one run; a cost of {samples} is pure noise. Compiling the model once (cached"
        " afterwards) is not counted.",
    )


def _scipy(record: psa.Record, sigma: float) -> Trace:
    """Return time and cost of every step of least_squares with finite differences."""
    values, y = psa.stack_model(_STACK).values, np.asarray(record.displacement)
    reference = np.array([values[n] for n in FREE])
    positive = np.array([n in ("k_L", "tau", "R_s", "c_P", "c_B", "m_P") for n in FREE])
    stroke = values["k_L"] * values["u_rated"] * (1.0 / values["k_P"] + 1.0 / values["k_B"])
    speed = stroke * (values["k_B"] / values["m_B"]) ** 0.5
    force = values["k_L"] * values["u_rated"]
    atol = 1e-7 * np.array(
        [values["u_rated"], values["h_ref"], force, stroke, speed, stroke, speed]
    )
    began, trace = time.process_time(), Trace()

    def residual(z: FloatArray) -> FloatArray:
        ratios = np.where(positive, np.exp(np.where(positive, z[:-1], 0.0)), z[:-1])
        p = {**values, **dict(zip(FREE, (ratios * reference).tolist(), strict=True))}
        r = (by_lsoda(p, record, np.zeros(7), 1e-7, atol) + z[-1] * sigma - y) / sigma
        trace.append((time.process_time() - began, float(r @ r)))
        return np.asarray(r)

    ratio = np.array([_WRONG.get(n, 1.0) for n in FREE])
    z0 = np.append(np.where(positive, np.log(ratio), ratio), 0.0)
    step: Any = 1e-3  # MINPACK takes a number alone
    least_squares(residual, z0, method="lm", diff_step=step, ftol=1e-5, xtol=1e-6)
    return trace


#: A spring that hardens, over its mass: gain, damping, stiffness, cubic stiffness; a guess of each.
_SPRING = {"b": 2.0, "d": 0.6, "k": 40.0, "c": 3000.0}
_GUESS = {"b": 1.5, "d": 0.8, "k": 30.0, "c": 4000.0}


def _spring(p: Sequence[Any], x: Any, force: Any) -> list[Any]:
    """Return the rates of deflection [m] and speed under a force [N]."""
    b, d, k, c = p
    return [x[1], b * force - d * x[1] - k * x[0] - c * x[0] ** 3]


def _by_identify(t: FloatArray, force: FloatArray, y: FloatArray) -> Mapping[str, float]:
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("force"), ca.SX.sym("p", len(_SPRING))
    rates = _spring(ca.vertsplit(p), x, u)
    model = psa.ode_model(
        {"x": x, "u": u, "p": p, "y": x[0], "ode": ca.vertcat(*rates)},
        name="spring",
        states=[psa.State("x", "m", "deflection"), psa.State("v", "m/s", "speed")],
        outputs=[psa.Output("y", "m", "deflection")],
        inputs=[psa.Input("force", "N", "force")],
        parameters=[
            psa.Parameter(n, v, "1", (v / 100.0, v * 100.0), n, log=True) for n, v in _GUESS.items()
        ],
    )
    return psa.identify(model, {"time": t, "force": force, "y": y}).model.values


def _by_jax_sysid(t: FloatArray, force: FloatArray, y: FloatArray) -> Mapping[str, float]:
    """Fit as its documentation does: Adam, then L-BFGS; Heun's method, a step a sample."""
    jax: Any = import_module("jax")
    models: Any = import_module("jax_sysid.models")
    heun: Any = import_module("diffrax").Heun
    jax.config.update("jax_enable_x64", True)
    jnp, guess, size = jax.numpy, list(_GUESS.values()), float(np.var(y))

    def rates(x: Any, u: Any, now: Any, log_p: Any) -> Any:
        return jnp.stack(
            _spring([g * jnp.exp(q) for g, q in zip(guess, log_p, strict=True)], x, u[0])
        )

    model = models.CTModel(2, 1, 1, state_fcn=rates, output_fcn=lambda x, *_: x[:1])
    model.init(params=[np.zeros(())] * len(guess), x0=np.zeros(2))
    model.integration_options("linear", heun(), dt0=float(t[1]), max_steps=10 * len(t))
    model.loss(lambda own, measured: jnp.sum((own - measured) ** 2) / size, rho_x0=0.0, rho_th=0.0)
    model.optimization(adam_eta=0.01, adam_epochs=500, lbfgs_epochs=500, iprint=-1)
    model.fit(y[:, None], force[:, None], t)
    return {n: g * math.exp(q) for (n, g), q in zip(_GUESS.items(), model.params, strict=True)}


def _compared_with_jax_sysid(samples: int, progress: Progress) -> TitledTable:
    """Fit the spring to a record with 1 % of noise that LSODA simulates."""
    progress(f"jax-sysid on {samples} samples (a minute)")
    t = time_grid(samples * 5e-3, 5e-3)[:samples]
    force, true = multisine(t, -3.0, 3.0, (0.2, 4.0), seed=1), list(_SPRING.values())
    clean = solve_ivp(
        lambda now, x: _spring(true, x, np.interp(now, t, force)), (0.0, t[-1]), [0.0, 0.0],
        "LSODA", t, rtol=1e-9, atol=1e-12, max_step=5e-3,
    ).y[0]  # fmt: skip
    noise = np.random.default_rng(1).standard_normal(samples)
    y, rows = clean + 0.01 * np.ptp(clean) * noise, []
    for way, fit in (("psa.identify", _by_identify), ("jax-sysid, CTModel", _by_jax_sysid)):
        spent = []
        for _ in range(2):
            begin = time.process_time()
            fitted = fit(t, force, y)
            spent.append(time.process_time() - begin)
        rows.append({
            "way": way, "CPU time [s], first": number(spent[0]), "again": number(spent[1]),
            **{f"{n} off": f"{100 * (fitted[n] / v - 1):+.2f} %" for n, v in _SPRING.items()},
        })  # fmt: skip
    return TitledTable(
        f"One fit of four parameters of a hardening spring to {samples} samples, 1 % of noise",
        rows,
        "jax-sysid compiles again for every fit; psa.identify keeps what it has compiled. It also"
        " estimates the initial states, and decides what the force does between samples.",
    )


#: Runs all sets of a work: displacements (sets, n) [m]; not finite where one cannot be integrated.
Solve = Callable[[], FloatArray]
#: Makes the run at a tolerance.
At = Callable[[float], Solve]

SETS, QUICK, SAMPLES, SAMPLE_TIME = 10_000, 200, 10_000, 2e-4
#: Target of the error over the range, and the tolerances of which the loosest is taken.
WANTED, TOLERANCES = 1e-5, tuple(10.0 ** (-k / 2) for k in range(6, 21))
OURS = "psa.simulate_many"
#: Parameters that differ between the sets, each by 10 %.
_DRAWN = ("k_L", "A", "beta", "gamma", "tau", "R_s", "k_B", "m_B")
#: What peers run of the work: number of samples, and number of sets whose error counts.
_PART, _JUDGED = 500, 3
_TRUTH, _CHECK = 1e-11, 1e-10
_REPEATS, _SLOW = 3, 2.0
#: Sets on the GPU for each one on the cores, and those whose ranges are compared.
MORE, _COMPARED = 100, 64


@dataclass(frozen=True)
class Work:
    """Models (sets of one structure) under the voltage of a record at regular times from 0."""

    models: tuple[psa.Model, ...]
    record: psa.Record

    @property
    def scale(self) -> FloatArray:
        """Return the states' usual sizes (nx,)."""
        return self.models[0].state_nominals()

    @cached_property
    def starts(self) -> FloatArray:
        """Return the initial states (sets, nx)."""
        u = np.column_stack([self.record.voltage, np.zeros(self.record.n)])
        return np.array([start_on(m, self.record.time, u).x for m in self.models])

    def first(self, count: int) -> "Work":
        """Return the same of the first sets alone."""
        return Work(self.models[:count], self.record)

    def reference(self, rtol: float) -> FloatArray:
        """Return the displacements (sets, n) [m] of the independent reference: LSODA, restarted at
        every sample and every reversal."""
        times, names = self.record.time, self.models[0].state_names
        inputs, marks = reference.from_samples(times, self.record.voltage), list(times)
        rows = [
            reference.simulate(
                m.values, inputs, times, initial=dict(zip(names, x0, strict=True)),
                breakpoints=marks, rtol=rtol,
            ).displacement
            for m, x0 in zip(self.models, self.starts, strict=True)
        ]  # fmt: skip
        return np.array(rows)


def _lsoda(work: Work) -> At:
    """LSODA on plain numbers, one set after the other."""
    pairs, scale = list(zip(work.models, work.starts, strict=True)), work.scale
    return lambda rtol: (
        lambda: np.array([by_lsoda(m.values, work.record, x, rtol, rtol * scale) for m, x in pairs])
    )


def _cvodes(work: Work) -> At:
    """CVODES with CasADi's exact derivatives, built once for all sets, which are its parameters."""
    s, scale, t = work.models[0].structure, work.scale, ca.MX.sym("t")
    times, voltage = work.record.time, work.record.voltage
    z, p = ca.MX.sym("z", len(scale)), ca.MX.sym("p", s.p.numel())
    slopes = ca.Function("slopes", [s.time, s.x, s.u, s.p], [s.xdot], {"cse": True})
    line = ca.interpolant("line", "linear", [times], voltage, {"lookup_mode": ["exact"]})
    inputs = ca.vertcat(line(t), 0.0)
    dae = {"x": z, "p": p, "t": t, "ode": slopes(t, z * scale, inputs, p) / scale}
    values = [m.parameter_vector() for m in work.models]
    starts, place = work.starts / scale, work.models[0].state_names.index("x")

    def at(tolerance: float) -> Solve:
        options = {"abstol": tolerance, "reltol": tolerance, "max_num_steps": 1_000_000}
        solver = ca.integrator("solver", "cvodes", dae, 0.0, times[1:], options)

        def one(x0: FloatArray, p: FloatArray) -> FloatArray:
            result = solver(x0=x0, p=p)["xf"].full()[place]
            return np.asarray(scale[place] * np.concatenate([x0[place : place + 1], result]))

        return lambda: np.array([one(x0, p) for x0, p in zip(starts, values, strict=True)])

    return at


def _diffrax(work: Work) -> At:
    """Kvaerno5 (implicit: the mechanics are stiff), all sets in one `vmap`, compiled by XLA."""
    jax: Any = import_module("jax")
    dfx: Any = import_module("diffrax")
    jax.config.update("jax_enable_x64", True)
    jnp, scale, h = jax.numpy, jax.numpy.asarray(work.scale), work.record.sample_time
    v, times = jnp.asarray(work.record.voltage), jnp.asarray(work.record.time)
    slope, last = jnp.diff(v) / h, work.record.n - 2

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


#: The ways of others, which build and compile, and how many sets each runs at a time.
PEERS: dict[str, tuple[Callable[[Work], At], int]] = {
    "scipy solve_ivp, LSODA": (_lsoda, 4), "CVODES through CasADi": (_cvodes, 4),
    "diffrax, vmap, Kvaerno5": (_diffrax, 32),
}  # fmt: skip


def ensembles(progress: Progress, quick: bool, size: int = SETS) -> Outcome:
    """Measure `size` sets of 10^4 samples."""
    return measured(progress, cases(SAMPLES), QUICK if quick else size)


def cases(samples: int) -> list[psa.Record]:
    """Return a slow sine, one step a sample, and a multisine with many reversals."""
    t = time_grid(samples * SAMPLE_TIME, SAMPLE_TIME)[:samples]
    part = multisine(t[:_PART], 0.0, 100.0, (10.0, 250.0), seed=1)
    voltages = {
        "sine of 10 Hz": 50.0 - 50.0 * np.cos(20.0 * np.pi * t),
        "multisine to 250 Hz": np.resize(part, samples),
    }
    return [psa.Record(name=n, time=t, voltage=v) for n, v in voltages.items()]


def measured(progress: Progress, records: Sequence[psa.Record], count: int) -> Outcome:
    """Measure all sets of each case by `simulate_many`, and a part of its samples by the others.

    A method runs at the loosest tolerance of one list that reaches the target; the
    error is against the reference, which shares no code with any of them. Where there is a GPU, it
    runs 100 times as many.
    """
    ways = {n: w for n, w in PEERS.items() if "diffrax" not in n or find_spec("diffrax")}
    absent = "" if len(ways) == len(PEERS) else (
        " diffrax is not installed: `pip install --group ensembles` adds its row."
    )  # fmt: skip
    model, doubts, done = psa.stack_model("P-885.51"), [], []
    most = max(sets for _, sets in ways.values())
    sets, rows = drawn(model, max(count, most)), []
    for record in records:
        progress(f"{record.name}: reference")
        short = record.slice(0, min(_PART, record.n))
        work = Work(tuple(model.with_values(s) for s in sets[:most]), short)
        truth = work.first(_JUDGED).reference(_TRUTH)
        apart = np.abs(work.first(1).reference(_CHECK)[0] - truth[0])
        doubts.append(float(np.max(apart) / np.ptp(truth[0])))

        def ours(rtol: float, short: psa.Record = short) -> Solve:
            return partial(psa.simulate_many, model, sets[:_JUDGED], short, rtol=rtol)

        our_time = math.nan
        for name, (prepare, together) in {OURS: (None, count), **ways}.items():
            progress(f"{record.name}: {name}")
            at = ours if prepare is None else prepare(work.first(together))
            rtol, error, solve = loosest(at, truth)
            whole_one = record if prepare is None else short
            if prepare is None:
                done.append((record, rtol))
                how: Any = {"rtol": rtol, "reduce": np.ptp}
                solve = partial(psa.simulate_many, model, sets[:count], record, **how)
            ((wall, spent),) = least_times([solve], _REPEATS, _SLOW)
            each = spent / together / whole_one.n
            our_time = each if prepare is None else our_time
            rows.append({
                "voltage": record.name, "way": name, "sets": together, "samples": whole_one.n,
                "tolerance": f"{rtol:.0e}",
                "largest error / range": number(error, 2) + " (too large)" * (error > WANTED),
                "wall [s]": number(wall), "processor [s]": number(spent),
                "us per sample and set": number(1e6 * each),
                "over ours": number(each / our_time, 2),
            })  # fmt: skip
    gpu, missing = on_gpu(progress, model, done, MORE * count)
    table = TitledTable(
        "Many sets of parameters of a full stack; others on a part of the work, at equal error",
        rows,
        f"Threads: {threads()}. Every way has the loosest of the tolerances 1e-3, 3e-4, 1e-4, ..."
        f" at which its error is below {WANTED:.0e} of the range: the largest of {_JUDGED} sets"
        f" over {_PART} samples, against the reference at 1e-11, which differs from that at 1e-10"
        f" by {number(max(doubts), 2)}. Processor times are over all threads, building and"
        f" compiling left out. {OURS} keeps the range of each set; its starts are in the times."
        f" CVODES runs CasADi's virtual machine; LSODA calls Python.{absent}{missing}",
    )
    return Outcome((table, *gpu))


def on_gpu(
    progress: Progress, model: psa.Model, records: Sequence[tuple[psa.Record, float]], count: int
) -> tuple[tuple[TitledTable, ...], str]:
    """Return a table of `count` drawn sets under records with their tolerances, or why not."""
    try:
        cupy = device.device_module()
    except psa.InputError as error:
        return (), f" No rows of a GPU: {error}"
    sets, rows = drawn(model, count), []
    columns = {name: np.array([values[name] for values in sets]) for name in sets[0]}
    for record, rtol in records:
        progress(f"{record.name}: GPU, {count} sets")
        keep = partial(psa.simulate_many, model, record=record, rtol=rtol, reduce="range")
        ours = keep(sets[:_COMPARED])
        keep(sets[:_COMPARED], device="cuda")  # compiles
        begin = time.perf_counter()
        result = keep(columns, device="cuda")
        wall = time.perf_counter() - begin
        apart = np.max(np.abs(result[: len(ours)] - ours) / ours)
        rows.append({
            "voltage": record.name, "sets": count, "samples": record.n, "tolerance": f"{rtol:.0e}",
            "largest difference of a range from the cores'": f"{apart:.1e}",
            "wall [s]": number(wall),
            "ns per sample and set": number(1e9 * wall / count / record.n),
        })  # fmt: skip
    name = cupy.cuda.runtime.getDeviceProperties(cupy.cuda.Device().id)["name"].decode()
    note = (
        f"One set a thread of {name}; of each set the range is kept, on the device. The starts of"
        " the sets are in the times, compiling is not."
    )
    return (TitledTable("Many sets on a GPU", rows, note),), ""


def drawn(model: psa.Model, count: int) -> list[dict[str, float]]:
    """Return sets of parameters around a model's; the first are the same for any count."""
    rng = np.random.default_rng(5)
    return [
        {n: model.values[n] * float(np.exp(0.1 * rng.standard_normal())) for n in _DRAWN}
        for _ in range(count)
    ]


def loosest(at: At, truth: FloatArray) -> tuple[float, float, Solve]:
    """Return the loosest tolerance at which the error of the sets in `truth` (m, n) is accepted.

    With that error over the range and the run; those of the tightest where none is accurate enough.
    """
    size = np.ptp(truth, axis=1)[:, None]
    for tolerance in TOLERANCES:
        solve = at(tolerance)
        error = float(np.max(np.abs(solve()[: len(truth)] - truth) / size))
        if error <= WANTED:
            break
    return tolerance, error if np.isfinite(error) else inf, solve
