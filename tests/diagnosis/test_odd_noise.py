"""Clean records whose noise is not white: nothing is missing from the model."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from tests.studies.plants.make import make_record
from tests.tiers import slow_but


def _pink(y: FloatArray, rng: np.random.Generator) -> FloatArray:
    lines = np.fft.rfft(rng.standard_normal(y.size)) / np.sqrt(
        np.maximum(np.arange(y.size // 2 + 1), 1)
    )
    return _of_size_one(np.fft.irfft(lines, y.size))


def _telegraph(y: FloatArray, rng: np.random.Generator) -> FloatArray:
    return _of_size_one(np.cumsum(rng.random(y.size) < 0.01) % 2.0)


def _walk(y: FloatArray, rng: np.random.Generator) -> FloatArray:
    return _of_size_one(np.cumsum(rng.standard_normal(y.size)))


def _jitter(y: FloatArray, rng: np.random.Generator) -> FloatArray:
    """The reading is taken a little before or after its time."""
    return _of_size_one(np.gradient(gaussian_filter1d(y, 4.0)) * rng.standard_normal(y.size))


def _of_size_one(noise: NDArray[Any]) -> FloatArray:
    return np.asarray((noise - np.mean(noise)) / np.std(noise), dtype=np.float64)


NOISES = [_pink, _telegraph, _walk, _jitter]


@pytest.mark.parametrize(("number", "made"), slow_but([(1, _telegraph)], list(enumerate(NOISES))))
def test_noise_of_any_colour_is_noise(
    number: int, made: Callable[[FloatArray, np.random.Generator], FloatArray], tmp_path: Path
) -> None:
    """Three times as large as the white noise in the record."""
    path, rng = tmp_path / "clean.csv", np.random.default_rng(number)
    make_record(None, 4430 + number, path)
    time, voltage, displayed = np.loadtxt(path, delimiter=",", skiprows=1).T
    white = float(np.std(np.diff(displayed, 3))) / np.sqrt(20.0)
    noisy = {
        "time [s]": time,
        "voltage [V]": voltage,
        "displacement [um]": displayed + 3.0 * white * made(displayed, rng),
    }
    result = psa.diagnose(noisy)
    assert (result.verdict, result.causes) == ("adequate", ())
