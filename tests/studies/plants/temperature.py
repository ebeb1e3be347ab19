"""A room whose temperature moves: the frame expands and the gain changes. The thermometer is in the
record.

    T(t) = T_0 + D (1 - exp(-t/tau)) + random walk           thermometer, a column of the record
    (tau_f/2 s + 1)^2 T_f = T - T(0)                           frame, through a wall
    x -> x + g T_f (1 + b x/S)

g: expansion for each kelvin; b: share by which it grows over the range S (gain of the ceramic).
Source: frames of 10-20 ppm/K and 10-40 mm. Not the project's form: the frame follows the
thermometer through two lags in series, a coarse wall.
"""

import numpy as np
from scipy.signal import lfilter

from tests.studies.plants.base import Run, first_order
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.stack import FloatArray


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """Room: T_0 [degC], D [K], tau and tau_f [s], size and seed of the walk; b; S [m]."""
    length = float(run.times[-1] - run.times[0])
    return {
        "t_0": float(rng.uniform(19.0, 26.0)),
        "d": float(rng.uniform(0.3, 1.0)) * (1.0 if rng.integers(2) else -1.0),
        "tau": float(rng.uniform(0.3, 1.5)) * length,
        "tau_f": float(rng.uniform(0.005, 0.03)) * length,
        "walk": float(rng.uniform(0.15, 0.4)),
        "length": length,
        "b": float(rng.uniform(0.0, 0.3)),
        "span": float(np.ptp(run.displacement)),
        "seed": float(rng.integers(2**31)),
    }


def room(times: FloatArray, parameters: Parameters) -> FloatArray:
    """T at the samples, (N,) [degC]; the walk is smoothed over a fiftieth of the record."""
    rng = np.random.default_rng(int(parameters["seed"]))
    age, step = times - times[0], float(times[1] - times[0])
    drift = parameters["d"] * (1.0 - np.exp(-age / parameters["tau"]))
    decay = np.exp(-50.0 * step / parameters["length"])
    kicks = rng.standard_normal(times.size) * np.sqrt(step / parameters["length"])
    smooth = lfilter([1.0 - decay], [1.0, -decay], np.cumsum(kicks))
    return np.asarray(parameters["t_0"] + drift + parameters["walk"] * smooth, dtype=np.float64)


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Displacement by temperature, (N,) [m]; g in m/K."""
    air = room(run.times, parameters)
    frame, lag = air - air[0], 0.5 * parameters["tau_f"]
    for _ in range(2):
        frame = first_order(-1.0 / lag + 0j, frame, float(run.times[1] - run.times[0])).real / lag
    grown = 1.0 + parameters["b"] * run.displacement / parameters["span"]
    return np.asarray(gain * frame * grown, dtype=np.float64)


TEMPERATURE = HiddenEffect(
    "temperature", "g", "m/K", draw, contribution, (1e-9, 2e-6), linear=True, room=room
)
