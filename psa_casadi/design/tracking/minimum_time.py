"""The quickest voltage that moves a stack from rest at one position to rest at another.

N intervals of equal length share the move of length T, the voltage linear on each. What the states
without memory, x, do is linear in the voltage but for the forces of hysteresis and effects. So a
linear program asks for the least T for which some voltage within the limits brings x to rest,

    a x(T) + b v_N + f = 0,   c x(T) + d = end,   x(T) = G v + g,

and the full simulator plays its answer. The difference at the end between the two goes into f, d
and g, and the program is solved again, until the simulator itself arrives at rest: no smooth form,
and no discretisation but the stepper's own, is in the result. The voltage then holds its last
value.
"""

import time as clocks
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from psa_casadi.design.tracking.linear_move import LinearMove, Offsets, linear_move
from psa_casadi.design.tracking.targets import AmplifierLimits, Response, move_ends, respond
from psa_casadi.errors import PsaError
from psa_casadi.model.compose import Model
from psa_casadi.units import FloatArray

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
    rest, _ = move_ends(model, begin, end, limits)
    linear = linear_move(model, rest, end, limits, intervals)
    length, voltage = linear.shortest(linear.no_offsets())
    linear_time = length
    plays = _plays(model, linear, length, voltage, progress)
    best = min(plays[_FREE:], key=lambda p: p.distance)
    if not best.distance < 1e-2:
        raise PsaError(
            "No quickest move was found: the trials on the simulator do not settle. Effects that"
            " outweigh the linear part are the likely cause; use a path (--target) instead."
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
        offsets = linear.offsets(length, voltage, plays[-1].arrival, plays[-1].memory)
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
    """What the simulator says: the response, the state on arrival, how far that is from rest.

    `distance` is the larger of the hold's swing and its offset, over the move.
    """

    length: float
    response: Response
    arrival: FloatArray
    memory: Offsets
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
    found = respond(model, time, whole)
    held, hold = found.displacement[n + 1 :], time[n + 1 :]
    slow = np.polynomial.Polynomial.fit(hold, held, 2)(hold)
    swing, position = float(np.max(np.abs(held - slow))), float(slow[0])
    state = found.states[n + 1]
    forces = linear.forces(float(time[n + 1]), state, float(voltage[-1]))
    distance = max(swing, abs(position - end)) / abs(linear.travel)
    return _Play(length, found, state[linear.fast], forces, position, swing, distance)
