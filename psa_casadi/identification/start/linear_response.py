"""Exact responses of linear models: the stack's, poles by vector fitting, modes of a residual.

The exact response of eqs. (13), (15) with a drive in front, to voltages linear between samples.

    X/U = (b s + 1) / ((T s + 1) (tau s + 1) (q_P s^2 + a_P s + 1) (q_B s^2 + a_B s + 1))

T = R_s C_p, a = c/k [s] and q = m/k [s^2] of wafers (P) and bonding layers (B), r = k_P/k_B and
b = (c_P + c_B)/(k_P + k_B) = (r a_P + a_B)/(r + 1). The gain at rest is 1. The poles need not be
apart: those closer than `_APART` are moved apart, far less than a starting value needs.

Poles of a response by vector fitting in time, without starting values.

With trial poles p_i and (x)_i the response of 1/(s - p_i) to x, least squares finds c, d of

    y + sum_i d_i (y)_i = constant + sum_i c_i (w)_i ;

the zeros of 1 + sum_i d_i/(s - p_i) are the next poles. First poles are real, spread evenly over
the decades that the record can show. Sources: Gustavsen and Semlyen, IEEE Trans. Power Delivery 14
(1999), 1052; Grivet-Talocia, IEEE Microwave and Wireless Components Letters 13 (2003), 472 (in
time). The realisation algorithms of python-control (`eigensys_realization`) need an impulse
response on uniform samples: differences of a step response, which amplify its noise.

Modes that a residual shows: frequencies, dampings and residues, one by one, then all again.

What drives them is known, so that the response of a candidate is an exact filter. The residues are
linear and drop out; only the poles are sought (variable projection: Golub and Pereyra, Inverse
Problems 19 (2003) R1).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, log, sqrt

import numpy as np
import numpy.typing as npt
import scipy

from psa_casadi.common.units import BoolArray, ComplexArray, FloatArray
from psa_casadi.records.noise import filtered

#: Least relative distance of two poles.
_APART = 3e-3
#: Below this |p h| the filter's coefficients come from their series.
_SERIES = 0.03


def mode(pole: complex, residue: complex, x: FloatArray, h: float) -> FloatArray:
    """Return the response of residue/(s - pole) to x, from rest, at samples h [s] apart.

    x, shape (n,) or (n, k), is linear between its samples and 0 before them. A complex pole comes
    with its conjugate, so that the response is real: twice the real part.
    """
    now, before, decay = _weights(pole, residue, h)
    if pole.imag:
        other = np.conj(decay)
        upper = 2.0 * np.real([now, before - now * other, -before * other])
        lower = [1.0, -2.0 * np.real(decay), abs(decay) ** 2]
    else:
        upper, lower = np.real([now, before]), [1.0, -np.real(decay)]
    values: FloatArray = filtered(upper, lower, x)  # scipy.signal is slow to load
    return values


def _weights(pole: complex, residue: complex, h: float) -> tuple[complex, complex, complex]:
    """Return the weights of x now and a sample before, and what remains of the response."""
    z = pole * h
    if abs(z) < _SERIES:
        one = 1 + z / 2 + z**2 / 6 + z**3 / 24 + z**4 / 120
        two = 0.5 + z / 6 + z**2 / 24 + z**3 / 120 + z**4 / 720
    else:
        one = (np.exp(z) - 1) / z
        two = (np.exp(z) - 1 - z) / z**2
    return residue * h * two, residue * h * (one - two), np.exp(z)


def first_order(time_constant: float, x: FloatArray, h: float) -> FloatArray:
    """Return x behind the lag 1/(T s + 1), from rest."""
    return mode(complex(-1.0 / time_constant), 1.0 / time_constant, x, h)


def pair(a: float, q: float) -> ComplexArray:
    """Return the roots of q s^2 + a s + 1; a complex one comes with its conjugate behind it."""
    inside = a * a - 4.0 * q
    if inside < 0:
        root = complex(-a, sqrt(-inside)) / (2.0 * q)
        return np.array([root, root.conjugate()])
    wide = a + sqrt(inside)
    return np.array([-2.0 / wide, -wide / (2.0 * q)], dtype=np.complex128)


def mechanics_poles(theta: FloatArray) -> ComplexArray:
    """Return the poles behind the drive, theta = ln (T, tau, a_P, q_P, a_B, q_B, r)."""
    tau, a_p, q_p, a_b, q_b = np.exp(theta[1:6])
    return np.concatenate([[-1.0 / tau], pair(a_p, q_p), pair(a_b, q_b)])


def oscillators(theta: FloatArray, k_P: float, k_B: float) -> dict[str, float]:
    """Return c_P, m_P, c_B, m_B (SI) of theta for the stiffnesses [N/m]."""
    a_p, q_p, a_b, q_b = np.exp(theta).tolist()[2:6]
    return {"c_P": a_p * k_P, "m_P": q_p * k_P, "c_B": a_b * k_B, "m_B": q_b * k_B}


def numerator_time(theta: FloatArray) -> float:
    """Return b [s], so that the zero of the response is -1/b, eq. (11)."""
    r = exp(theta[6])
    return float((r * exp(theta[2]) + exp(theta[4])) / (r + 1.0))


def respond(poles: ComplexArray, b: float, x: FloatArray, h: float) -> FloatArray:
    """Return the response of (b s + 1)/prod(1 - s/p) to x, shape (n,) or (n, k), from rest.

    By partial fractions, each behind an exact filter.
    """
    poles = _apart(poles)
    total = np.zeros_like(x)
    for i, p in enumerate(poles):
        if p.imag < 0:
            continue
        residue = -p * (1.0 + b * p) / np.prod(1.0 - p / np.delete(poles, i))
        total += mode(complex(p), complex(residue), x, h)
    return total


def plays(u: FloatArray, radii: npt.ArrayLike) -> FloatArray:
    """Return play operators (n, k) of the radii on u (n,), all of them centred at the first sample.

    p_i = min(max(p_{i-1}, u_i - r), u_i + r). A run of such steps clips between two levels, so the
    levels of all blocks are computed side by side, then the blocks are joined.
    """
    r = np.asarray(radii, dtype=np.float64)
    length = max(int(sqrt(u.size)), 1)
    blocks = -(-u.size // length)
    padded = np.concatenate([u, np.full(blocks * length - u.size, u[-1])]).reshape(blocks, length)
    steps = np.ascontiguousarray(padded.T)[:, :, None]
    bottom, top = steps - r, steps + r
    levels = np.empty((length, 2, blocks, r.size))  # the lower and the upper one of every block
    levels[0, 0], levels[0, 1] = bottom[0], top[0]
    for i in range(1, length):
        np.maximum(levels[i - 1], bottom[i], out=levels[i])
        np.minimum(levels[i], top[i], out=levels[i])
    before = np.empty((blocks, r.size))
    state = np.full(r.size, u[0])
    for k, (low, high) in enumerate(zip(*levels[-1], strict=True)):
        before[k] = state
        state = np.minimum(np.maximum(state, low), high)
    out = np.minimum(np.maximum(before, levels[:, 0]), levels[:, 1])
    return out.transpose(1, 0, 2).reshape(blocks * length, r.size)[: u.size]


def orthonormal(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return Q (n, j), orthonormal, that spans the columns of a matrix (n, k), and T: Q = matrix T.

    From the columns' products, twice; directions below 1e-7 of the largest are left out. For tall
    matrices this is as good as Householder's QR and does not start threads for a millisecond's
    work.
    """
    scale = np.linalg.norm(matrix, axis=0)
    q = matrix / np.where(scale > 0, scale, 1.0)
    transform: FloatArray = np.diag(1.0 / np.where(scale > 0, scale, 1.0))
    for _ in range(2):
        values, vectors = np.linalg.eigh(q.T @ q)
        large = values > 1e-14 * np.max(values, initial=1e-300)
        step = vectors[:, large] / np.sqrt(values[large])
        q, transform = q @ step, transform @ step
    return q, transform


def _apart(poles: ComplexArray) -> ComplexArray:
    """Return the poles in conjugate pairs, each about `_APART` or more from every other."""
    complex_poles: list[complex] = []
    real: list[float] = []
    for pole in poles[poles.imag >= 0]:
        size, moved = abs(pole), complex(pole)
        if pole.imag > _APART * size:
            while any(abs(moved - other) < _APART * size for other in complex_poles):
                moved *= 1.0 + _APART
            complex_poles += [moved, moved.conjugate()]
        else:
            real += [log(size), log(size)] if pole.imag else [log(size)]
    real.sort()
    for k in range(1, len(real)):
        real[k] = max(real[k], real[k - 1] + _APART)
    return np.array([*complex_poles, *(-exp(place) for place in real)], dtype=np.complex128)


_ROUNDS = 10
#: Least damping ratio of a pole, and the share of its mirror image that an unstable pole keeps.
_LEAST_DAMPING = 1e-3
_DECADES_BEYOND = 5.0


@dataclass(frozen=True, eq=False)
class Response:
    """Samples h [s] apart: input w (n,), output y (n,), both 0 before, `valid` (n,), noise sigma.

    Where `valid` is False, y does not count, as of a sample that is missing. The modes of a
    residual y need no sigma, and of the input w only its change from the first sample.
    """

    h: float
    w: FloatArray
    y: FloatArray
    valid: BoolArray
    sigma: float = 1.0


def vector_fit(r: Response, order: int) -> ComplexArray:
    """Return `order` poles [rad/s] of a response in the left half plane."""
    fastest, slowest = 2.0 * r.h, r.h * r.y.size / 5.0
    spread = (np.arange(order) + 0.5) / order
    poles: ComplexArray = np.array(-1.0 / (fastest * (slowest / fastest) ** spread), dtype=complex)
    for _ in range(_ROUNDS):
        poles = _settled(_relocated(r, poles), fastest, slowest)
    return poles


def contributions(r: Response, poles: ComplexArray) -> FloatArray:
    """Return the root mean square of every pole's part of a response, over its noise.

    Shape (order,); the two poles of a pair share one figure.
    """
    values, columns = np.zeros(poles.size), _columns(poles, r.w, r.h)
    q, transform = orthonormal(np.column_stack([columns, np.ones(r.y.size)])[r.valid])
    weights = transform @ (q.T @ r.y[r.valid])
    for k in np.flatnonzero(poles.imag >= 0):
        pair = slice(k, k + (2 if poles[k].imag else 1))
        values[pair] = np.std(columns[:, pair] @ weights[pair]) / r.sigma
    return values


def _relocated(r: Response, poles: ComplexArray) -> ComplexArray:
    """Return the zeros of the denominator that the trial poles give."""
    one, y = np.ones(r.y.size), -_columns(poles, r.y, r.h)
    rows = np.column_stack([_columns(poles, r.w, r.h), one, y])[r.valid] / r.sigma
    q, transform = orthonormal(rows)
    d = (transform @ (q.T @ (r.y[r.valid] / r.sigma)))[-poles.size :]
    state, drive, sense = np.zeros((poles.size, poles.size)), np.zeros(poles.size), d.copy()
    for k in np.flatnonzero(poles.imag >= 0):
        p, size = poles[k], abs(poles[k])
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


def _columns(poles: ComplexArray, x: FloatArray, h: float) -> FloatArray:
    """Return the responses of |p|/(s - p) to x, shape (n, order); real and imaginary for a pair."""
    columns: list[FloatArray] = []
    for p in poles:
        if p.imag >= 0:
            residues = (0.5, -0.5j) if p.imag else (1.0,)
            columns += [mode(complex(p), abs(p) * r, x, h) for r in residues]
    return np.column_stack(columns)


#: Frequencies and damping ratios among which the next mode is looked for: the highest frequency
#: over the sampling rate, and the lowest as periods in the longest record.
_FREQUENCIES, _DAMPINGS = 160, (0.004, 0.015, 0.06)
_HIGHEST, _PERIODS = 0.45, 8.0
#: What rings has a damping ratio below this one.
MOST_DAMPED, _LEAST_DAMPED = 0.2, 1e-3
#: Evaluations over all poles after each new mode.
_EVALUATIONS = 6


@dataclass(frozen=True)
class Mode:
    """A mode: frequency [Hz], damping ratio, share of the drive in phase with it and ahead."""

    frequency: float
    damping: float
    share: float
    ahead: float


def modes_of(
    records: Sequence[Response], free: FloatArray, *, most: int, better: float
) -> list[Mode]:
    """Return modes while each brings the rms of the residual to a share `better` at most.

    `free` (samples that count, k) are directions of the residual that are free to follow.
    """
    basis, _ = orthonormal(free)

    def without_free(x: FloatArray) -> FloatArray:
        projected: FloatArray = x - basis @ (basis.T @ x)
        return projected

    def columns(poles: FloatArray) -> FloatArray:
        return without_free(np.hstack([_ringing(records, *np.exp(p)) for p in poles]))

    def left_of(what: FloatArray, poles: FloatArray) -> FloatArray:
        """Return what the modes leave, with the best residues; poles are ln (f, zeta)."""
        q, _ = orthonormal(columns(poles))
        rest: FloatArray = what - q @ (q.T @ what)
        return rest

    target = without_free(np.concatenate([r.y[r.valid] for r in records]))
    size = float(np.linalg.norm(target))

    def of_all(flat: FloatArray) -> FloatArray:
        return left_of(target, flat.reshape(-1, 2)) / size

    lowest = _PERIODS / max(r.h * r.w.size for r in records)
    highest = _HIGHEST / min(r.h for r in records)
    frequencies = np.log(np.geomspace(min(lowest, 0.1 * highest), highest, _FREQUENCIES))
    grid = [np.array([f, np.log(z)]) for f in frequencies for z in _DAMPINGS]
    edges = (
        [frequencies[0] - 1.0, np.log(_LEAST_DAMPED)],
        [frequencies[-1] + 0.1, np.log(MOST_DAMPED)],
    )
    poles, left = np.zeros((0, 2)), target
    while len(poles) < most:
        rests = [float(np.sum(left_of(left, pole[None]) ** 2)) for pole in grid]
        trial = np.vstack([poles, grid[int(np.argmin(rests))]])
        low, high = (np.tile(edge, len(trial)) for edge in edges)
        result = scipy.optimize.least_squares(  # all poles moved to where their modes leave less
            of_all,
            np.clip(trial.ravel(), low + 1e-6, high - 1e-6),
            bounds=(low, high),
            x_scale=np.tile([0.01, 0.3], len(trial)),
            max_nfev=_EVALUATIONS,
        )
        trial = result.x.reshape(-1, 2)
        rest = left_of(target, trial)
        if np.linalg.norm(rest) > better * np.linalg.norm(left):
            break
        poles, left = trial, rest
    if not len(poles):
        return []
    gains = np.linalg.lstsq(columns(poles), target, rcond=None)[0].reshape(-1, 2)
    return [Mode(*np.exp(p), *g) for p, g in zip(poles, gains, strict=True)]


def _ringing(records: Sequence[Response], frequency: float, damping: float) -> FloatArray:
    """Return q and q'/w of a mode, q'' + 2 zeta w q' + w^2 q = w^2 drive, from rest (n, 2)."""
    omega = 2.0 * np.pi * frequency
    turn = np.sqrt(1.0 - damping**2)
    pole = omega * complex(-damping, turn)
    rows = []
    for r in records:
        both = [mode(pole, -0.5j * q / turn, r.w - r.w[0], r.h) for q in (omega, pole)]
        rows.append(np.column_stack(both)[r.valid])
    return np.vstack(rows)
