"""Voltages that are smooth between their samples or straight lines, stamps that jitter or not."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.identification.fitting.fit import Fit, fit
from psa_casadi.identification.inputs import even_clock, smooth_between
from psa_casadi.model.stacks import stack_model
from psa_casadi.records.record import Record
from psa_casadi.records.split import Experiment, whole
from psa_casadi.simulation.simulate import simulate

FINER, STEP, COUNT = 20, 2e-4, 4000
NOISE = 4e-9
FREE = ["k_L", "A", "beta", "gamma", "c_P", "m_P"]


def _chirp(time: FloatArray) -> FloatArray:
    """From 5 to 120 Hz in a second: 40 samples of 0.2 ms in the last period."""
    return 50.0 * (1.0 - np.cos(2.0 * np.pi * (5.0 * time + 57.5 * time**2)))


def _record(*, smooth: bool) -> tuple[Fit, tuple[Experiment, ...]]:
    """A stack that rings at 800 Hz, with 4 nm of noise, and a fit of it."""
    fine: FloatArray = np.linspace(0.0, STEP * COUNT, FINER * COUNT, endpoint=False)
    time = fine[::FINER]
    driven = _chirp(fine) if smooth else np.interp(fine, time, _chirp(time))
    model = stack_model("demo")
    k, omega = model.values["k_P"], 2.0 * np.pi * 800.0
    model = model.with_values({"m_P": k / omega**2, "c_P": 0.08 * k / omega, "tau": 1e-5})
    x = simulate(model, fine, driven).displacement[::FINER]
    noise = NOISE * np.random.default_rng(1).standard_normal(COUNT)
    record = Record(name="r", time=time, voltage=_chirp(time), displacement=x + noise)
    experiments = (whole(record),)
    return fit(model, experiments, FREE, sigma=[NOISE]), experiments


def test_a_smooth_voltage_is_seen_and_straight_lines_get_the_mean_of_its_curve() -> None:
    result, experiments = _record(smooth=True)
    otherwise = smooth_between(result)
    assert otherwise is not None
    (moved,), note = otherwise
    assert note.code == "smooth_voltage"
    assert note.values["share"] == pytest.approx(1.0, abs=0.25)
    voltage, before = moved.record.voltage, experiments[0].record.voltage
    # a sine of angular frequency w needs amplitudes larger by 1 + (w h)^2/12
    last = slice(COUNT - 60, COUNT)
    phase_rate = 2.0 * np.pi * (5.0 + 115.0 * moved.record.time[last])
    larger = (before[last] - 50.0) * (phase_rate * STEP) ** 2 / 12.0
    np.testing.assert_allclose((voltage - before)[last][5:-5], larger[5:-5], atol=0.01)
    again = fit(result.model, (moved,), result.unknowns.names, sigma=[NOISE])
    assert again.rms < 1.02 * NOISE < result.rms
    assert smooth_between(again) is None


def test_straight_lines_and_other_errors_are_left_as_they_are() -> None:
    result, experiments = _record(smooth=False)
    assert smooth_between(result) is None
    time = experiments[0].record.time
    other = replace(result, residuals=result.residuals + 5e-8 * np.sin(700.0 * time))
    assert smooth_between(other) is None


@pytest.mark.parametrize("stamps", [True, False])
def test_stamps_that_jitter_are_told_from_samples_that_do(stamps: bool) -> None:
    """A tenth of a step: either the file's times are wrong, or the samples were taken then."""
    random = np.random.default_rng(4)
    even: FloatArray = np.linspace(0.0, STEP * (COUNT - 1), COUNT)
    jitter = 0.1 * STEP * np.clip(random.standard_normal(COUNT), -3.0, 3.0)
    late: FloatArray = np.asarray(even + jitter, dtype=np.float64)
    late[0] = 0.0
    taken: FloatArray = even if stamps else late
    fine = np.sort(np.concatenate([taken, np.linspace(0.0, taken[-1], 4 * COUNT)[1:-1]]))
    model = stack_model("demo")
    x = simulate(model, fine, np.interp(fine, taken, _chirp(taken))).displacement
    displayed = np.interp(taken, fine, x) + NOISE * random.standard_normal(COUNT)
    record = Record(name="r", time=late, voltage=_chirp(taken), displacement=displayed)
    result = fit(model, (whole(record),), FREE[:4], sigma=[NOISE])
    otherwise = even_clock(result)
    assert (otherwise is not None) == stamps
    if otherwise is not None:
        (moved,), note = otherwise
        assert note.values["rms"] == pytest.approx(0.1 * STEP, rel=0.05)
        np.testing.assert_allclose(moved.record.time, even, atol=0.01 * STEP)
        again = fit(result.model, (moved,), FREE[:4], sigma=[NOISE])
        assert again.rms < 1.05 * NOISE < 0.5 * result.rms
        assert even_clock(again) is None


@pytest.mark.slow
def test_a_healthy_stack_under_a_fast_smooth_voltage_is_adequate() -> None:
    """A Bouc-Wen loop in front of a resonance of 800 Hz: its ringing shows what chords cut off."""
    fine: FloatArray = np.linspace(0.0, 1.9, 9500 * FINER, endpoint=False)
    loops = np.interp(fine, 0.15 * np.arange(7), [0.0, 100.0, 0.0, 70.0, 0.0, 40.0, 0.0])
    u = np.where(fine < 0.9, loops, _chirp(fine - 0.9))
    h = np.zeros_like(u)
    for k, du in enumerate(np.diff(u)):
        middle = h[k] + 0.5 * _rate(h[k], du)
        h[k + 1] = h[k] + _rate(middle, du)
    x = _rings(1e-7 * (u + h), STEP / FINER)[::FINER]
    noise = NOISE * np.random.default_rng(3).standard_normal(x.size)
    d = diagnose(Record(name="r", time=fine[::FINER], voltage=u[::FINER], displacement=x + noise))
    assert d.verdict == "adequate", d
    assert any("Between its samples" in n for n in d.notes)


def _rate(h: float, du: float) -> float:
    """Change of a Bouc-Wen state h [V] with the voltage."""
    return -0.2 * du - 0.025 * abs(du) * h - 0.006 * du * abs(h)


def _rings(x: FloatArray, step: float) -> FloatArray:
    """The response of a mode of 800 Hz and a quality of 12, by its poles; gain 1 at rest."""
    pole = 2.0 * np.pi * 800.0 * complex(-1.0 / 24.0, np.sqrt(1.0 - 1.0 / 24.0**2))
    z = np.exp(pole * step)
    lower = [1.0, -2.0 * z.real, abs(z) ** 2]
    weights = np.array([1.0, 4.0, 1.0]) / 6.0  # straight lines between the fine samples
    values: FloatArray = lfilter(sum(lower) * weights, lower, x)
    return values
