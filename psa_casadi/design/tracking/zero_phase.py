"""The zero-phase inverse of a stack's linear part."""

import numpy as np

from psa_casadi.simulation.linear_part import LinearPart
from psa_casadi.units import FloatArray

#: Response over that at rest, below which the inverse rolls off.
ROLL_OFF = 0.03


def zero_phase_inverse(part: LinearPart, wanted: FloatArray, step: float) -> FloatArray:
    """Return the voltage (n,) for a displacement (n,) sampled every `step` [s].

    V(w) = D(w) H*(w) / (|H(w)|^2 + (ROLL_OFF |H(0)|)^2), H the linear part's response times
    sinc^2(w step / 2) of the line between samples: the exact inverse where the stack responds,
    rolling off without phase where it does not. The path is taken as settled before its first
    sample, and comes back to it behind the last one.
    """
    n = len(wanted)
    pad = _padding(part, step, n)
    back = 0.5 * (1.0 + np.cos(np.pi * np.arange(1, pad + 1) / (pad + 1)))
    tail = wanted[0] + (wanted[-1] - wanted[0]) * back
    path = np.concatenate([np.full(pad, wanted[0]), wanted, np.full(pad, wanted[-1]), tail])
    omega: FloatArray = np.asarray(2.0 * np.pi * np.fft.rfftfreq(len(path), step), dtype=float)
    response = part.response(omega) * np.sinc(omega * step / (2.0 * np.pi)) ** 2
    floor = (ROLL_OFF * abs(part.response(np.zeros(1))[0])) ** 2
    inverse = response.conj() / (np.abs(response) ** 2 + floor)
    inverse[0] = 1.0 / response[0].real
    voltage = np.fft.irfft(np.fft.rfft(path) * inverse, len(path))
    return np.asarray(voltage[pad : pad + n])


def _padding(part: LinearPart, step: float, n: int) -> int:
    """Return the samples in which all but slow creep settles, at most as many as the path has."""
    decay = -np.linalg.eigvals(part.a).real
    slowest = 1.0 / np.min(decay) if np.all(decay > 0) else 0.0
    return int(np.clip(10.0 * slowest / step, 50, max(n, 50)))
