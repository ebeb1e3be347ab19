"""A preload that is lost on one side of a position: another stiffness beyond it, with a hard kink.

    x = x_free - F/k,   F/k = g max(0, s (x - x_0)) s,   s = 1 or -1
    so   x = x_free - s g/(1 + g) max(0, s (x_free - x_0))

g: stiffness of what is in contact over that of the stack; s: the side on which it touches. Solved
statically in closed form. Source: unilateral contact (Signorini), e.g. K. L. Johnson, "Contact
Mechanics". Not the project's form: the corner is not smoothed, and the equation is algebraic.
"""

import numpy as np

from tests.studies.plants.base import Run
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.stack import FloatArray


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """Place x_0 [m] of the contact at 30-70 % of the range moved, and its side."""
    low, high = float(run.displacement.min()), float(run.displacement.max())
    place = low + float(rng.uniform(0.3, 0.7)) * (high - low)
    return {"x_0": place, "side": 1.0 if rng.integers(2) else -1.0}


def contact(free: FloatArray, place: float, side: float, stiffness: float) -> FloatArray:
    """Displacement lost to the contact, (N,) [m]; 0 at x_free = 0."""
    share = stiffness / (1.0 + stiffness)
    reach = np.maximum(0.0, side * (free - place)) - max(0.0, -side * place)
    return np.asarray(side * share * reach, dtype=np.float64)


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Displacement with minus without the contact; x stays 0 at the start."""
    return -contact(run.displacement, parameters["x_0"], parameters["side"], gain)


PRELOAD_LOSS = HiddenEffect(
    "preload_loss", "g", "1", draw, contribution, plausible=(1e-3, 1.0), linear=False
)
