"""How long a communication step of a system may be: where its co-simulation turns unstable.

All parts are linearised at rest, x' = A x + B u, y = C x + D u, and wired, u = L y. Between two
communication points a part sees its inputs held, or as straight lines with the slopes of the
outputs that they come from. So the states pass from one point to the next by one matrix,

    M(h) = Phi(h) + Gamma_0(h) K_0 + Gamma_1(h) K_1,
    Phi = exp(A h),  Gamma_j = int_0^h exp(A (h - s)) B s^j ds,
    K_0 = (1 - L D)^-1 L C,  K_1 = K_0 (A + B K_0)  (K_1 = 0 for held inputs),

and an error grows from point to point where the spectral radius of M is above 1.
"""

import math
from dataclasses import dataclass

import numpy as np
import scipy

from psa_casadi.export.ssp.drawing import OUTSIDE, WiredParts
from psa_casadi.units import FloatArray

#: Growth of a step below which a system counts as stable: memories have the radius 1 itself.
_GROWTH = 1e-7
_STEPS_IN_SEARCH = 200
_BISECTIONS = 40


@dataclass(frozen=True)
class Linear:
    """All parts at rest, side by side: matrices A, B, C, D and the wires L, u = L y + outside."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    L: FloatArray

    def exchange(self) -> FloatArray:
        """Return K_0, inputs from states at a communication point, shape (nu, nx)."""
        loop = np.eye(len(self.L)) - self.L @ self.D
        return np.asarray(np.linalg.solve(loop, self.L @ self.C), dtype=float)

    def step(self, h: float, *, rates: bool) -> FloatArray:
        """Return M(h) [1], the map of the states over one communication step, shape (nx, nx)."""
        nx, nu = self.B.shape
        chain = np.zeros((nx + 2 * nu, nx + 2 * nu))
        chain[:nx, :nx], chain[:nx, nx : nx + nu] = self.A, self.B
        chain[nx : nx + nu, nx + nu :] = np.eye(nu)
        flow = scipy.linalg.expm(chain * h)
        K = self.exchange()
        slopes = K @ (self.A + self.B @ K) if rates else np.zeros((nu, nx))
        held, sloped = flow[:nx, nx : nx + nu], flow[:nx, nx + nu :]
        return np.asarray(flow[:nx, :nx] + held @ K + sloped @ slopes)

    def growth(self, h: float, *, rates: bool) -> float:
        """Return the spectral radius of M(h)."""
        return float(np.abs(np.linalg.eigvals(self.step(h, rates=rates))).max(initial=0.0))


def linear(wiring: WiredParts) -> Linear:
    """Return the parts at rest, each state and port in units of its nominal size.

    Sampled parts hold their outputs, so they take no part in a loop.
    """
    pieces = []
    for model in wiring.parts.values():
        s, size = model.structure, model.state_nominals()
        rest = [[v.start for v in group] for group in (s.states, s.inputs)]
        held = [[v.start for v in s.sampled]] if s.sampled else []
        found = s.slopes(0.0, *rest, model.parameter_vector(), *held)
        a, b, c, d = (np.array(m, dtype=float).reshape(m.shape) for m in found)
        pieces.append((a / size[:, None] * size, b / size[:, None], c * size, d))
    a, b, c, d = (scipy.linalg.block_diag(*(p[k] for p in pieces)) for k in range(4))
    ends = [(part, n) for part, model in wiring.parts.items() for n in model.input_names]
    starts = [(part, n) for part, model in wiring.parts.items() for n in model.output_names]
    wires = np.zeros((len(ends), len(starts)))
    for wire in wiring.wires:
        if OUTSIDE not in (wire.start.part, wire.end.part):
            row = ends.index((wire.end.part, wire.end.name))
            wires[row, starts.index((wire.start.part, wire.start.name))] = 1.0
    return Linear(a, b, c, d, wires)


def stable_step(wiring: WiredParts, *, rates: bool) -> float:
    """Return the longest communication step [s] up to which all shorter ones are stable.

    `rates` says whether inputs get slopes. Infinity if no loop turns unstable: at up to 100 times
    the time of the slowest ordinary mode.
    """
    system = linear(wiring)
    speeds = np.abs(np.linalg.eigvals(system.A + system.B @ system.exchange()))
    speeds = speeds[speeds > 1e-6 * speeds.max(initial=0.0)]
    if not speeds.size:
        return float("inf")
    steps = np.geomspace(1e-2 / speeds.max(), 1e2 / speeds.min(), _STEPS_IN_SEARCH)
    for k, step in enumerate(steps):
        if system.growth(float(step), rates=rates) > 1.0 + _GROWTH:
            stable, unstable = float(steps[k - 1]) if k else 0.0, float(step)
            for _ in range(_BISECTIONS):
                middle = 0.5 * (stable + unstable)
                if system.growth(middle, rates=rates) > 1.0 + _GROWTH:
                    unstable = middle
                else:
                    stable = middle
            return stable
    return float("inf")


def master_step(wiring: WiredParts, stop_time: float) -> float:
    """Return a communication step [s] for a master that holds the inputs: 1, 2 or 5 times 10^k.

    It is at most a twentieth of what stays stable, as the error of the coupling is of first order,
    and a thousandth of the time that is simulated.
    """
    longest = min(stable_step(wiring, rates=False) / 20.0, stop_time / 1000.0)
    size = 10.0 ** math.floor(math.log10(longest))
    return max(round(k * size, 15) for k in (1.0, 2.0, 5.0) if k * size <= longest)
