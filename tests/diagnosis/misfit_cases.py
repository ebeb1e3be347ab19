"""Residuals with known content, and what is seen in them."""

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from psa_casadi.diagnosis.misfit import Misfit, misfit
from psa_casadi.diagnosis.noise import noise_floor
from psa_casadi.records import Record, excitation

FloatArray = NDArray[np.float64]

NOISE = 1e-8
STEP = 1e-3


def grid(samples: int, step: float = STEP) -> FloatArray:
    return step * np.arange(samples, dtype=np.float64)


TIME = grid(20_000)
SINE = excitation.sine(TIME, 0.0, 100.0, 2.0)
MULTISINE = excitation.multisine(TIME, 0.0, 100.0, (0.5, 20.0), seed=1)
LEVELS = (0.0, 50.0, 20.0, 80.0, 0.0, 100.0, 30.0, 60.0)
STEPS = excitation.steps(TIME, LEVELS)


def noise(samples: int, correlation: float, seed: int) -> FloatArray:
    white = np.random.default_rng(seed).standard_normal(samples)
    coloured: FloatArray = lfilter([np.sqrt(1 - correlation**2)], [1, -correlation], white)
    return NOISE * coloured


def seen(
    voltage: FloatArray, error: FloatArray, *, correlation: float = 0.0, seed: int = 0
) -> Misfit:
    residual = error + noise(voltage.size, correlation, seed)
    record = Record(
        name="r", time=grid(voltage.size), voltage=voltage, displacement=1e-7 * voltage + residual
    )
    (floor,) = noise_floor([record], [residual])
    return misfit(record, residual, floor)


def shares(m: Misfit) -> dict[str, float]:
    views = (*m.views, *((m.holds,) if m.holds else ()))
    return {v.name: v.share for v in views}
