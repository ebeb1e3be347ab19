"""Poles of a response by vector fitting in time, without starting values.

With trial poles p_i and (x)_i the response of 1/(s - p_i) to x, least squares finds c, d of

    y + sum_i d_i (y)_i = constant + sum_i c_i (w)_i ;

the zeros of 1 + sum_i d_i/(s - p_i) are the next poles. First poles are real, spread evenly over
the decades that the record can show. Sources: Gustavsen and Semlyen, IEEE Trans. Power Delivery 14
(1999), 1052; Grivet-Talocia, IEEE Microwave and Wireless Components Letters 13 (2003), 472 (in
time). The realisation algorithms of python-control (`eigensys_realization`) need an impulse
response on uniform samples: differences of a step response, which amplify its noise.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from psa_casadi.identification.start.linear_response import (
    ComplexArray,
    FloatArray,
    mode,
    orthonormal,
)

_ROUNDS = 10
#: Least damping ratio of a pole, and the share of its mirror image that an unstable pole keeps.
_LEAST_DAMPING = 1e-3
_DECADES_BEYOND = 5.0


@dataclass(frozen=True, eq=False)
class Response:
    """Samples h [s] apart: input w (n,), output y (n,), both 0 before, `valid` (n,), noise sigma.

    Where `valid` is False, y holds a stand-in for the missing sample.
    """

    h: float
    w: FloatArray
    y: FloatArray
    valid: npt.NDArray[np.bool_]
    sigma: float


def vector_fit(responses: Sequence[Response], order: int) -> ComplexArray:
    """Return `order` poles [rad/s] in the left half plane that the responses share."""
    fastest = 2.0 * min(r.h for r in responses)
    slowest = max(r.h * r.y.size for r in responses) / 5.0
    spread = (np.arange(order) + 0.5) / order
    poles: ComplexArray = np.array(-1.0 / (fastest * (slowest / fastest) ** spread), dtype=complex)
    for _ in range(_ROUNDS):
        poles = _settled(_relocated(responses, poles), fastest, slowest)
    return poles


def contributions(responses: Sequence[Response], poles: ComplexArray) -> FloatArray:
    """Return the largest root mean square of every pole's own part of a response, over its noise.

    Shape (order,); the two poles of a pair share one figure.
    """
    found = np.zeros(poles.size)
    for r in responses:
        columns = _columns(poles, r.w, r.h)
        matrix = np.column_stack([columns, np.ones(r.y.size)])[r.valid]
        q, transform = orthonormal(matrix)
        weights = transform @ (q.T @ r.y[r.valid])
        for i, k in _places(poles):
            width = 2 if poles[i].imag else 1
            part = columns[:, k : k + width] @ weights[k : k + width]
            found[i : i + width] = np.maximum(found[i : i + width], np.std(part) / r.sigma)
    return found


def _relocated(responses: Sequence[Response], poles: ComplexArray) -> ComplexArray:
    """Return the zeros of the denominator that the trial poles give."""
    rows, targets = [], []
    for index, r in enumerate(responses):
        one = np.zeros((r.y.size, len(responses)))
        one[:, index] = 1.0
        y = -_columns(poles, r.y, r.h)
        rows.append(np.hstack([_columns(poles, r.w, r.h), one, y])[r.valid] / r.sigma)
        targets.append(r.y[r.valid] / r.sigma)
    q, transform = orthonormal(np.vstack(rows))
    d = (transform @ (q.T @ np.concatenate(targets)))[-poles.size :]
    state, drive, sense = np.zeros((poles.size, poles.size)), np.zeros(poles.size), d.copy()
    for i, k in _places(poles):
        p, size = poles[i], abs(poles[i])
        if p.imag:
            state[k : k + 2, k : k + 2] = [[p.real, p.imag], [-p.imag, p.real]]
            drive[k], sense[k : k + 2] = 2.0, size * d[k : k + 2] / 2.0 * np.array([1.0, -1.0])
        else:
            state[k, k], drive[k], sense[k] = p.real, 1.0, size * d[k]
    return np.linalg.eigvals(state - np.outer(drive, sense)).astype(np.complex128)


def _settled(poles: ComplexArray, fastest: float, slowest: float) -> ComplexArray:
    """Return the poles stable, damped, within reach of the records; pairs next to each other."""
    kept: list[complex] = []
    for p in poles[poles.imag >= 0]:
        size = min(max(abs(p), 1.0 / (_DECADES_BEYOND * slowest)), _DECADES_BEYOND / fastest)
        damping = max(abs(p.real) / max(abs(p), 1e-300), _LEAST_DAMPING)
        if p.imag:
            upper = size * complex(-damping, np.sqrt(max(1.0 - damping**2, 0.0)))
            kept += [upper, upper.conjugate()]
        else:
            kept.append(complex(-size))
    return np.array(kept, dtype=np.complex128)


def _places(poles: ComplexArray) -> list[tuple[int, int]]:
    """Return (index of the pole, first of its real columns) for real poles and upper ones."""
    return [(i, i) for i, p in enumerate(poles) if p.imag >= 0]


def _columns(poles: ComplexArray, x: FloatArray, h: float) -> FloatArray:
    """Return the responses of |p|/(s - p) to x, shape (n, order); real and imaginary for a pair."""
    columns: list[FloatArray] = []
    for p in poles:
        if p.imag >= 0:
            residues = (0.5, -0.5j) if p.imag else (1.0,)
            columns += [mode(complex(p), abs(p) * r, x, h) for r in residues]
    return np.column_stack(columns)
