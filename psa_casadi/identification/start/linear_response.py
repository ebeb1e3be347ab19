"""The exact response of eqs. (13), (15) with a drive in front, to voltages linear between samples.

    X/U = (b s + 1) / ((T s + 1) (tau s + 1) (q_P s^2 + a_P s + 1) (q_B s^2 + a_B s + 1))

T = R_s C_p, a = c/k [s] and q = m/k [s^2] of wafers (P) and bonding layers (B), r = k_P/k_B and
b = (c_P + c_B)/(k_P + k_B) = (r a_P + a_B)/(r + 1). The gain at rest is 1. The poles need not be
apart: those closer than `_APART` are moved apart, far less than a starting value needs.
"""

from math import exp, log, sqrt

import numpy as np
import numpy.typing as npt
import scipy

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

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
    found: FloatArray = scipy.signal.lfilter(upper, lower, x, axis=0)
    return found


def one_pole(pole: complex, x: FloatArray, h: float) -> ComplexArray:
    """Return the response (n,) of 1/(s - pole) to x (n,), as `mode` takes it, complex."""
    now, before, decay = _weights(pole, 1.0, h)
    found: ComplexArray = scipy.signal.lfilter(
        [now, before], [1.0, -decay], x.astype(np.complex128)
    )
    return found


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


def transfer(theta: FloatArray, frequency: FloatArray) -> ComplexArray:
    """Return X/U at the frequencies [Hz], shape (k,), gain 1 at rest."""
    s = 2j * np.pi * frequency
    whole = np.append(mechanics_poles(theta), -np.exp(-theta[0]))
    found: ComplexArray = (1.0 + numerator_time(theta) * s) / np.prod(
        1.0 - s[:, None] / whole, axis=1
    )
    return found


def plays(u: FloatArray, radii: npt.ArrayLike) -> FloatArray:
    """Return play operators (n, k) of the radii on u (n,), all of them centred at the first sample.

    p_i = min(max(p_{i-1}, u_i - r), u_i + r). A run of such steps clips between two levels, so the
    levels of all blocks are found side by side, then the blocks are joined.
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
    own: list[complex] = []
    real: list[float] = []
    for pole in poles[poles.imag >= 0]:
        size, moved = abs(pole), complex(pole)
        if pole.imag > _APART * size:
            while any(abs(moved - other) < _APART * size for other in own):
                moved *= 1.0 + _APART
            own += [moved, moved.conjugate()]
        else:
            real += [log(size), log(size)] if pole.imag else [log(size)]
    real.sort()
    for k in range(1, len(real)):
        real[k] = max(real[k], real[k - 1] + _APART)
    return np.array([*own, *(-exp(place) for place in real)], dtype=np.complex128)
