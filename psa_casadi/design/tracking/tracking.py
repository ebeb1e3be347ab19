"""The voltage that makes a stack's displacement follow a path within the amplifier's limits.

Direct collocation on the smooth form of the model, solved by IPOPT from the inverted model's
voltage; then the full simulator is run, and its error beyond the program's discretisation
is subtracted from the path before the program is solved once more.

Direct collocation: a stack's equations over the samples of a path as constraints of a program.

Radau IIA of two stages (order 3, L-stable) on every interval between samples, where the voltage is
linear, with c = (1/3, 1) and x_(k,2) = x_(k+1):

    x_(k,1) = x_k + h (5/12 f_1 - 1/12 f_2),   x_(k,2) = x_k + h (3/4 f_1 + 1/4 f_2)
"""

import time as clocks
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import scipy

from psa_casadi.common.errors import InputError, PsaError
from psa_casadi.common.interruption import raise_if_stopped
from psa_casadi.common.units import FloatArray
from psa_casadi.design.tracking.inversion import InvertedInput, invert
from psa_casadi.design.tracking.targets import (
    AmplifierLimits,
    Dynamics,
    Response,
    Target,
    TrackingError,
    demand_stack,
    dynamics_of,
    error_of,
    exceeds_limits,
    respond,
    rest_at,
    smooth_form,
)
from psa_casadi.model.component import Expression
from psa_casadi.model.compose import Model
from psa_casadi.simulation.simulate import input_samples
from psa_casadi.simulation.stepper import run

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
    results = []
    for c, stage in zip(NODES, stages, strict=True):
        node = [clock[0] + c * clock[1], size * stage, ends[0] + c * (ends[1] - ends[0])]
        results.append(dynamics.f.call(node, not symbolic, False))
    rates = [clock[1] * xdot / size for xdot, _, _ in results]
    residuals = [
        stage - x - weights[0] * rates[0] - weights[1] * rates[1]
        for stage, weights in zip(stages, _WEIGHTS, strict=True)
    ]
    outputs = [ca.vertcat(*residuals), *(ca.vertcat(*(r[k] for r in results)) for k in (1, 2))]
    step = ca.Function("interval", [x, inner, ends, clock], outputs)
    return Interval(step, dynamics.nominal, symbolic)


def chain(
    interval: Interval, start: FloatArray, inner: Expression, voltage: Expression, clock: Expression
) -> tuple[Expression, Expression, Expression]:
    """Chain N intervals: `start` (nx,) over nominal, `inner` (2 nx, N), `voltage` (1, N + 1) [V].

    `clock` (2, N) holds start and length of the intervals [s]. Returns the residual (2 nx, N), and
    displacement and current at the nodes (2, N).
    """
    count, nx = inner.shape[1], len(interval.nominal)
    before = ca.horzcat(ca.DM(start), inner[nx:, : count - 1])
    ends = ca.vertcat(voltage[:, :count], voltage[:, 1:])
    if interval.symbolic:
        residual, displacement, current = interval.step.map(count)(before, inner, ends, clock)
        return residual, displacement, current
    # the derivatives of an FMU are right only where its calls stand in the program itself
    pieces = [
        interval.step.call([before[:, k], inner[:, k], ends[:, k], ca.MX(clock)[:, k]], True, False)
        for k in range(count)
    ]
    residual, displacement, current = (ca.horzcat(*c) for c in zip(*pieces, strict=True))
    return residual, displacement, current


def _at_nodes(
    model: Model, time: FloatArray, voltage: FloatArray, start: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the simulated states over nominal (2 nx, N) and displacement (2, N) [m] at the nodes.

    `start` (nx,) is the state at the first instant.
    """
    count = len(time) - 1
    grid = np.concatenate([time[:1], _nodes(time).T.ravel()])
    u = input_samples(model, len(grid), {"voltage": np.interp(grid, time, voltage)})
    steps = run(model, grid, u, start, rtol=1e-7)
    displacement = steps.y[1:, model.output_names.index("displacement")]
    states = steps.x[1:] / model.state_nominals()
    return states.reshape(count, -1).T, displacement.reshape(count, 2).T


def _nodes(time: FloatArray) -> FloatArray:
    """Return the instants of the nodes, shape (2, N) [s]."""
    return np.array([time[:-1] + NODES[0] * np.diff(time), time[1:]])


#: Price of the voltage's second differences over the voltage scale, relative to errors over the
#: range.
PRICE = 1e-2
#: Weight of the mean square error where the largest error is minimised, so that the rest of the
#: path does not float.
_REST = 1e-2
#: Brings costs near 1: the cost counts in squares of a percent of the range.
WEIGHT = 1e4
#: Barrier to start with: near 0 where the first guess, from inversion, is near the answer; where
#: limits may stop it, far enough from them to find another way.
_BARRIER, _BARRIER_LIMITED = 1e-6, 1e-2
#: Largest violation of the scaled equations that a program out of iterations may leave.
_FEASIBLE = 1e-6


class NoSolutionError(PsaError):
    """IPOPT ended without a voltage that obeys the equations and the limits."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Voltage (n,) [V], states over nominal (2 nx, N) and displacement (2, N) [m] at the nodes.

    Without `converged` the equations and limits hold, but IPOPT's iterations ended before it could
    call the answer the best one.
    """

    voltage: FloatArray
    inner: FloatArray
    displacement: FloatArray
    iterations: int
    converged: bool


@dataclass(eq=False)
class Program:
    """A program set up once and solved for paths that may change from solve to solve.

    `time` (n,) [s], the `span` of the path [m], the voltage at `rest` and its `scale` [V]; `start`
    (nx,) is the state before the first sample, over nominal. The voltage stays at `rest` over the
    first interval, so that every simulator starts at rest. `minimax` asks for the least largest
    error instead of the least mean square.
    """

    interval: Interval
    time: FloatArray
    span: float
    rest: float
    scale: float
    start: FloatArray
    limits: AmplifierLimits
    minimax: bool = False

    def __post_init__(self) -> None:
        count, nx = len(self.time) - 1, len(self.start)
        size = 2 * nx * count
        self._x = ca.MX.sym("x", size + count - 1 + int(self.minimax))
        self._path = ca.MX.sym("path", 2 * count)
        inner = ca.reshape(self._x[:size], 2 * nx, count)
        free = self._x[size : size + count - 1]
        self._voltage = ca.horzcat(ca.DM([[self.rest, self.rest]]), (self.scale * free).T)
        clock = np.vstack([self.time[:-1], np.diff(self.time)])
        residual, displacement, current = chain(
            self.interval, self.start, inner, self._voltage, clock
        )
        self._errors = (ca.vec(displacement) - self._path) / self.span
        rows, self._low, self._high = self._constraints(residual, current, clock[1])
        self._solver = self._build(rows)
        self._outputs = ca.Function("outputs", [self._x], [displacement])

    def solve(self, path: FloatArray, voltage: FloatArray, inner: FloatArray) -> Solution:
        """Solve for a path (2, N) [m] at the nodes from a first guess of voltage and states.

        Raises NoSolutionError if IPOPT finds none.
        """
        guess = [inner.T.ravel(), voltage[2:] / self.scale, np.full(int(self.minimax), 1e-2)]
        low = np.full(self._x.shape[0], -np.inf)
        high = -low
        free = slice(inner.size, inner.size + len(voltage) - 2)
        low[free] = self.limits.min_voltage / self.scale
        high[free] = self.limits.max_voltage / self.scale
        solution = self._solver(
            x0=np.concatenate(guess), p=path.T.ravel(), lbx=low, ubx=high,
            lbg=self._low, ubg=self._high,
        )  # fmt: skip
        raise_if_stopped()  # which the solver takes for a failure
        stats = self._solver.stats()
        off = np.maximum(np.array(solution["g"]).ravel() - self._high, 0.0)
        if not stats["success"] and not np.max(off) < _FEASIBLE:
            raise NoSolutionError(
                f"IPOPT failed ({stats['return_status']}). Limits that leave the path no"
                " room, or a path far beyond the stack's bandwidth, are the likely cause; widen"
                " the limits or slow the path down."
            )
        x = np.array(solution["x"]).ravel()
        designed = np.concatenate([[self.rest, self.rest], self.scale * x[free]])
        states = x[: inner.size].reshape(inner.T.shape).T
        displacement, count = np.array(self._outputs(solution["x"])), int(stats["iter_count"])
        return Solution(designed, states, displacement, count, bool(stats["success"]))

    def _constraints(
        self, residual: Expression, current: Expression, lengths: FloatArray
    ) -> tuple[Expression, FloatArray, FloatArray]:
        """Return rows with their bounds: equations, rate, current, and the largest error."""
        rows: list[Any] = [ca.vec(residual)]
        least, most = [0.0], [0.0]
        if np.isfinite(self.limits.max_rate):
            change: Expression = ca.diff(self._voltage, 1, 1)[1:].T
            rows.append(change / (self.limits.max_rate * lengths[1:]))
        if np.isfinite(self.limits.max_current):
            passed: Expression = ca.vec(current)
            rows.append(passed / self.limits.max_current)
        least += [-1.0] * (len(rows) - 1)
        most += [1.0] * (len(rows) - 1)
        if self.minimax:
            rows += [self._errors - self._x[-1], -self._errors - self._x[-1]]
            least, most = [*least, -np.inf, -np.inf], [*most, 0.0, 0.0]
        sizes = [row.shape[0] for row in rows]
        return ca.vertcat(*rows), np.repeat(least, sizes), np.repeat(most, sizes)

    def _build(self, rows: Expression) -> ca.Function:
        """Return the solver.

        Where only squares of errors count, its Hessian is that of their sum (Gauss and Newton): the
        Lagrangian's where the error vanishes, without second derivatives of the equations, which an
        imported FMU does not have. Elsewhere it is the exact one, of equations that are symbolic.
        """
        bends: Expression = PRICE * ca.diff(self._voltage, 2, 1).T / self.scale
        share = _REST if self.minimax else 1.0
        errors = self._errors * np.sqrt(share / self._errors.shape[0])
        terms = ca.vertcat(errors, bends / np.sqrt(bends.shape[0]))
        cost = WEIGHT * ca.sumsqr(terms)
        slopes = ca.jacobian(terms, self._x)
        sigma = ca.MX.sym("sigma")
        multipliers = ca.MX.sym("multipliers", rows.shape[0])
        hessian = ca.triu(2.0 * WEIGHT * sigma * slopes.T @ slopes)
        arguments = [self._x, self._path, sigma, multipliers]
        # whether not only squares shape the answer
        limited = self.minimax or self.limits != AmplifierLimits()
        barrier = _BARRIER_LIMITED if limited else _BARRIER
        ipopt = {"print_level": 0, "sb": "yes", "tol": 1e-8, "max_iter": 150, "mu_init": barrier}
        options: dict[str, Any] = {"print_time": False, "ipopt": ipopt}
        if not (limited and self.interval.symbolic):
            options["hess_lag"] = ca.Function("hessian", arguments, [hessian])
        goal = cost + self._x[-1] * 100.0 if self.minimax else cost
        program = {"x": self._x, "p": self._path, "f": goal, "g": rows}
        return ca.nlpsol("tracking", "ipopt", program, options)


#: Rounding of the kinks at u' = 0, over the largest voltage rate of the inverted model.
WIDTH = 0.02
#: Solutions after the first, each with the discretisation's error taken off the path.
CORRECTIONS = 2
#: A solution that IPOPT did not finish must leave less than this share of the inversion's error.
_IMPROVEMENT = 0.8


@dataclass(frozen=True, eq=False)
class TrackedInput:
    """A designed voltage and what became of it.

    `response` and `error` are the full simulator's; `predicted` (n,) [m] is what the program itself
    expected at the path's instants. Without `by_program` the answer is the inversion cut by the
    limits, because the program has no solution, or none that is better. `width` [V/s] is the
    rounding of the smooth form, `inverse` the inversion without limits, `iterations` IPOPT's,
    `seconds` the time it all took.
    """

    target: Target
    limits: AmplifierLimits
    minimax: bool
    response: Response
    error: TrackingError
    predicted: FloatArray
    by_program: bool
    converged: bool
    width: float
    inverse: InvertedInput
    iterations: int
    seconds: float

    @property
    def voltage(self) -> FloatArray:
        """The designed voltage (n,) [V] at the path's instants, linear in between."""
        return self.response.voltage


def track(
    model: Model,
    target: Target,
    limits: AmplifierLimits | None = None,
    *,
    minimax: bool = False,
    corrections: int = CORRECTIONS,
    equations: Callable[[Model], Dynamics] | None = None,
    progress: Callable[[str], None] = lambda step: None,
) -> TrackedInput:
    """Return the voltage for a path: least mean square error, or least largest with `minimax`.

    The stack rests where the path starts, and its voltage stays at rest over the first interval.
    `equations` gives the equations of the smooth form if they come from elsewhere (an imported
    FMU); those of the model are used by default. The best of the solutions, by the full simulator's
    error, is returned.

    Raises InputError for a model that is no stack, limits that contradict each other or the path's
    start, and PsaError if there is no voltage within the limits.
    """
    started = clocks.perf_counter()
    bounds = limits or AmplifierLimits()
    rest, start = _rest(model, target, bounds)
    progress("inversion")
    inverse = invert(model, target)
    cut = inverse if bounds == AmplifierLimits() else invert(model, target, bounds)
    guess = cut.response.voltage.copy()
    guess[:2] = rest
    width = WIDTH * float(np.max(np.abs(inverse.response.rate)))
    smooth = smooth_form(model, width)
    interval = interval_of((equations or dynamics_of)(smooth), symbolic=equations is None)
    program = Program(
        interval, target.time, target.span, rest, float(np.ptp(inverse.response.voltage)),
        start / interval.nominal, bounds, minimax,
    )  # fmt: skip
    solutions = _solve(model, smooth, target, program, guess, corrections, progress)
    designed = _chosen(model, target, bounds, minimax, solutions, cut)
    return TrackedInput(
        target, bounds, minimax, *designed, width, inverse,
        sum(s.iterations for _, s in solutions), clocks.perf_counter() - started,
    )  # fmt: skip


def _chosen(
    model: Model, target: Target, limits: AmplifierLimits, minimax: bool,
    solutions: list[tuple[float, Solution]], cut: InvertedInput,
) -> tuple[Response, TrackingError, FloatArray, bool, bool]:  # fmt: skip
    """Return the best answer: response, error, what was predicted, by the program, converged.

    The inversion cut by the limits is the answer where no solution is better; it predicts what the
    simulator shows. Raises PsaError if there is no solution and a limit that cuts break.
    """
    if solutions:
        _, best = min(solutions, key=lambda s: s[0])
        response = respond(model, target.time, best.voltage)
        error = error_of(target, response.displacement)
        share = 1.0 if best.converged else _IMPROVEMENT
        designed, inverted = ((e.largest if minimax else e.rms) for e in (error, cut.error))
        if designed <= share * inverted or exceeds_limits(cut.response, limits):
            predicted = np.concatenate([target.displacement[:1], best.displacement[1]])
            return response, error, predicted, True, best.converged
    elif exceeds_limits(cut.response, limits):
        raise PsaError(
            "The search gave no voltage within the limits that comes near the path; widen the"
            " limits or slow the path down."
        )
    return cut.response, cut.error, cut.response.displacement, False, False


def _rest(model: Model, target: Target, limits: AmplifierLimits) -> tuple[float, FloatArray]:
    """Return voltage and state before the path; the limits must allow that voltage."""
    demand_stack(model)
    rest, start = rest_at(model, float(target.displacement[0]))
    room = 1e-9 * model.values.get("u_rated", 1.0)
    if not limits.min_voltage - room <= rest <= limits.max_voltage + room:
        raise InputError(
            f"The path starts at {1e6 * target.displacement[0]:.4g} um, where the stack rests at"
            f" {rest:.4g} V, outside the voltage limits; widen them or move the path."
        )
    return float(np.clip(rest, limits.min_voltage, limits.max_voltage)), start


def _solve(
    model: Model, smooth: Model, target: Target, program: Program, guess: FloatArray,
    corrections: int, progress: Callable[[str], None],
) -> list[tuple[float, Solution]]:  # fmt: skip
    """Return every solution with its error by the full simulator [m], rms or largest.

    There are fewer, or none, where IPOPT finds no further one.
    """
    between = scipy.interpolate.PchipInterpolator(target.time, target.displacement)
    path = np.asarray(between(_nodes(target.time)))
    start, wanted = program.start * program.interval.nominal, path
    inner, _ = _at_nodes(smooth, target.time, guess, start)
    solutions: list[tuple[float, Solution]] = []
    for count in range(corrections + 1):
        progress(f"solution {count + 1} of {corrections + 1}")
        try:
            solution = program.solve(wanted, guess, inner)
        except NoSolutionError:
            break
        _, reached = _at_nodes(model, target.time, solution.voltage, start)
        off = np.abs(reached - path)
        size = np.max(off) if program.minimax else np.sqrt(np.mean(off**2))
        solutions.append((float(size), solution))
        guess, inner = solution.voltage, solution.inner
        wanted = path - (reached - solution.displacement)
    return solutions
