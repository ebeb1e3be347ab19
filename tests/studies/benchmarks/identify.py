"""Speed of the identification: beside scipy's, over the length of the record, and its memory.

The peer is what one would write without this package: `scipy.optimize.least_squares` with finite
differences around `scipy.integrate.solve_ivp` (LSODA) on the reference's equations. Both start at
the same point near the truth (from farther away the peer stays in a side valley), search the same
parameters with the same residuals, and stop when they will; the time is that at which each first
has the cost that both reach.
"""

import math
import resource
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

from psa_casadi.components import BASE
from psa_casadi.identification.fitting import fit as fitting
from psa_casadi.identification.fitting.fit import Fit, fit
from psa_casadi.model.compose import Model, compose
from psa_casadi.model.stacks import STACKS
from psa_casadi.records import Record, multisine, time_grid
from psa_casadi.records.split import whole
from psa_casadi.report.words.tables import Table
from psa_casadi.simulation.simulate import simulate
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable, table_of

FloatArray = npt.NDArray[np.float64]

FREE = ("k_L", "A", "beta", "gamma", "delta", "n", "tau", "R_s", "c_P", "c_B", "m_P")
_STACK, _NOISE, _SAMPLE_TIME = "WYDS0808020", 1e-3, 2e-5
_WRONG = {"k_L": 1.01, "A": 0.98, "beta": 0.98, "gamma": 1.05, "tau": 1.05, "R_s": 1.1}
#: The final cost counts as reached at this factor above the lowest that both of them reach.
_REACHED = 1.001


def run(progress: Progress, quick: bool) -> Outcome:
    """Measure both on one record, then this package's fit on records of growing length."""
    length = 2000 if quick else 20_000
    lengths = (1000, 10_000) if quick else (10_000, 100_000, 1_000_000)
    return Outcome((_beside_scipy(length, progress), _growth(lengths, progress)))


def _stack() -> Model:
    return compose(BASE, {name: f.value for name, f in STACKS[_STACK].values.items()})


def _record(samples: int) -> Record:
    """Return a multisine with noise, of this package's own simulation, from rest."""
    time_points = time_grid(samples * _SAMPLE_TIME, _SAMPLE_TIME)
    top = _stack().values["u_rated"]
    band = (2.0 / time_points[-1], max(40.0 / time_points[-1], 200.0))
    voltage = multisine(time_points, 0.0, top, band, seed=1)
    voltage = voltage * np.minimum(10.0 * time_points / time_points[-1], 1.0)
    voltage[:4] = 0.0  # at rest at first, which both take for granted
    x = simulate(_stack(), time_points, voltage).displacement
    noise = _NOISE * np.ptp(x) * np.random.default_rng(1).standard_normal(samples)
    return Record(
        name=f"{samples} samples", time=time_points, voltage=voltage, displacement=x + noise
    )


class _Trace:
    """Cost against time."""

    def __init__(self) -> None:
        self.begin = time.process_time()
        self.points: list[tuple[float, float]] = []

    def add(self, cost: float) -> None:
        self.points.append((time.process_time() - self.begin, cost))

    @property
    def best(self) -> float:
        return min(cost for _, cost in self.points)

    def reached(self, cost: float) -> float:
        return next((t for t, c in self.points if c <= cost), float("nan"))


def _beside_scipy(samples: int, progress: Progress) -> TitledTable:
    record = _record(samples)
    _ours(record)  # compiles the model once, as on any first use
    ours, evaluations = _ours(record)
    progress(f"least_squares with solve_ivp on {samples} samples (minutes)")
    theirs = _scipy(record, _NOISE * record.range_m)
    target = _REACHED * max(ours.best, theirs.best)
    ways = {
        "psa_casadi, fit": (ours, evaluations),
        "scipy, least_squares with solve_ivp": (theirs, len(theirs.points)),
    }
    return table_of(
        f"One fit of {len(FREE) + 1} parameters to {samples} samples",
        ways,
        {
            "who": str,
            "CPU time to the final cost [s]": lambda n: f"{ways[n][0].reached(target):.3g}",
            "simulations": lambda n: str(ways[n][1]),
            "lowest cost": lambda n: f"{ways[n][0].best:.1f}",
        },
        f"The fit here takes 1/{theirs.reached(target) / ours.reached(target):.0f} of the time."
        f" Both search the offset and {', '.join(FREE)} from one start, in one process of one run;"
        f" a cost of {samples} is pure noise. Compiling the model once (cached afterwards) is not"
        " counted.",
    )


def _ours(record: Record) -> tuple[_Trace, int]:
    trace = _Trace()
    objective = fitting.Objective

    def traced(*arguments: object) -> Callable[[FloatArray], object]:
        # whatever the fit passes is passed on
        evaluate = objective(*arguments)  # type: ignore[arg-type]

        def wrapped(theta: FloatArray) -> object:
            found = evaluate(theta)
            if found is not None:
                trace.add(float(found[0] @ found[0]))
            return found

        return wrapped

    # the fit's own objective is replaced by one that also keeps a trace
    fitting.Objective = traced  # type: ignore[assignment,misc]
    try:
        found = _fitted(record)
    finally:
        fitting.Objective = objective  # type: ignore[misc]
    return trace, found.evaluations


def _scipy(record: Record, sigma: float) -> _Trace:
    """Return the trace of least_squares with finite differences around solve_ivp."""
    model, y = _stack(), np.asarray(record.displacement)
    start = {n: _WRONG.get(n, 1.0) * model.values[n] for n in FREE}
    reference = np.array([model.values[n] for n in FREE])
    positive = np.array([n in ("k_L", "tau", "R_s", "c_P", "c_B", "m_P") for n in FREE])
    trace = _Trace()

    def residual(z: FloatArray) -> FloatArray:
        ratios = np.where(positive, np.exp(np.where(positive, z[:-1], 0.0)), z[:-1])
        p = {**model.values, **dict(zip(FREE, (ratios * reference).tolist(), strict=True))}
        x = _plain(p, record.time, record.voltage)
        r: FloatArray = (x + z[-1] * sigma - y) / sigma
        trace.add(float(r @ r))
        return r

    ratio = np.array([start[n] for n in FREE]) / reference
    z0 = np.append(np.where(positive, np.log(np.abs(ratio)), ratio), 0.0)
    least_squares(residual, z0, method="lm", diff_step=np.full(z0.size, 1e-3), ftol=1e-5, xtol=1e-6)
    return trace


def _plain(p: dict[str, float], t: FloatArray, v: FloatArray) -> FloatArray:
    """Return the displacement of eqs. (4), (5), (7)-(9) by solve_ivp, from rest."""

    def slopes(now: float, s: FloatArray) -> tuple[Any, ...]:
        return rates(p, float(np.interp(now, t, v)), s.tolist(), math)

    stroke = p["k_L"] * p["u_rated"] * (1.0 / p["k_P"] + 1.0 / p["k_B"])
    speed = stroke * (p["k_B"] / p["m_B"]) ** 0.5
    sizes = [p["u_rated"], p["h_ref"], p["k_L"] * p["u_rated"], stroke, speed, stroke, speed]
    how: Any = {"rtol": 1e-7, "atol": 1e-7 * np.array(sizes)}
    found = solve_ivp(slopes, (t[0], t[-1]), np.zeros(7), "LSODA", t, **how)
    return np.asarray(found.y[5], dtype=np.float64)


def _growth(lengths: tuple[int, ...], progress: Progress) -> TitledTable:
    rows = []
    for samples in lengths:
        progress(f"fit to {samples} samples")
        record, begin = _record(samples), time.process_time()
        count = _fitted(record).evaluations
        spent = time.process_time() - begin
        unit = 1.0 if sys.platform == "darwin" else 1024.0
        peak = unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        each = f"{1e6 * spent / count / samples:.1f}"
        rows.append((f"{samples}", f"{spent:.2f}", f"{count}", each, f"{peak:.0f}"))
    head = (
        "samples", "CPU time [s]", "simulations", "each, per sample [us]", "peak memory [MiB]"
    )  # fmt: skip
    return TitledTable(
        "The same fit over the length of the record",
        Table(head, tuple(rows)),
        "Every simulation carries the derivatives by all parameters. Memory is the highest of the"
        " whole process so far, Python and libraries included; nothing was averaged.",
    )


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
        du,
        p["A"] * du - bend + p["delta"] * u * sign,
        (p["k_L"] * u + f_H - f_out) / p["tau"],
        v_y,
        (f_out - passed_on) / p["m_P"],
        v_x,
        (passed_on - pull) / p["m_B"],
    )


def _fitted(record: Record) -> Fit:
    """Fit a record from the wrong values."""
    model = _stack()
    start = {name: factor * model.values[name] for name, factor in _WRONG.items()}
    return fit(model, [whole(record)], FREE, sigma=[_NOISE * record.range_m], start=start)
