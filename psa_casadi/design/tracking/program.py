"""A tracking program for IPOPT: collocated equations, a path, and the amplifier's limits."""

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from psa_casadi.component import Expression
from psa_casadi.design.tracking.collocation import Chain, Interval, chain
from psa_casadi.design.tracking.targets import AmplifierLimits
from psa_casadi.errors import PsaError
from psa_casadi.interruption import raise_if_stopped
from psa_casadi.units import FloatArray

#: Price of the voltage's second differences over the voltage scale, beside errors over the range.
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
class Problem:
    """What is asked: instants (n,) [s], range of the path [m], voltage at rest and its scale [V].

    `start` (nx,) is the state before the first sample, over nominal. The voltage stays at `rest`
    over the first interval, so that every simulator starts at rest. `minimax` asks for the least
    largest error instead of the least mean square.
    """

    interval: Interval
    time: FloatArray
    span: float
    rest: float
    scale: float
    start: FloatArray
    limits: AmplifierLimits
    minimax: bool = False
    tolerance: float = 1e-8
    iterations: int = 150
    symbolic: bool = True

    @property
    def limited(self) -> bool:
        """Say whether something else than the squares of the errors shapes the answer."""
        b = self.limits
        finite = np.isfinite([b.min_voltage, b.max_voltage, b.max_rate, b.max_current])
        return bool(self.minimax or finite.any())


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


class Program:
    """A problem set up once and solved for paths that may change from solve to solve."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        count, nx = len(problem.time) - 1, len(problem.start)
        size = 2 * nx * count
        self._x = ca.MX.sym("x", size + count - 1 + int(problem.minimax))
        self._path = ca.MX.sym("path", 2 * count)
        inner = ca.reshape(self._x[:size], 2 * nx, count)
        first = ca.DM([[problem.rest, problem.rest]])
        free = self._x[size : size + count - 1]
        self._voltage = ca.horzcat(first, (problem.scale * free).T)
        clock = np.vstack([problem.time[:-1], np.diff(problem.time)])
        self._chain: Chain = chain(problem.interval, problem.start, inner, self._voltage, clock)
        self._errors = (ca.vec(self._chain.displacement) - self._path) / problem.span
        self._rows, self._low, self._high = self._constraints(clock[1])
        self._solver = self._build()
        self._outputs = ca.Function("outputs", [self._x], [self._chain.displacement])

    def solve(self, path: FloatArray, voltage: FloatArray, inner: FloatArray) -> Solution:
        """Solve for a path (2, N) [m] at the nodes from a first guess of voltage and states.

        Raises NoSolutionError if IPOPT finds none.
        """
        q = self.problem
        guess = [inner.T.ravel(), voltage[2:] / q.scale, np.full(int(q.minimax), 1e-2)]
        low = np.full(self._x.shape[0], -np.inf)
        high = -low
        free = slice(inner.size, inner.size + len(voltage) - 2)
        low[free], high[free] = q.limits.min_voltage / q.scale, q.limits.max_voltage / q.scale
        found = self._solver(
            x0=np.concatenate(guess), p=path.T.ravel(), lbx=low, ubx=high,
            lbg=self._low, ubg=self._high,
        )  # fmt: skip
        raise_if_stopped()  # which the solver takes for a failure
        stats = self._solver.stats()
        off = np.maximum(np.array(found["g"]).ravel() - self._high, 0.0)
        if not stats["success"] and not np.max(off) < _FEASIBLE:
            raise NoSolutionError(
                f"IPOPT found no voltage ({stats['return_status']}). Limits that leave the path no"
                " room, or a path far beyond the stack's bandwidth, are the likely cause; widen"
                " the limits or slow the path down."
            )
        x = np.array(found["x"]).ravel()
        return Solution(
            np.concatenate([[q.rest, q.rest], q.scale * x[free]]),
            x[: inner.size].reshape(inner.T.shape).T,
            np.array(self._outputs(found["x"])),
            int(stats["iter_count"]),
            bool(stats["success"]),
        )

    def _constraints(self, lengths: FloatArray) -> tuple[Expression, FloatArray, FloatArray]:
        """Return rows with their bounds: equations, rate, current, and the largest error."""
        q = self.problem
        residual: Expression = ca.vec(self._chain.residual)
        rows, tops = [residual], [np.zeros(residual.shape[0])]
        if np.isfinite(q.limits.max_rate):
            relative: Expression = ca.diff(self._voltage, 1, 1)[1:].T / (
                q.limits.max_rate * lengths[1:]
            )
            rows, tops = [*rows, relative], [*tops, np.ones(relative.shape[0])]
        if np.isfinite(q.limits.max_current):
            passed: Expression = ca.vec(self._chain.current)
            relative = passed / q.limits.max_current
            rows, tops = [*rows, relative], [*tops, np.ones(relative.shape[0])]
        lows = [-top for top in tops]
        if q.minimax:
            largest = self._x[-1]
            rows += [self._errors - largest, -self._errors - largest]
            tops += [np.zeros(self._errors.shape[0])] * 2
            lows += [np.full(self._errors.shape[0], -np.inf)] * 2
        return ca.vertcat(*rows), np.concatenate(lows), np.concatenate(tops)

    def _build(self) -> ca.Function:
        """Return the solver.

        Where only squares of errors count, its Hessian is that of their sum (Gauss and Newton): the
        Lagrangian's where the error vanishes, without second derivatives of the equations, which an
        imported FMU does not have. Elsewhere it is the exact one, of equations that are symbolic.
        """
        q = self.problem
        bends: Expression = PRICE * ca.diff(self._voltage, 2, 1).T / q.scale
        share = _REST if q.minimax else 1.0
        terms = ca.vertcat(
            self._errors * np.sqrt(share / self._errors.shape[0]),
            bends / np.sqrt(bends.shape[0]),
        )
        cost = WEIGHT * ca.sumsqr(terms)
        slopes = ca.jacobian(terms, self._x)
        sigma = ca.MX.sym("sigma")
        multipliers = ca.MX.sym("multipliers", self._rows.shape[0])
        hessian = ca.triu(2.0 * WEIGHT * sigma * slopes.T @ slopes)
        arguments = [self._x, self._path, sigma, multipliers]
        barrier = _BARRIER_LIMITED if q.limited else _BARRIER
        options: dict[str, Any] = {
            "print_time": False,
            "ipopt": {
                "print_level": 0, "sb": "yes", "tol": q.tolerance, "max_iter": q.iterations,
                "mu_init": barrier,
            },
        }  # fmt: skip
        if not (q.limited and q.symbolic):
            options["hess_lag"] = ca.Function("hessian", arguments, [hessian])
        goal = cost + self._x[-1] * 100.0 if q.minimax else cost
        program = {"x": self._x, "p": self._path, "f": goal, "g": self._rows}
        return ca.nlpsol("tracking", "ipopt", program, options)
