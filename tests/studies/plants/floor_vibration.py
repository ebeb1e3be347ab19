"""Foreign: two random narrow-band vibrations of the set-up, unrelated to the voltage.

    x_vib = g (n_1 + b n_2),   n_i = real part of z_i, scaled to unit rms
    z_i' = (-w_i/(2 Q_i) + i w_i) z_i + white noise

Centre frequencies 6-11 Hz and 17-31 Hz, incommensurate, Q 8-20: bands, not lines, so neither mains
hum nor drift. Source: floors and tables, e.g. C. G. Gordon, "Generic criteria for
vibration-sensitive equipment", Proc. SPIE 1619 (1991).
"""

import math

import numpy as np
from scipy.signal import lfilter

from tests.studies.plants.base import Run
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.stack import FloatArray


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """Frequencies, widths, relative size, and the seed of the random force."""
    del run
    return {
        "frequency_1": float(rng.uniform(6.0, 11.0)),
        "frequency_2": float(rng.uniform(17.0, 31.0)),
        "q_1": float(rng.uniform(8.0, 20.0)),
        "q_2": float(rng.uniform(8.0, 20.0)),
        "b": float(rng.uniform(0.5, 1.0)),
        "seed": float(rng.integers(2**31)),
    }


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Vibration at the samples, (N,) [m]."""
    rng = np.random.default_rng(int(parameters["seed"]))
    first = _band(rng, run.times, parameters["frequency_1"], parameters["q_1"])
    second = _band(rng, run.times, parameters["frequency_2"], parameters["q_2"])
    return gain * (first + parameters["b"] * second)


def _band(rng: np.random.Generator, times: FloatArray, frequency: float, q: float) -> FloatArray:
    omega = 2.0 * math.pi * frequency
    growth = np.exp(complex(-omega / (2.0 * q), omega) * float(times[1] - times[0]))
    warm_up = times.size
    noise = rng.standard_normal(times.size + warm_up)
    wave = np.asarray(lfilter([1.0], [1.0, -growth], noise.astype(np.complex128)))[warm_up:].real
    return np.asarray(wave / np.std(wave), dtype=np.float64)


FLOOR_VIBRATION = HiddenEffect(
    "floor_vibration",
    "g",
    "m",
    draw,
    contribution,
    (1e-9, 1e-6),
    linear=True,
    foreign=True,
    random=True,
)
