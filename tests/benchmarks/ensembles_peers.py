"""How others integrate many sets of parameters under one record: scipy, CasADi's CVODES, diffrax.

Each gets the same equations, the voltage as a line between regular samples, states over their usual
sizes, and what it can compile compiled. What it builds once for a record is not timed.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt
from scipy.integrate import solve_ivp

from psa_casadi.model.compose import Model
from psa_casadi.reference import from_samples, simulate
from psa_casadi.simulation.start import start_on

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


def _scipy(work: Work) -> At:
    """LSODA on plain numbers, one set after the other."""
    t, h, scale = work.times, work.step, work.scale
    v, slope = work.voltage.tolist(), (np.diff(work.voltage) / h).tolist()

    def one(model: Model, x0: FloatArray, tolerance: float) -> FloatArray:
        p, last = model.values, len(slope) - 1

        def slopes(now: float, x: FloatArray) -> tuple[float, ...]:
            k = min(int(now / h), last)
            return rates(p, v[k] + (now - k * h) * slope[k], x.tolist(), math)

        found = solve_ivp(
            slopes, (0.0, t[-1]), x0, "LSODA", t, rtol=tolerance, atol=tolerance * scale
        )
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
