"""An FMU of a stack in CasADi: a step, its sensitivities, an optimal voltage, all on the binary.

CasADi imports the model-exchange side with `DaeBuilder` and differentiates through it by the FMU's
directional derivatives. The same problem solved with the symbolic model gives the same voltage.
"""

from itertools import pairwise
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from fmpy import extract
from matplotlib.figure import Figure

import psa_casadi as psa
from psa_casadi.common.units import FloatArray

#: The path to follow: a smooth rise of 8 um in 0.4 ms, in 20 steps.
STEPS, SIZE = 20, 2e-5
PATH = 4e-6 * (1.0 - np.cos(np.pi * np.arange(1, STEPS + 1) / STEPS))


def main(folder: Path) -> dict[str, float]:
    """Import the FMU of a P-885.51; respond to a step, differentiate, follow a path."""
    plant = psa.stack_model("P-885.51").plant()
    fmu = psa.export_fmu(plant, folder / "stack.fmu")
    f = imported(fmu, folder / "unpacked")
    step, slope = step_of(f, plant, 100.0, "k_L")
    voltage, reached = optimal_voltage(f, plant)
    expected, _ = optimal_voltage(symbolic(plant), plant)
    _draw(folder / "use_in_casadi.png", voltage, reached)
    return {
        "displacement 2 ms after a step of 100 V [um]": 1e6 * step,
        "its derivative by k_L [um per N/V]": 1e6 * slope,
        "rms error on the path [nm]": 1e9 * float(np.sqrt(np.mean((reached - PATH) ** 2))),
        "voltage differs from the symbolic model's by [V]": float(np.abs(voltage - expected).max()),
    }


def imported(fmu: Path, folder: Path) -> ca.Function:
    """Return f(x, u, p) -> (ode, y) of an FMU as CasADi imports it.

    `max_num_dir` keeps CasADi 3.8.2 from handing over several adjoint seeds, which it mixes up.
    """
    builder = ca.DaeBuilder("stack", str(extract(str(fmu), str(folder))))
    return builder.create("f", ["x", "u", "p"], ["ode", "y"], {"max_num_dir": 1})


def symbolic(model: psa.Model) -> ca.Function:
    """Return the same f of the model itself."""
    sizes = (len(model.state_names), len(model.input_names), len(model.parameter_names))
    x, u, p = (ca.MX.sym(n, size) for n, size in zip("xup", sizes, strict=True))
    return ca.Function("f", [x, u, p], list(model.structure.f(0.0, x, u, p)))


def step_of(f: ca.Function, model: psa.Model, voltage: float, name: str) -> tuple[float, float]:
    """Return the displacement [m] 2 ms after a step, and its derivative by a parameter.

    CVODES integrates states in units of their usual size, so that one tolerance suits all.
    """
    size, values = model.state_nominals(), model.parameter_vector()
    z, k = ca.MX.sym("z", len(size)), ca.MX.sym("k")
    at = model.parameter_names.index(name)
    p = ca.vertcat(values[:at], k, values[at + 1 :])
    xdot, _ = f(size * z, ca.vertcat(voltage, 0.0), p)
    tolerances = {"reltol": 1e-9, "abstol": 1e-11}
    whole = ca.integrator(
        "whole", "cvodes", {"x": z, "p": k, "ode": xdot / size}, 0.0, 2e-3, tolerances
    )
    x = model.state_names.index("x")
    final = size[x] * whole(x0=np.zeros(len(size)), p=k)["xf"][x]
    both = ca.Function("both", [k], [final, ca.jacobian(final, k)])
    reached, slope = both(values[at])
    return float(reached), float(slope)


def optimal_voltage(f: ca.Function, model: psa.Model) -> tuple[FloatArray, FloatArray]:
    """Return the voltage (20,) between 0 and its rating that follows PATH best, and the way [m].

    Backward Euler over 20 steps; states and voltages, each in units of its usual size, are the
    unknowns of IPOPT. The cost is the square of the error in um and a small price on changes of the
    voltage, and its Hessian replaces the Lagrangian's (Gauss and Newton): an FMU has no second
    derivatives.
    """
    size, p, top = model.state_nominals(), model.parameter_vector(), model.values["u_rated"]
    x = model.state_names.index("x")
    states = [ca.MX.sym(f"x_{k}", len(size)) for k in range(STEPS)]
    volts = ca.MX.sym("v", STEPS)
    residuals = []
    for k, (before, after) in enumerate(pairwise([ca.MX.zeros(len(size)), *states])):
        xdot, _ = f(size * after, ca.vertcat(top * volts[k], 0.0), p)
        residuals.append(after - before - SIZE * xdot / size)
    errors = [1e6 * (size[x] * s[x] - PATH[k]) for k, s in enumerate(states)]
    unknowns = ca.vertcat(*states, volts)
    cost = ca.sumsqr(ca.vertcat(*errors, 1e-2 * ca.diff(volts)))
    problem: dict[str, Any] = {"x": unknowns, "f": cost, "g": ca.vertcat(*residuals)}
    count = len(size) * STEPS
    solver = ca.nlpsol("solver", "ipopt", problem, _options(cost, unknowns, count))
    free = np.full(count, np.inf)
    solution = solver(
        x0=np.concatenate([np.zeros(count), np.linspace(0.0, 0.5, STEPS)]),
        lbx=np.concatenate([-free, np.zeros(STEPS)]),
        ubx=np.concatenate([free, np.ones(STEPS)]),
        lbg=0.0,
        ubg=0.0,
    )
    if not solver.stats()["success"]:
        raise RuntimeError(f"IPOPT ended with {solver.stats()['return_status']}")
    result = np.array(solution["x"]).ravel()
    return top * result[count:], size[x] * result[:count].reshape(STEPS, len(size))[:, x]


def _options(cost: ca.MX, unknowns: ca.MX, residuals: int) -> dict[str, Any]:
    """Return IPOPT's options with the Hessian of the cost alone."""
    factor, multipliers = ca.MX.sym("f"), ca.MX.sym("l", residuals)
    arguments = [unknowns, ca.MX(0, 1), factor, multipliers]
    hessian = ca.Function("h", arguments, [ca.triu(factor * ca.hessian(cost, unknowns)[0])])
    quiet = {"print_level": 0, "sb": "yes", "tol": 1e-10, "max_iter": 300}
    return {"hess_lag": hessian, "print_time": False, "ipopt": quiet}


def _draw(path: Path, voltage: FloatArray, reached: FloatArray) -> None:
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    time = 1e3 * SIZE * np.arange(1, STEPS + 1)
    left.stairs(voltage, [0.0, *time], baseline=None, color="#d55e00", lw=1.5, zorder=3)
    left.set(xlabel="time [ms]", ylabel="optimal voltage [V]")
    right.plot(time, 1e6 * PATH, "o", color="#9a9a9a", label="path")
    right.plot(time, 1e6 * reached, color="#0072b2", label="reached")
    right.set(xlabel="time [ms]", ylabel="displacement [um]")
    right.legend(loc="upper left")
    for axes in (left, right):
        axes.grid(color="#e4e7ea")
    figure.savefig(path, dpi=110)
