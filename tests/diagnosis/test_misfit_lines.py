"""Lines of a residual's spectrum, and its parts among the harmonics of the drive."""

import numpy as np
import pytest

from psa_casadi.diagnosis.misfit import misfit
from psa_casadi.diagnosis.noise import noise_floor
from psa_casadi.records import Record, excitation
from tests.diagnosis.misfit_cases import (
    MULTISINE,
    NOISE,
    SINE,
    TIME,
    FloatArray,
    grid,
    noise,
    seen,
    shares,
)


@pytest.mark.parametrize("voltage", [SINE, MULTISINE], ids=["sine", "multisine"])
def test_a_line_at_57_9_hz(voltage: FloatArray) -> None:
    m = seen(voltage, 2e-8 * np.sin(2 * np.pi * 57.9 * TIME))
    assert m.sentences[1].startswith("The residual has a line whatever the drive does: 57.9 Hz")
    assert len(m.sentences) == 2
    (line,) = m.spectrum.lines
    assert line.frequency == pytest.approx(57.9, abs=0.02)
    assert line.amplitude == pytest.approx(2e-8, rel=0.05)
    assert max(shares(m).values()) == 0.0


def test_the_mains_and_the_drive_are_named() -> None:
    f = 1.0 / 0.45
    error = 2e-8 * np.sin(2 * np.pi * 50.0 * TIME) + 1e-8 * np.sin(6 * np.pi * f * TIME)
    mains, harmonic = seen(excitation.sine(TIME, 0.0, 100.0, f), error).spectrum.lines
    assert (mains.name, mains.of_drive) == ("50 Hz mains", False)
    assert (harmonic.name, harmonic.of_drive) == ("harmonic 3 of the drive", True)
    slow = grid(4_000, 1.0 / 45.0)
    aliased = Record(name="a", time=slow, voltage=np.sin(40.0 * slow), displacement=np.zeros(4_000))
    residual = 2e-8 * np.sin(2 * np.pi * 50.0 * aliased.time) + noise(4_000, 0.0, 0)
    (line,) = misfit(aliased, residual, *noise_floor([aliased], [residual])).spectrum.lines
    assert line.frequency == pytest.approx(5.0, abs=0.01)
    assert line.name == "alias of 50 Hz mains"


def test_the_spectrum_of_noise_lies_on_its_floor() -> None:
    for correlation in (0.0, 0.7):
        spectrum = seen(SINE, 0.0 * SINE, correlation=correlation).spectrum
        ratio = spectrum.density[-100:] / spectrum.floor[-100:]
        assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1.0, abs=0.1)
        assert np.all(np.diff(spectrum.frequency) > 0)


def test_even_and_odd_nonlinearity_of_a_sine() -> None:
    w = 4 * np.pi * TIME
    error: FloatArray = 1.5e-8 * np.sin(w) + 2e-8 * np.cos(2 * w) + 1e-8 * np.sin(3 * w + 0.4)
    found = seen(SINE, error)
    split = found.split
    assert split is not None
    assert split.fundamental == pytest.approx(2.0, rel=1e-6)
    assert split.excited == 1
    assert split.linear == pytest.approx(1.5e-8**2 / 2, rel=0.05)
    assert split.even == pytest.approx(2e-8**2 / 2, rel=0.05)
    assert split.odd == pytest.approx(1e-8**2 / 2, rel=0.1)
    assert split.noise == pytest.approx(NOISE**2, rel=0.05)
    assert "even nonlinearity (14 nm rms)" in found.sentences[-1]


def test_a_multisine_of_odd_lines_shows_its_nonlinearity_between_them() -> None:
    rng = np.random.default_rng(2)
    w = 2 * np.pi * TIME[:2_000] / 2.0
    odd = [k for k in range(1, 40, 2) if k % 8 != 5]
    u: FloatArray = np.tile(sum(np.cos(k * w + rng.uniform(0, 6.28)) for k in odd), 10) / 4.0
    linear = seen(u, 3e-8 * u).split
    even = seen(u, 3e-8 * (u**2 - np.mean(u**2))).split
    cubic = seen(u, 3e-8 * u**3).split
    assert linear is not None
    assert even is not None
    assert cubic is not None
    assert (linear.excited, linear.even, linear.odd) == (len(odd), 0.0, 0.0)
    assert linear.linear == pytest.approx(9e-16 * np.mean(u**2), rel=0.02)
    assert (even.linear, even.odd) == (0.0, 0.0)
    assert even.even == pytest.approx(9e-16 * np.var(u**2), rel=0.02)
    assert cubic.even == 0.0
    assert cubic.odd > 100.0 * NOISE**2 / 1e3
    assert seen(MULTISINE, 0.0 * TIME).split is None
