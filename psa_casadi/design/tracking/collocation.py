"""Direct collocation: a stack's equations over the samples of a path as constraints of a program.

Radau IIA of two stages (order 3, L-stable) on every interval between samples, where the voltage is
linear, with c = (1/3, 1) and x_(k,2) = x_(k+1):

    x_(k,1) = x_k + h (5/12 f_1 - 1/12 f_2),   x_(k,2) = x_k + h (3/4 f_1 + 1/4 f_2)
"""

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from psa_casadi.component import Expression
from psa_casadi.design.tracking.targets import Dynamics
from psa_casadi.model.compose import Model
from psa_casadi.simulation.simulate import input_samples
from psa_casadi.simulation.stepper import Steps, run
from psa_casadi.units import FloatArray

NODES = (1.0 / 3.0, 1.0)
_WEIGHTS = ((5.0 / 12.0, -1.0 / 12.0), (3.0 / 4.0, 1.0 / 4.0))


@dataclass(frozen=True, eq=False)
class Interval:
    """One interval as a CasADi function, all states over their nominal size.

    `step` is (x_k, (x_1, x_2), (v_k, v_k+1) [V], (t_k, h) [s]) -> (residual (2 nx), displacement
    (2) [m], current (2) [A]), the last two at the nodes.
    """

    step: ca.Function
    nominal: FloatArray
    symbolic: bool = True


def interval_of(dynamics: Dynamics, *, symbolic: bool = True) -> Interval:
    """Return the interval of some equations; `symbolic` expands them to scalar operations.

    An imported FMU cannot be expanded.
    """
    kind: Any = ca.SX if symbolic else ca.MX
    size: Expression = ca.DM(dynamics.nominal)
    nx = len(dynamics.nominal)
    x, ends, clock = kind.sym("x", nx), kind.sym("v", 2), kind.sym("clock", 2)
    inner = kind.sym("inner", 2 * nx)
    stages = [inner[:nx], inner[nx:]]
    results = [
        dynamics.f.call(
            [clock[0] + c * clock[1], size * stage, ends[0] + c * (ends[1] - ends[0])],
            not symbolic,
            False,
        )
        for c, stage in zip(NODES, stages, strict=True)
    ]
    rates = [clock[1] * xdot / size for xdot, _, _ in results]
    residuals = [
        stage - x - weights[0] * rates[0] - weights[1] * rates[1]
        for stage, weights in zip(stages, _WEIGHTS, strict=True)
    ]
    outputs = [ca.vertcat(*residuals), *(ca.vertcat(*(r[k] for r in results)) for k in (1, 2))]
    step = ca.Function("interval", [x, inner, ends, clock], outputs)
    return Interval(step, dynamics.nominal, symbolic)


@dataclass(frozen=True, eq=False)
class Chain:
    """The constraints over all intervals: `residual` (2 nx, N), outputs at the nodes (2, N)."""

    residual: Expression
    displacement: Expression
    current: Expression


def chain(
    interval: Interval, start: FloatArray, inner: Expression, voltage: Expression, clock: Expression
) -> Chain:
    """Chain N intervals: `start` (nx,) over nominal, `inner` (2 nx, N), `voltage` (1, N + 1) [V].

    `clock` (2, N) holds start and length of the intervals [s].
    """
    count, nx = inner.shape[1], len(interval.nominal)
    before = ca.horzcat(ca.DM(start), inner[nx:, : count - 1])
    ends = ca.vertcat(voltage[:, :count], voltage[:, 1:])
    if interval.symbolic:
        return Chain(*interval.step.map(count)(before, inner, ends, clock))
    # the derivatives of an FMU are right only where its calls stand in the program itself
    pieces = [
        interval.step.call([before[:, k], inner[:, k], ends[:, k], ca.MX(clock)[:, k]], True, False)
        for k in range(count)
    ]
    return Chain(*(ca.horzcat(*column) for column in zip(*pieces, strict=True)))


def nodes_of(time: FloatArray) -> FloatArray:
    """Return the instants of the nodes, shape (2, N) [s]."""
    return np.array([time[:-1] + NODES[0] * np.diff(time), time[1:]])


def simulated_states(
    model: Model, nodes: FloatArray, time: FloatArray, voltage: FloatArray, start: FloatArray
) -> FloatArray:
    """Return the simulated states over nominal at the nodes (2, N), shape (2 nx, N)."""
    states = _simulate(model, nodes, time, voltage, start).x[1:] / model.state_nominals()
    return states.reshape(nodes.shape[1], -1).T


def simulated_displacement(
    model: Model, nodes: FloatArray, time: FloatArray, voltage: FloatArray, start: FloatArray
) -> FloatArray:
    """Return the simulated displacement at the nodes, shape (2, N) [m]."""
    y = _simulate(model, nodes, time, voltage, start).y[1:]
    return y[:, model.output_names.index("displacement")].reshape(nodes.shape[1], 2).T


def _simulate(
    model: Model, nodes: FloatArray, time: FloatArray, voltage: FloatArray, start: FloatArray
) -> Steps:
    grid = np.concatenate([time[:1], nodes.T.ravel()])
    u = input_samples(model, len(grid), {"voltage": np.interp(grid, time, voltage)})
    return run(model, grid, u, start, rtol=1e-7)
