"""Foreign: stick-slip of the output against a guide.

    x = x_base - F/k
    stuck:  F/k = kappa (x - a)  until  |F| = F_s
    slips:  |F| = F_c = F_s/rho < F_s, against the motion, until the motion reverses
            (then it is stuck again, with a = x - F/(k kappa))

Quasi-static, because every resonance lies above the record's band. kappa k is the pre-sliding
stiffness. The force band in which the output sticks after each reversal is F_c + F_s wide, and
each break-away is a jump of (F_s - F_c)/k: the stick-slip. Source: B. Armstrong-Helouvry, P.
Dupont and C. Canudas de Wit, Automatica 30 (1994) 1083.
"""

import numpy as np

from tests.studies.plants.base import Run
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.stack import FloatArray


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """Stiction over Coulomb friction 1.6-2.4, pre-sliding stiffness 3-8 times that of the stack."""
    del run
    return {"rho": float(rng.uniform(1.6, 2.4)), "kappa": float(rng.uniform(3.0, 8.0))}


def friction(free: FloatArray, stiction: float, coulomb: float, kappa: float) -> FloatArray:
    """F/k [m] along the free displacement, (M,) [m]; F_s/k = stiction, F_c/k = coulomb [m]."""
    out: list[float] = []
    anchor, before, slipping = float(free[0]), float(free[0]), 0.0
    for value in free.tolist():
        move = value - before
        before = value
        if slipping != 0.0 and move * slipping < 0.0:
            anchor = value - move - slipping * coulomb * (1.0 + 1.0 / kappa)
            slipping = 0.0
        if slipping == 0.0:
            force = kappa * (value - anchor) / (1.0 + kappa)
            if abs(force) > stiction:
                slipping = 1.0 if force > 0.0 else -1.0
        out.append(slipping * coulomb if slipping != 0.0 else force)
    return np.asarray(out)


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Displacement lost to friction, (N,) [m]; gain is F_s/k [m]."""
    if gain == 0.0:
        return np.zeros_like(run.times)
    stride = max(1, run.sub_intervals // 8)
    lost = friction(
        run.fine_displacement[::stride], gain, gain / parameters["rho"], parameters["kappa"]
    )
    return -lost[:: run.sub_intervals // stride]


DRY_FRICTION = HiddenEffect(
    "dry_friction", "F_s/k", "m", draw, contribution, (1e-9, 3e-6), linear=False, foreign=True
)
