"""The quickest voltage that moves a stack from rest at one position to rest at another.

N intervals of equal length share the move of length T, the voltage linear on each. What the states
without memory, x, do is linear in the voltage but for the forces of hysteresis and effects. So a
linear program asks for the least T for which some voltage within the limits brings x to rest,

    a x(T) + b v_N + f = 0,   c x(T) + d = end,   x(T) = G v + g,

and the full simulator plays its answer. The difference at the end between the two goes into f, d
and g, and the program is solved again, until the simulator itself arrives at rest: no smooth form,
and no discretisation but the stepper's, is in the result. The voltage then holds its last
value.
"""

import time as clocks
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from psa_casadi.common.errors import PsaError
from psa_casadi.common.units import FloatArray
from psa_casadi.design.tracking.targets import (
    AmplifierLimits,
    Response,
    behind_drive,
    move_start,
    respond,
)
from psa_casadi.model.compose import Model
from psa_casadi.simulation.start import slopes_at_rest

_SLACK = 1e-7  # sum of the distances from rest, over nominal, that counts as arrived
_PRECISION = 1e-3  # of the length
_PERIODS = 100.0  # longest move, over the slowest time constant


@dataclass(frozen=True, eq=False)
class Offsets:
    """What the linear part does not know: of the state (nf,), its rates (nf,), the position [m]."""

    state: FloatArray
    rates: FloatArray
    position: float


@dataclass(frozen=True, eq=False)
class LinearMove:
    """A move of the states without memory (over nominal): x' = a x + b v, d = c x [m].

    `fast` are their rows in the state vector; the voltage starts at `rest` [V] with the state
    `start` (nf,), and has n intervals.
    """

    model: Model
    fast: list[int]
    a: FloatArray
    b: FloatArray
    c: FloatArray
    start: FloatArray
    rest: float
    end: float
    travel: float
    limits: AmplifierLimits
    n: int

    def offsets(
        self, length: float, voltage: FloatArray, time: float, arrival: FloatArray
    ) -> Offsets:
        """Return the offsets for which the program arrives where the simulator did.

        What is left of the model's rates and displacement at the `arrival` (nx,), at a time [s], is
        what the linear part does not know.
        """
        m, rows = self.model, self.fast
        size = m.state_nominals()[rows]
        gain, free = self._march(length)
        state = arrival[rows] / size - gain @ voltage[1:] - free
        last = float(voltage[-1])
        u = [last if i.name == "voltage" else i.start for i in m.structure.inputs]
        xdot, y = m.structure.f(time, arrival, u, m.parameter_vector())
        x = arrival[rows] / size
        rates = np.array(xdot).ravel()[rows] / size - self.a @ x - self.b * last
        displacement = float(y[m.output_names.index("displacement")])
        return Offsets(state, rates, displacement - float(self.c @ x))

    def shortest(self, offsets: Offsets) -> tuple[float, FloatArray]:
        """Return the least length [s] by halving, and its voltage (n + 1,) [V]."""
        slowest = float(np.max(1.0 / np.abs(np.linalg.eigvals(self.a))))
        low, high = 0.0, slowest
        values = self._arrive(high, offsets)
        while values is None:
            low, high = high, 2.0 * high
            if high > _PERIODS * slowest:
                raise PsaError(
                    "No voltage within the limits makes the move; widen them, or move less far."
                )
            values = self._arrive(high, offsets)
        while high - low > _PRECISION * high:
            middle = 0.5 * (low + high)
            tried = self._arrive(middle, offsets)
            if tried is None:
                low = middle
            else:
                high, values = middle, tried
        return high, np.concatenate([[self.rest], values])

    def nearest(self, length: float, voltage: FloatArray, offsets: Offsets) -> FloatArray | None:
        """Return the voltage that arrives and at most differs least from another; None if none."""
        answer = self._program(length, offsets, voltage[1:])
        return np.concatenate([[self.rest], answer.x[: self.n]]) if answer.status == 0 else None

    def _arrive(self, length: float, offsets: Offsets) -> FloatArray | None:
        """Return a voltage (n,) that arrives in a length [s], None if none does."""
        answer = self._program(length, offsets)
        arrives = answer.status == 0 and answer.fun < _SLACK
        return np.asarray(answer.x[: self.n]) if arrives else None

    def _program(self, length: float, offsets: Offsets, near: FloatArray | None = None) -> Any:
        """Solve for the voltage (n,) with the least distances from rest and position.

        Or, with `near` (n,), for the one that arrives with the least largest difference from it.
        """
        matrix, right = self._conditions(length, offsets)
        rows, tops = self._limited(length)
        n, k = self.n, len(right)
        if near is None:
            equal = np.hstack([matrix, np.eye(k), -np.eye(k)])
            upper = np.hstack([rows, np.zeros((len(rows), 2 * k))])
        else:
            equal, tops = np.hstack([matrix, np.zeros((k, 1))]), np.concatenate([tops, near, -near])
            sides = np.hstack([np.vstack([np.eye(n), -np.eye(n)]), -np.ones((2 * n, 1))])
            upper = np.vstack([np.hstack([rows, np.zeros((len(rows), 1))]), sides])
        more = equal.shape[1] - n
        return scipy.optimize.linprog(
            np.r_[np.zeros(n), np.ones(more)], A_ub=upper, b_ub=tops, A_eq=equal, b_eq=right,
            bounds=[(self.limits.min_voltage, self.limits.max_voltage)] * n + [(0.0, None)] * more,
        )  # fmt: skip

    def _conditions(self, length: float, offsets: Offsets) -> tuple[FloatArray, FloatArray]:
        """Return the rows of rest and position, times the voltage (n,), and what they must give.

        Rest is required as x(T) = -a^-1 (b v_N + f), so that every row counts in nominals.
        """
        gain, free = self._march(length)
        free = free + offsets.state
        level = -np.linalg.solve(self.a, self.b)
        still = -np.linalg.solve(self.a, offsets.rates)
        rest = gain.copy()
        rest[:, -1] -= level
        size = abs(self.travel)
        place = (self.c @ gain) / size
        reach = (self.end - offsets.position - self.c @ free) / size
        return np.vstack([rest, place]), np.concatenate([still - free, [reach]])

    def _limited(self, length: float) -> tuple[FloatArray, FloatArray]:
        """Return rows times the voltage (n,) that must not pass `tops`: rate and current."""
        n, h, rows, tops = self.n, length / self.n, [], []
        change = np.eye(n) - np.eye(n, k=-1)
        if np.isfinite(self.limits.max_rate):
            first = np.r_[self.rest, np.zeros(n - 1)]
            rows += [change, -change]
            tops += [self.limits.max_rate * h + first, self.limits.max_rate * h - first]
        if np.isfinite(self.limits.max_current):
            gain, free = self._current(h)
            rows += [gain, -gain]
            tops += [self.limits.max_current - free, self.limits.max_current + free]
        return (np.vstack(rows) if rows else np.zeros((0, n))), np.concatenate([*tops, []])

    def _current(self, h: float) -> tuple[FloatArray, FloatArray]:
        """Return i_k = (G v_k - u_k) / R_s at the knots: times the voltage, and rest."""
        p = self.model.values
        u = behind_drive(self.model, h, np.eye(self.n), 0.0)
        free = behind_drive(self.model, h, np.zeros(self.n), self.rest)
        scale = p["G"] / p["R_s"]
        return scale * (np.eye(self.n) - u), -scale * free

    def _march(self, length: float) -> tuple[FloatArray, FloatArray]:
        """Return x(T) as `gain` (nf, n) times the voltage plus `free` (nf,), for lines between."""
        nf, n, h = len(self.a), self.n, length / self.n
        block = np.zeros((nf + 2, nf + 2))
        block[:nf, :nf], block[:nf, nf], block[nf, nf + 1] = self.a * h, self.b * h, 1.0
        power = scipy.linalg.expm(block)
        step, later = power[:nf, :nf], power[:nf, nf + 1]
        before = power[:nf, nf] - later
        gain, free = np.zeros((nf, n)), self.start
        for k in range(n):
            gain, free = step @ gain, step @ free
            if k:
                gain[:, k - 1] += before
            else:
                free = free + before * self.rest
            gain[:, k] += later
        return gain, free


def linear_move(
    model: Model, rest: float, end: float, limits: AmplifierLimits, intervals: int
) -> LinearMove:
    """Return the linear part of a stack's move from rest at a voltage [V] to a position [m]."""
    fast = [k for k, s in enumerate(model.structure.states) if not s.memory]
    size = model.state_nominals()[fast]
    a, b, c = slopes_at_rest(model)
    scaled = a[np.ix_(fast, fast)] * size / size[:, None]
    column, row = b[fast] / size, c[fast] * size
    start: FloatArray = np.asarray(-np.linalg.solve(scaled, column) * rest, dtype=float)
    return LinearMove(
        model, fast, scaled, column, row, start, rest, end, end - float(row @ start), limits,
        intervals,
    )  # fmt: skip


#: Intervals of the move, and length of the hold behind it over that of the move.
INTERVALS, HOLD = 120, 4
_FREE, _FIXED = 6, 14  # solutions with the length open, then with the length kept
_MARGIN = 1.003  # of the last open length: room for the corrections that follow
_GOOD = 1e-6  # distance from rest at the end, over the move, that is good enough


@dataclass(frozen=True, eq=False)
class QuickMove:
    """A quickest move: its length [s], the simulator's response with a hold behind it, and errors.

    The voltage leaves its rest at `start_time` [s], one interval after the first sample, and holds
    from `start_time + move_time` on. `residual` is the largest distance of the displacement in the
    hold from its slow course (a parabola), `offset` the hold's first position less `end`, both over
    the move. `linear_time` [s] is what the linear part alone would need on as many intervals.
    """

    begin: float
    end: float
    limits: AmplifierLimits
    move_time: float
    start_time: float
    linear_time: float
    response: Response
    residual: float
    offset: float
    solutions: int
    seconds: float


def quickest_move(
    model: Model,
    begin: float,
    end: float,
    limits: AmplifierLimits,
    *,
    intervals: int = INTERVALS,
    progress: Callable[[str], None] = lambda step: None,
) -> QuickMove:
    """Return the quickest move between two positions [m] within the limits.

    Both voltage limits are needed. Raises InputError for a model that is no stack, equal positions,
    limits that are missing or do not hold one of the positions, and PsaError if there is no move.
    """
    started = clocks.perf_counter()
    rest = move_start(model, begin, end, limits)
    linear = linear_move(model, rest, end, limits, intervals)
    none = np.zeros(len(linear.fast))
    length, voltage = linear.shortest(Offsets(none, none, 0.0))
    linear_time = length
    plays = _plays(model, linear, length, voltage, progress)
    best = min(plays[_FREE:], key=lambda p: p.distance)
    if not best.distance < 1e-2:
        raise PsaError(
            "The search for the quickest move failed: the trials on the simulator do not settle."
            " Effects that outweigh the linear part are the likely cause; use a path"
            " (--target) instead."
        )
    return QuickMove(
        begin, end, limits, best.length, best.length / intervals, linear_time, best.response,
        best.swing / abs(end - begin), (best.position - end) / abs(end - begin), len(plays),
        clocks.perf_counter() - started,
    )  # fmt: skip


def _plays(
    model: Model, linear: LinearMove, length: float, voltage: FloatArray,
    progress: Callable[[str], None],
) -> "list[_Play]":  # fmt: skip
    """Play and correct: first with the length open, then, a little longer, with it kept."""
    plays: list[_Play] = []
    for count in range(_FREE + _FIXED):
        progress(f"solution {count + 1} of at most {_FREE + _FIXED}")
        plays.append(_play(model, linear, length, voltage, linear.end))
        if count >= _FREE and plays[-1].distance < _GOOD:
            break
        last, n = plays[-1].response, linear.n + 1
        offsets = linear.offsets(length, voltage, float(last.time[n]), last.states[n])
        if count < _FREE:
            length, voltage = linear.shortest(offsets)
            continue
        if count == _FREE:
            length *= _MARGIN
        near = linear.nearest(length, voltage, offsets)
        if near is None:
            length *= _MARGIN
        else:
            voltage = near
    return plays


@dataclass(frozen=True, eq=False)
class _Play:
    """The simulator's result: the response, and how far its end is from rest.

    `distance` is the larger of the hold's swing and its offset, over the move.
    """

    length: float
    response: Response
    position: float
    swing: float
    distance: float


def _play(
    model: Model, linear: LinearMove, length: float, voltage: FloatArray, end: float
) -> _Play:
    """Simulate a move between one interval of rest and a hold of `HOLD` moves."""
    n = len(voltage) - 1
    time: FloatArray = np.asarray(length / n * np.arange(n + 2 + HOLD * n), dtype=float)
    whole = np.concatenate([voltage[:1], voltage, np.full(HOLD * n, voltage[-1])])
    response = respond(model, time, whole)
    held, hold = response.displacement[n + 1 :], time[n + 1 :]
    slow = np.polynomial.Polynomial.fit(hold, held, 2)(hold)
    swing, position = float(np.max(np.abs(held - slow))), float(slow[0])
    distance = max(swing, abs(position - end)) / abs(linear.travel)
    return _Play(length, response, position, swing, distance)
