"""A spring against which the stack works, and which hardens.

    x + g L sinh(x/L) = x_free

g: stiffness of the spring at rest over that of the stack; L: elongation over which it hardens.
Solved statically by Newton's method, because every resonance lies above the record's band. Source:
elastomer and membrane springs, exponential hardening after Y. C. Fung, "Biomechanics", ch. 7. Not
the project's form: not a cubic, and an algebraic equation instead of a force in the balance.
"""

import numpy as np

from tests.studies.plants.base import Run
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.stack import FloatArray

ITERATIONS = 20


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """L [m] between 0.3 and 0.6 of the range moved."""
    return {"length": float(rng.uniform(0.3, 0.6) * np.ptp(run.displacement))}


def balance(free: FloatArray, length: float, stiffness: float) -> FloatArray:
    """x that solves x + g L sinh(x/L) = free, (N,) [m].

    Newton starts beyond the solution, where the left side is convex, so it converges from there.
    """
    z = free / length
    x = np.sign(z) * np.minimum(np.abs(z), np.arcsinh(np.abs(z) / stiffness))
    for _ in range(ITERATIONS):
        x = x - (x + stiffness * np.sinh(x) - z) / (1.0 + stiffness * np.cosh(x))
    return np.asarray(length * x, dtype=np.float64)


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Displacement lost to the spring, (N,) [m]."""
    if gain == 0.0:
        return np.zeros_like(run.times)
    return balance(run.displacement, parameters["length"], gain) - run.displacement


LOAD_STIFFNESS = HiddenEffect(
    "load_stiffness", "g", "1", draw, contribution, plausible=(3e-4, 0.2), linear=False
)
"""Up to a fifth of the stack's; a stiffer spring shortens the stroke so much that it bends less."""
