"""Times and voltages between samples: two clocks, jitter, smooth voltages or straight lines."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from psa_casadi import two_clocks
from psa_casadi.common.notes import texts
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.identification.fitting.fit import Fit, fit
from psa_casadi.identification.inputs import even_clock, smooth_between
from psa_casadi.identification.prepare import prepared
from psa_casadi.model.stacks import stack_model
from psa_casadi.records import read_record
from psa_casadi.records.record import Record
from psa_casadi.records.split import Experiment, whole
from psa_casadi.simulation.simulate import simulate
from tests.studies.plants.base import Run, simulate_base
from tests.studies.plants.sensor import held
from tests.studies.plants.stack import draw_stack

#: Sampling time [s], samples, renewals in one of them, and loops in the record.
STEP, SAMPLES, RENEWALS, LOOPS = 5e-3, 3000, 4, 40


def played(size: FloatArray) -> Run:
    """Play loops whose size (n,) goes over half of the rated voltage."""
    stack, time = draw_stack(np.random.default_rng(11)), np.arange(SAMPLES, dtype=float) * STEP
    turn = 2.0 * np.pi * LOOPS * np.arange(SAMPLES) / SAMPLES
    voltage = np.round(stack.u_rated * size * (1.0 - np.cos(turn)), 3).astype(float)
    return simulate_base(stack, time, voltage)


@pytest.fixture(scope="module")
def run() -> Run:
    return played(0.45 - 0.2 * np.arange(SAMPLES) / SAMPLES)


def record(run: Run, displacement: FloatArray, noise: float = 0.0, seed: int = 5) -> Record:
    """Return a record with white noise, in m."""
    displayed = displacement + noise * np.random.default_rng(seed).standard_normal(SAMPLES)
    return Record(name="r", time=run.times, voltage=run.command, displacement=displayed)


def two_clocked(run: Run, beats: float) -> tuple[FloatArray, FloatArray]:
    """Return what two clocks read, (n,) [m], and what of it is more than a constant delay."""
    reading = held(run, RENEWALS, beats / SAMPLES / RENEWALS, 0.3)
    added, rate = reading - run.displacement, np.gradient(run.displacement, run.times)
    even: FloatArray = added - rate * (added @ rate) / (rate @ rate)
    return reading, even


@pytest.mark.parametrize("beats", [-4.3, 2.8, 3.6])
def test_the_saw_tooth_is_detected_and_undone(run: Run, beats: float) -> None:
    """Period within 1 %, height within 10 %, under noise twice the saw tooth."""
    reading, even = two_clocked(run, beats)
    inputs = record(run, reading, 2.0 * float(np.std(even)))
    result = two_clocks(inputs)
    assert result is not None
    assert result.period == pytest.approx(STEP * SAMPLES / abs(beats), rel=0.01)
    assert result.height == pytest.approx(STEP / RENEWALS, rel=0.1)
    assert result.falling == (beats < 0)
    assert np.std(result.moved - even) < 0.25 * np.std(even)
    there = result.undone(inputs)
    assert two_clocks(there) is None
    assert there.sha256 != inputs.sha256


def test_the_finding_is_reported_and_repeats(run: Run) -> None:
    """In the sentences of a fit; the same within 1 % when the data change by 1 % of their noise."""
    reading, even = two_clocked(run, -3.3)
    noise = 2.0 * float(np.std(even))
    inputs = record(run, reading, noise)
    result, gaps = two_clocks(inputs), np.asarray(inputs.displacement).copy()
    assert result is not None
    again = two_clocks(record(run, np.asarray(inputs.displacement), 0.01 * noise, seed=6))
    assert again is not None
    assert again.period == pytest.approx(result.period, rel=0.01)
    assert again.height == pytest.approx(result.height, rel=0.01)
    ready, statement = prepared(inputs)
    assert any("sampled by two clocks" in s for s in texts(statement))
    assert two_clocks(ready) is None
    assert (ready.name, ready.sha256) == (inputs.name, inputs.sha256)
    gaps[100:110] = np.nan
    with_gaps = two_clocks(replace(inputs, displacement=gaps))
    assert with_gaps is not None
    assert with_gaps.period == pytest.approx(result.period, rel=0.01)
    assert np.isnan(with_gaps.moved[100:110]).all()


def test_the_measured_sine_has_two_clocks(measured_data: Path) -> None:
    """As docs/evidence.md states it; the minor loops show too little of it."""
    sine, loops = (
        read_record(measured_data / "micromanipulator" / f"{name}.csv")
        for name in ("sine_1hz", "minor_loops")
    )
    result = two_clocks(sine)
    assert result is not None
    output = result.sentence(sine).split(": ", 1)[1].split(". ")[0]
    page = (Path(__file__).parents[2] / "docs" / "evidence.md").read_text(encoding="utf-8")
    text = " ".join(page.split())
    assert output.split(": ")[1] in text
    assert two_clocks(loops) is None


def test_nothing_else_is_taken_for_two_clocks(run: Run) -> None:
    """Noise, delays, their drift, a hum, a slow wave of the delay, one jump of it, uneven steps."""
    x, rate = run.displacement, np.gradient(run.displacement, run.times)
    along, noise = run.times / run.times[-1], 1e-3 * float(np.ptp(run.displacement))
    delays = {
        "none": 0.0 * along,
        "constant": 1e-3 + 0.0 * along,
        "drifting": 2e-3 * along,
        "wave": 1e-3 * np.sin(2.0 * np.pi * 2.7 * along),
        "triangle": 1e-3 * np.abs((2.7 * along) % 1.0 - 0.5),
        "jump": 1e-3 * (along > 0.4),
    }
    for name, delay in delays.items():
        assert two_clocks(record(run, x - delay * rate, noise)) is None, name
    assert two_clocks(record(run, x + noise * np.sin(300.0 * run.times), noise)) is None
    saw = two_clocks(record(run, x - 1e-3 * ((2.7 * along) % 1.0) * rate, noise))
    assert saw is not None
    still = Record(name="still", time=run.times, voltage=0.0 * x, displacement=noise * along)
    assert two_clocks(still) is None


FINER, INTERVAL, COUNT = 20, 2e-4, 4000
NOISE = 4e-9
FREE = ["k_L", "A", "beta", "gamma", "c_P", "m_P"]


def _chirp(time: FloatArray) -> FloatArray:
    """From 5 to 120 Hz in a second: 40 samples of 0.2 ms in the last period."""
    return 50.0 * (1.0 - np.cos(2.0 * np.pi * (5.0 * time + 57.5 * time**2)))


def _record(*, smooth: bool) -> tuple[Fit, tuple[Experiment, ...]]:
    """A stack that rings at 800 Hz, with 4 nm of noise, and a fit of it."""
    fine: FloatArray = np.linspace(0.0, INTERVAL * COUNT, FINER * COUNT, endpoint=False)
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


def test_a_smooth_voltage_is_detected_and_straight_lines_get_the_mean_of_its_curve() -> None:
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
    larger = (before[last] - 50.0) * (phase_rate * INTERVAL) ** 2 / 12.0
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
def test_stamps_that_jitter_are_distinguished_from_samples_that_do(stamps: bool) -> None:
    """A tenth of a step: either the file's times are wrong, or the samples were taken then."""
    random = np.random.default_rng(4)
    even: FloatArray = np.linspace(0.0, INTERVAL * (COUNT - 1), COUNT)
    jitter = 0.1 * INTERVAL * np.clip(random.standard_normal(COUNT), -3.0, 3.0)
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
        assert note.values["rms"] == pytest.approx(0.1 * INTERVAL, rel=0.05)
        np.testing.assert_allclose(moved.record.time, even, atol=0.01 * INTERVAL)
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
    x = _rings(1e-7 * (u + h), INTERVAL / FINER)[::FINER]
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
