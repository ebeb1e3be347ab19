"""Noise of the sensor: white, coloured, coarse counts, missing and stuck samples."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from scipy.signal import lfilter

from tests.studies.plants.stack import FloatArray

NoiseKind = Literal["white", "ar", "quantised", "drop-outs"]
NOISES: tuple[NoiseKind, ...] = get_args(NoiseKind)
RUN = 5
"""Longest run of missing or stuck samples."""


@dataclass(frozen=True)
class Noise:
    """How a record is disturbed.

    kind; white: rms before rounding [m]; quantum: count of the sensor [m]; rms: of noise and, for
    coarse counts, rounding [m]; correlation: of neighbouring samples; missing: share of samples
    that are lost; stuck: lost samples repeat the last reading instead of being empty.
    """

    kind: NoiseKind
    white: float
    quantum: float
    rms: float
    correlation: float = 0.0
    missing: float = 0.0
    stuck: bool = False


def draw_noise(rng: np.random.Generator, kind: NoiseKind, span: float) -> Noise:
    """Draw noise of 0.1-0.2 % of the range `span` [m]."""
    white = span * float(rng.uniform(0.001, 0.002))
    quantum = white * float(rng.uniform(0.25, 0.5))
    if kind == "ar":
        return Noise(kind, white, quantum, white, correlation=float(rng.uniform(0.4, 0.8)))
    if kind == "quantised":
        quantum = white * float(rng.uniform(1.0, 3.0))
        return Noise(kind, white, quantum, float(np.hypot(white, quantum / np.sqrt(12.0))))
    if kind == "drop-outs":
        missing, stuck = float(rng.uniform(0.005, 0.02)), bool(rng.integers(2))
        return Noise(kind, white, quantum, white, missing=missing, stuck=stuck)
    return Noise(kind, white, quantum, white)


def disturb(rng: np.random.Generator, noise: Noise, clean: FloatArray) -> FloatArray:
    """What the sensor reports, (N,) [m], nan where nothing came."""
    error = noise.white * rng.standard_normal(clean.size)
    if noise.correlation > 0.0:
        error = coloured(error, noise.correlation)
    read = noise.quantum * np.round((clean + error) / noise.quantum) + 0.0
    lost = np.zeros(clean.size, dtype=np.bool_)
    while lost.sum() < noise.missing * clean.size:
        first = int(rng.integers(1, clean.size - RUN))
        lost[first : first + int(rng.integers(1, RUN + 1))] = True
    if not noise.stuck:
        return np.where(lost, np.nan, read)
    last = np.maximum.accumulate(np.where(lost, 0, np.arange(clean.size)))
    return read[last]


def coloured(white: FloatArray, correlation: float) -> FloatArray:
    """First-order autoregression e_k = c e_(k-1) + sqrt(1 - c^2) w_k, stationary from the first
    sample, rms as the white noise's.
    """
    scaled = np.sqrt(1.0 - correlation**2) * white
    scaled[0] = white[0]
    return np.asarray(lfilter([1.0], [1.0, -correlation], scaled), dtype=np.float64)
