"""The linear part of a stack: voltage to displacement with the hysteresis forces held at rest."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from psa_casadi.model.compose import Model
from psa_casadi.simulation.start import start_state

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]


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
