"""A stack that loses polarisation with the cycles it has made.

    x -> x (1 - g lg(1 + N/N_0)),   N = integral |du|/(2 u_r)

N: cycles at rated voltage u_r that the travel is worth; g: loss for each decade. Source: D. A. Hall
and M. M. Ben-Omran, "Ageing of high field dielectric properties in BaTiO3-based piezoceramics", J.
Phys.: Condens. Matter 10 (1998) 9129 (logarithmic law, there in time). Not the project's form: the
clock is the travel of the voltage.
"""

import numpy as np

from tests.studies.plants.base import Run
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.stack import FloatArray


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """Cycles N_0 after which the loss sets in."""
    del run
    return {"n_0": float(np.exp(rng.uniform(np.log(0.3), np.log(3.0))))}


def cycles(voltage: FloatArray, span: float) -> FloatArray:
    """Travel of the voltage in full cycles of `span`, (M,) [1]."""
    return np.concatenate(([0.0], np.cumsum(np.abs(np.diff(voltage))))) / (2.0 * span)


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Displacement lost to ageing, (N,) [m]."""
    count = cycles(run.path.path_voltage, run.stack.u_rated)[run.path.node][:: run.sub_intervals]
    return -gain * np.log10(1.0 + count / parameters["n_0"]) * run.displacement


AGEING = HiddenEffect("ageing", "g", "1", draw, contribution, (1e-4, 0.1), linear=True)
