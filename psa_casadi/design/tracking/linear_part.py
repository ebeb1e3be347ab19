"""The linear part of a stack, and its zero-phase inverse."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from psa_casadi.model.compose import Model
from psa_casadi.simulation.start import start_state

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

#: Response over that at rest, below which the inverse rolls off.
ROLL_OFF = 0.03


@dataclass(frozen=True, eq=False)
class LinearPart:
    """x' = a x + b v, d = c x: voltage to displacement, hysteresis forces held at rest."""

    a: FloatArray
    b: FloatArray
    c: FloatArray

    def response(self, omega: FloatArray) -> ComplexArray:
        """Return displacement over voltage [m/V] at angular frequencies (n,) [rad/s]."""
        identity = np.eye(len(self.a))
        systems = 1j * omega[:, None, None] * identity - self.a
        right = np.broadcast_to(self.b[:, None].astype(complex), (len(omega), len(self.b), 1))
        return np.asarray(np.linalg.solve(systems, right)[:, :, 0] @ self.c)

    def first_resonance(self) -> float:
        """Return the lowest natural frequency of the oscillating parts [Hz]; 0 if none rings."""
        poles = np.linalg.eigvals(self.a)
        ringing = poles[np.abs(poles.imag) > 1e-6 * np.abs(poles)]
        return float(np.min(np.abs(ringing)) / (2.0 * np.pi)) if ringing.size else 0.0


def linear_part(model: Model) -> LinearPart:
    """Linearise a stack at rest at 0 V; states that rest at any value (hysteresis) are left out."""
    kept = [k for k, s in enumerate(model.structure.states) if not s.memory or s.settles]
    a, b, c = slopes_at_rest(model)
    return LinearPart(a[np.ix_(kept, kept)], b[kept], c[kept])


def slopes_at_rest(model: Model) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return d xdot / d x (nx, nx), d xdot / d voltage (nx,), d displacement / d x (nx,)."""
    starts = [i.start for i in model.structure.inputs]
    x = start_state(model, starts).x
    a, b, c, _ = model.structure.slopes(0.0, x, starts, model.parameter_vector())
    row, column = model.output_names.index("displacement"), model.input_names.index("voltage")
    return np.array(a), np.array(b)[:, column], np.array(c)[row]


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
