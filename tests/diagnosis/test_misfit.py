"""What a residual reveals: what was put in, and nothing in noise; its lines and harmonics."""

import numpy as np
import pytest
from scipy.signal import lfilter

from psa_casadi.common.errors import InputError
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.misfit import Misfit, misfit
from psa_casadi.diagnosis.noise import noise_floor
from psa_casadi.records import Record, excitation
from tests.voltages import steps

NOISE = 1e-8
STEP = 1e-3


def grid(samples: int, step: float = STEP) -> FloatArray:
    return step * np.arange(samples, dtype=np.float64)


TIME = grid(20_000)
SINE = excitation.sine(TIME, 0.0, 100.0, 2.0)
MULTISINE = excitation.multisine(TIME, 0.0, 100.0, (0.5, 20.0), seed=1)
LEVELS = (0.0, 50.0, 20.0, 80.0, 0.0, 100.0, 30.0, 60.0)
STEPS = steps(TIME, LEVELS)


def noise(samples: int, correlation: float, seed: int) -> FloatArray:
    white = np.random.default_rng(seed).standard_normal(samples)
    coloured: FloatArray = lfilter([np.sqrt(1 - correlation**2)], [1, -correlation], white)
    return NOISE * coloured


def misfit_of(
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


def test_a_function_of_the_voltage() -> None:
    error = 3e-8 * np.sin(2 * np.pi * SINE / 100.0)
    m = misfit_of(SINE, error)
    result = shares(m)
    assert result["voltage"] > 0.97
    assert max(result[name] for name in ("time", "rate", "amplitude", "frequency")) == 0.0
    assert m.sentences[1].startswith("The residual follows the voltage: ")
    view = next(v for v in m.views if v.name == "voltage")
    truth = 3e-8 * np.sin(2 * np.pi * view.x / 100.0)
    assert np.max(np.abs(view.mean - truth)) < 4e-9
    assert m.rms == pytest.approx(np.hypot(np.std(error), NOISE), rel=0.02)
    assert m.excess == pytest.approx(1.0 - (NOISE / m.rms) ** 2, abs=0.02)
    assert m.sentences[0].startswith("The residual of r is 21 nm rms, 2.1 times the noise of")


def test_creep_after_every_step() -> None:
    slope = 1e-8
    error = np.zeros(TIME.size)
    for k in range(1, 8):
        since = np.arange(TIME.size - 2_500 * k)
        error[2_500 * k :] += np.sign(LEVELS[k] - LEVELS[k - 1]) * np.log10(1.0 + since / 10.0)
    m = misfit_of(STEPS, slope * error)
    assert m.holds is not None
    assert m.slope is not None
    assert m.holds.share > 0.4
    assert m.slope.value == pytest.approx(slope, rel=0.2)
    assert m.slope.value > 10.0 * m.slope.error
    assert any(s.startswith("In 7 holds the residual moves by +") for s in m.sentences)
    assert misfit_of(SINE, 0.0 * SINE).holds is None


def test_the_error_after_a_reversal() -> None:
    triangle = excitation.triangle(TIME, 0.0, 100.0, 1.0)
    since = np.mod(TIME, 0.5)
    m = misfit_of(triangle, 5e-8 * np.exp(-since / 0.02))
    result = shares(m)
    assert result["since_reversal"] > 0.9
    assert result["since_reversal"] == max(result.values())


#: Sines of three amplitudes [V] at three frequencies each.
SINES = np.concatenate(
    [excitation.sine(TIME[:4_000], 0.0, a, f) for a in (30, 60, 100) for f in (1, 2, 5)]
)
AMPLITUDE = np.repeat([30.0, 60.0, 100.0], 12_000)


def test_amplitude_and_frequency_of_the_drive() -> None:
    frequency = np.tile(np.repeat([1.0, 2.0, 5.0], 4_000), 3)
    by_amplitude = shares(misfit_of(SINES, 5e-10 * AMPLITUDE))
    by_frequency = shares(misfit_of(SINES, 1e-8 * frequency))
    assert by_amplitude["amplitude"] > 0.9
    assert by_amplitude["frequency"] < 0.1
    assert by_frequency["frequency"] > 0.9
    assert by_frequency["amplitude"] < 0.1


def test_delay_grows_with_frequency_and_gain_with_amplitude() -> None:
    delayed = misfit_of(SINES, -4e-11 * np.gradient(SINES, STEP))
    result = shares(delayed)
    assert result["frequency_lag"] > 0.3
    assert result["frequency_gain"] == result["frequency"] == 0.0
    view = next(w for w in delayed.views if w.name == "frequency_lag")
    assert np.all(np.diff(view.mean[[0, -1]]) < -5e-9)
    grown = 1e-9 * (SINES - 0.5 * AMPLITUDE) * (AMPLITUDE - 60.0)
    stronger = shares(misfit_of(SINES, grown))
    assert stronger["amplitude_gain"] > 0.3
    assert stronger["amplitude_lag"] == stronger["amplitude"] == 0.0


def test_a_drift_does_not_hide_a_smaller_error() -> None:
    drift = 2e-7 * (TIME / TIME[-1]) ** 2
    m = misfit_of(SINE, drift + 1e-8 * np.sin(2 * np.pi * SINE / 100.0))
    view = next(w for w in m.views if w.name == "voltage")
    assert shares(m)["time"] > 0.9
    assert view.significant
    assert np.ptp(view.mean) == pytest.approx(2e-8, rel=0.25)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("voltage", [SINE, MULTISINE, STEPS], ids=["sine", "multisine", "steps"])
def test_white_noise_shows_nothing(voltage: FloatArray, seed: int) -> None:
    m = misfit_of(voltage, 0.0 * voltage, seed=seed)
    assert len(m.sentences) == 1
    assert max(shares(m).values()) < 0.02
    assert m.spectrum.share < 0.02


def test_coloured_noise_misleads_in_one_of_forty_records_at_most() -> None:
    output = 0
    for seed in range(40):
        voltage = (SINE, MULTISINE, STEPS)[seed % 3][:8_000]
        output += len(misfit_of(voltage, 0.0 * voltage, correlation=0.7, seed=seed).sentences) > 1
    assert output <= 1


@pytest.mark.parametrize("correlation", [0.0, 0.7])
def test_standard_errors_know_of_correlation(correlation: float) -> None:
    squares = []
    for seed in range(6):
        m = misfit_of(MULTISINE, 0.0 * TIME, correlation=correlation, seed=seed)
        view = next(v for v in m.views if v.name == "time")
        squares.append(np.mean((view.mean / view.spread) ** 2))
    assert np.mean(squares) == pytest.approx(1.0, abs=0.35)


def test_missing_samples_and_rejected_ones() -> None:
    error = 3e-8 * np.sin(2 * np.pi * SINE / 100.0)
    residual = error + noise(TIME.size, 0.0, 0)
    record = Record(name="r", time=TIME, voltage=SINE, displacement=1e-7 * SINE + residual)
    gone = residual.copy()
    gone[np.random.default_rng(0).random(TIME.size) < 0.3] = np.nan
    gone[3_000:6_000] = np.nan
    floor = noise_floor([record], [gone])[0]
    m = misfit(record, gone, floor)
    assert shares(m)["voltage"] > 0.95
    assert m.split is not None
    assert m.split.odd > 10.0 * m.split.even
    for wrong in (residual[:-1], np.full(TIME.size, np.nan)):
        with pytest.raises(InputError, match=r"valid samples of .* instants; give one value"):
            misfit(record, wrong, floor)


def test_counts_stay_counts() -> None:
    residual: FloatArray = 3.0 * np.sin(2 * np.pi * SINE / 100.0)
    residual = residual + noise(TIME.size, 0.0, 0) / NOISE
    record = Record(
        name="r",
        time=TIME,
        voltage=SINE,
        displacement=100.0 * SINE + residual,
        displacement_unit="counts",
    )
    m = misfit(record, residual, noise_floor([record], [residual])[0])
    assert "2.1 counts rms" in m.sentences[0]
    assert "+3 counts at" in m.sentences[1] or "-3 counts at" in m.sentences[1]


@pytest.mark.parametrize("voltage", [SINE, MULTISINE], ids=["sine", "multisine"])
def test_a_line_at_57_9_hz(voltage: FloatArray) -> None:
    m = misfit_of(voltage, 2e-8 * np.sin(2 * np.pi * 57.9 * TIME))
    assert m.sentences[1].startswith("The residual has a line whatever the drive does: 57.9 Hz")
    assert len(m.sentences) == 2
    (line,) = m.spectrum.lines
    assert line.frequency == pytest.approx(57.9, abs=0.02)
    assert line.amplitude == pytest.approx(2e-8, rel=0.05)
    assert max(shares(m).values()) == 0.0


def test_the_mains_and_the_drive_are_named() -> None:
    f = 1.0 / 0.45
    error = 2e-8 * np.sin(2 * np.pi * 50.0 * TIME) + 1e-8 * np.sin(6 * np.pi * f * TIME)
    mains, harmonic = misfit_of(excitation.sine(TIME, 0.0, 100.0, f), error).spectrum.lines
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
        spectrum = misfit_of(SINE, 0.0 * SINE, correlation=correlation).spectrum
        ratio = spectrum.density[-100:] / spectrum.floor[-100:]
        assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1.0, abs=0.1)
        assert np.all(np.diff(spectrum.frequency) > 0)


def test_even_and_odd_nonlinearity_of_a_sine() -> None:
    w = 4 * np.pi * TIME
    error: FloatArray = 1.5e-8 * np.sin(w) + 2e-8 * np.cos(2 * w) + 1e-8 * np.sin(3 * w + 0.4)
    result = misfit_of(SINE, error)
    split = result.split
    assert split is not None
    assert split.fundamental == pytest.approx(2.0, rel=1e-6)
    assert split.excited == 1
    assert split.linear == pytest.approx(1.5e-8**2 / 2, rel=0.05)
    assert split.even == pytest.approx(2e-8**2 / 2, rel=0.05)
    assert split.odd == pytest.approx(1e-8**2 / 2, rel=0.1)
    assert split.noise == pytest.approx(NOISE**2, rel=0.05)
    assert "even nonlinearity (14 nm rms)" in result.sentences[-1]


def test_a_multisine_of_odd_lines_shows_its_nonlinearity_between_them() -> None:
    rng = np.random.default_rng(2)
    w = 2 * np.pi * TIME[:2_000] / 2.0
    odd = [k for k in range(1, 40, 2) if k % 8 != 5]
    u: FloatArray = np.tile(sum(np.cos(k * w + rng.uniform(0, 6.28)) for k in odd), 10) / 4.0
    linear = misfit_of(u, 3e-8 * u).split
    even = misfit_of(u, 3e-8 * (u**2 - np.mean(u**2))).split
    cubic = misfit_of(u, 3e-8 * u**3).split
    assert linear is not None
    assert even is not None
    assert cubic is not None
    assert (linear.excited, linear.even, linear.odd) == (len(odd), 0.0, 0.0)
    assert linear.linear == pytest.approx(9e-16 * np.mean(u**2), rel=0.02)
    assert (even.linear, even.odd) == (0.0, 0.0)
    assert even.even == pytest.approx(9e-16 * np.var(u**2), rel=0.02)
    assert cubic.even == 0.0
    assert cubic.odd > 100.0 * NOISE**2 / 1e3
    assert misfit_of(MULTISINE, 0.0 * TIME).split is None
