"""Hysteresis with complete memory of its reversals: a Preisach operator of a density that depends
on the difference of the two thresholds alone.

    R = R_r + d G(|u - u_r|),   d = sgn(u'),   (u_r, R_r) the last reversal that is not wiped out

A branch that passes the reversal before the last closes its loop there and wipes both out
(Madelung's rules). Equal spans give equal loops (congruence), so the branches meet exactly. Source:
I. D. Mayergoyz, "Mathematical Models of Hysteresis", ch. 1.
"""

from collections.abc import Callable

import numpy as np

from tests.studies.plants.stack import FloatArray

Branch = Callable[[FloatArray], FloatArray]
Places = np.ndarray[tuple[int, ...], np.dtype[np.intp]]


def turning_points(voltage: FloatArray) -> Places:
    """Positions of the reversals with the first and the last sample."""
    direction = np.sign(np.diff(voltage))
    moving = np.flatnonzero(direction)
    turns = moving[1:][direction[moving[1:]] != direction[moving[:-1]]]
    return np.concatenate(([0], turns, [voltage.size - 1])).astype(np.intp)


def since_reversal(voltage: FloatArray) -> FloatArray:
    """Distance from the last reversal, (M,) [V], at least 0."""
    turns = turning_points(voltage)
    last = np.searchsorted(turns[1:-1], np.arange(voltage.size), side="left")
    return np.abs(voltage - voltage[turns[:-1]][last])


def with_memory(voltage: FloatArray, branch: Branch) -> FloatArray:
    """R along a voltage, (M,); `branch` is G, with G(0) = 0. R = 0 at the lowest voltage."""
    bottom = float(voltage.min())
    memory = [(bottom, 0.0)]
    state = float(branch(np.array([voltage[0] - bottom]))[0])
    out = np.full(voltage.size, state)
    turns = turning_points(voltage)
    for first, last in zip(turns[:-1].tolist(), turns[1:].tolist(), strict=True):
        piece = voltage[first : last + 1]
        sign = 1.0 if piece[-1] >= piece[0] else -1.0
        if len(memory) > 1 or sign < 0.0:
            memory.append((float(piece[0]), state))
        out[first : last + 1] = _piece(memory, piece, sign, branch)
        state = float(out[last])
    return out


def _piece(
    memory: list[tuple[float, float]], piece: FloatArray, sign: float, branch: Branch
) -> FloatArray:
    """One monotone piece; closes the loops that it passes."""
    start, level = memory[-1]
    out = level + sign * branch(np.abs(piece - start))
    while len(memory) > 2 and sign * (float(piece[-1]) - memory[-2][0]) > 0.0:
        passed = memory[-2][0]
        del memory[-2:]
        start, level = memory[-1]
        beyond = sign * (piece - passed) > 0.0
        out[beyond] = level + sign * branch(np.abs(piece[beyond] - start))
    return np.asarray(out, dtype=np.float64)
