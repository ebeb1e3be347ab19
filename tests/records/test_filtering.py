"""The small filters give what `scipy.signal` gives, and a diagnosis loads no more than it needs."""

import subprocess
import sys

import numpy as np
import pytest
from scipy import signal

from psa_casadi.records.noise import convolved, filtered, peaks

RANDOM = np.random.default_rng(7)


@pytest.mark.parametrize("lower", [[1.0], [1.0, -0.95], [1.0, -1.9, 0.95]])
def test_filtered(lower: list[float]) -> None:
    x = RANDOM.standard_normal((500, 3))
    upper = [0.5, 0.0, -0.2]
    expected = signal.lfilter(upper, lower, x, axis=0)
    np.testing.assert_allclose(filtered(upper, lower, x), expected, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(filtered(upper, lower, x[:, 0]), expected[:, 0], rtol=1e-10)
    np.testing.assert_allclose(filtered(upper, lower, x[:2]), expected[:2])
    assert not filtered(upper, lower, x[:0]).size


def test_convolved() -> None:
    x, half = RANDOM.standard_normal((500, 3)), RANDOM.standard_normal(40)
    kernel = np.concatenate([half[:0:-1], half])
    expected = signal.oaconvolve(x, kernel[:, None], mode="same", axes=0)
    np.testing.assert_allclose(convolved(x, kernel), expected, atol=1e-11)


def test_peaks() -> None:
    values = np.abs(RANDOM.standard_normal(5000))
    where, _ = signal.find_peaks(values, distance=24)
    expected = where[np.argsort(values[where])[::-1]][:20]
    np.testing.assert_array_equal(peaks(values, 24, 20), expected)


def test_a_diagnosis_without_pages_loads_no_drawing_and_no_statistics() -> None:
    code = (
        "import sys, psa_casadi.diagnosis.diagnose, psa_casadi.report.words.text;"
        "print(*{'matplotlib', 'plotly', 'fmpy', 'scipy.signal', 'scipy.stats'} & {*sys.modules})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
