"""A gain that climbs with the heat of the hysteresis loops.

    P = |u - u_last reversal|^(q - 1) |u'|           (a swing of D gives the heat D^q/q)
    tau T' + T = P/mean(P),    x -> x (1 + g T)

The energy lost in a cycle grows with a power of its amplitude (q = 3 for Rayleigh loops), so it
is counted along each half cycle. Temperature in units of what the record's mean loss would reach;
exact exponential steps for a loss that is constant on each sub-interval. Source: S. Li, W. Cao and
L. E. Cross, "The extrinsic nature of nonlinear behavior observed in lead zirconate titanate
ferroelectric ceramic", J. Appl. Phys. 69 (1991) 7219; heating: K. Uchino and S. Hirose, IEEE
Trans. UFFC 48 (2001) 307. Not the project's form: the loss comes from the history of reversals, not
from current and voltage at one instant.
"""

import math

import numpy as np
from scipy.signal import lfilter

from tests.studies.plants.base import Run
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.memory import since_reversal, turning_points
from tests.studies.plants.stack import FloatArray


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """Thermal time constant [s], 0.1-0.5 of the record's length; power q of the loss."""
    length = float(run.times[-1] - run.times[0])
    return {"tau": float(rng.uniform(0.1, 0.5)) * length, "q": float(rng.uniform(2.2, 3.2))}


def heat(voltage: FloatArray, q: float) -> FloatArray:
    """Heat since the start, (M,) [V^q]: the sum over all swings of D^q/q, exact on each step."""
    released = since_reversal(voltage) ** q / q
    steps = np.diff(released)
    turns = turning_points(voltage)[1:-1]
    steps[turns] = released[turns + 1]
    return np.concatenate(([0.0], np.cumsum(steps)))


def temperature(energy: FloatArray, step: float, tau: float) -> FloatArray:
    """tau T' + T = P from rest, (M,), P constant on each step: T + (P - T) (1 - exp(-h/tau))."""
    decay = math.exp(-step / tau)
    power = np.diff(energy) / step
    warmed = lfilter([1.0 - decay], [1.0, -decay], power)
    return np.concatenate(([0.0], np.asarray(warmed, dtype=np.float64)))


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Displacement gained by heat, (N,) [m]."""
    energy = heat(run.path.path_voltage, parameters["q"])[run.path.node]
    mean = float(energy[-1]) / float(run.times[-1] - run.times[0])
    if gain == 0.0 or mean == 0.0:
        return np.zeros_like(run.times)
    warm = temperature(energy / mean, run.fine_step, parameters["tau"])
    return gain * warm[:: run.sub_intervals] * run.displacement


SELF_HEATING = HiddenEffect(
    "self_heating", "g", "1", draw, contribution, plausible=(1e-4, 0.15), linear=True
)
"""Gain times temperature: 0.1-0.5 % for each kelvin over at most 30 K."""
