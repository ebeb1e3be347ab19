"""A sensor that renews its reading by its own clock, read by another one.

    measured(t_n) = x(P floor((t_n - t_0) / P) + t_0),   P = h (1 - skew) / m

The sensor converts every P seconds and holds the value; the record takes one every h seconds. P is
nearly the m-th part of h, so that the age of what is taken moves by h skew a sample, and jumps by P
after P / (h skew) samples. Source: none needed; two quartz clocks differ by 10 to 100 ppm. Not the
project's form: the value held at a true instant, by cubic interpolation, and no delay anywhere.
"""

import numpy as np
from scipy.interpolate import CubicSpline

from tests.studies.plants.base import Run
from tests.studies.plants.stack import FloatArray


def held(run: Run, renewals: int, skew: float, first: float) -> FloatArray:
    """Displacement as the record takes it, (N,) [m].

    renewals: m; skew: relative difference of the clocks; first: t_0 as a share of P.
    """
    step = float(run.times[1] - run.times[0])
    period = step * (1.0 - skew) / renewals
    start = (first - 1.0) * period
    instants = start + period * np.floor((run.times - start) / period)
    shown = CubicSpline(run.path.time, run.fine_displacement)(np.maximum(instants, 0.0))
    return np.asarray(shown, dtype=np.float64)
