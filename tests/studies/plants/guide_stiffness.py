"""Foreign: a flexure guide that is stiff about one position and softer away from it on both sides.

    x + g (w_s tanh((x - x_c)/w_s) - w_s tanh((0 - x_c)/w_s)) = x_free

Bilinear with a rounded corner: stiffness 1 + g within w_s of the centre x_c, 1 outside, alike on
both sides, so not a contact. w_s is a small part of the range, too narrow for a low polynomial.
Solved statically by bisection. Source: guides that are stiff before they slide, and buckled
flexures, e.g. S. Henein, "Conception des guidages flexibles", ch. 4.
"""

import numpy as np

from tests.studies.plants.base import Run
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.stack import FloatArray

ITERATIONS = 60


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """Centre x_c and width w_s [m], at 30-70 % and 6-12 % of the range moved."""
    low, span = float(run.displacement.min()), float(np.ptp(run.displacement))
    centre = low + float(rng.uniform(0.3, 0.7)) * span
    return {"centre": centre, "width": float(rng.uniform(0.06, 0.12)) * span}


def guided(free: FloatArray, centre: float, width: float, stiffness: float) -> FloatArray:
    """x that solves the equation, (N,) [m], by bisection: the spring moves x by at most 2 g w_s."""
    rest = np.tanh(-centre / width)
    low = free - 2.0 * stiffness * width
    high = free + 2.0 * stiffness * width
    for _ in range(ITERATIONS):
        x = 0.5 * (low + high)
        over = x + stiffness * width * (np.tanh((x - centre) / width) - rest) > free
        low, high = np.where(over, low, x), np.where(over, x, high)
    return np.asarray(0.5 * (low + high), dtype=np.float64)


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Displacement with minus without the guide; g is its stiffness over that of the stack."""
    if gain == 0.0:
        return np.zeros_like(run.times)
    moved = guided(run.displacement, parameters["centre"], parameters["width"], gain)
    return moved - run.displacement


GUIDE_STIFFNESS = HiddenEffect(
    "guide_stiffness", "g", "1", draw, contribution, (1e-3, 1.0), linear=False, foreign=True
)
