"""The plants outside the table do what their equations say."""

import numpy as np
import pytest

from tests.studies.plants import ceramic, mechanics, sensor
from tests.studies.plants.base import Run, simulate_base
from tests.studies.plants.excitations import draw_voltage
from tests.studies.plants.stack import FloatArray, draw_stack


@pytest.fixture(scope="module")
def run() -> Run:
    rng = np.random.default_rng(6)
    stack = draw_stack(rng)
    return simulate_base(stack, *draw_voltage(rng, stack.u_rated), 6)


def test_guide_is_stiff_about_its_centre_and_alike_on_both_sides() -> None:
    free = np.linspace(-10.0, 20.0, 3001)
    x = mechanics.guided(free, 5.0, 1.0, 0.25)
    spring = 0.25 * (np.tanh(x - 5.0) - np.tanh(-5.0))
    assert np.allclose(x + spring, free, atol=1e-9)
    slope = np.gradient(x, free)
    middle = int(np.argmin(np.abs(x - 5.0)))
    assert slope[middle] == pytest.approx(0.8, rel=1e-3)
    assert slope[[0, -1]] == pytest.approx([1.0, 1.0], rel=1e-4)
    left, right = (np.interp(5.0 + offset, x, slope) for offset in (-0.7, 0.7))
    assert left == pytest.approx(right, rel=1e-3)


def test_small_swings_have_no_hysteresis() -> None:
    start = np.linspace(0.0, 70.0, 71)
    small = np.concatenate((np.linspace(70.0, 45.0, 26), np.linspace(45.0, 70.0, 26)))
    quiet = ceramic.preisach(np.concatenate((start, small)), 30.0)
    assert quiet[70] == pytest.approx(0.5 * 40.0**2)
    assert np.all(quiet[71:] == quiet[70])
    large = ceramic.preisach(np.concatenate((start, start[::-1])), 30.0)
    width = large[71:][::-1] - large[:71]
    assert width[35] == pytest.approx(0.5 * 40.0**2 - 0.5 * 5.0**2 - 0.5 * 5.0**2)


def test_neighbour_ignores_the_voltage_and_stays_in_its_band(run: Run) -> None:
    quiet = simulate_base(run.stack, run.times, np.zeros_like(run.command), 1)
    parameters = mechanics.cross_axis.draw(np.random.default_rng(2), run)
    moved = mechanics.cross_axis.contribution(run, parameters, 1e-7)
    assert np.array_equal(moved, mechanics.cross_axis.contribution(quiet, parameters, 1e-7))
    w = mechanics.neighbour(run.times, parameters)
    power = np.abs(np.fft.rfft(w * np.hanning(w.size))) ** 2
    frequency = np.fft.rfftfreq(w.size, float(run.times[1] - run.times[0]))
    margin = 3.0 / float(run.times[-1])
    inside = (frequency > parameters["f_1"] - margin) & (frequency < parameters["f_2"] + margin)
    assert power[inside].sum() > 0.999 * power.sum()
    lag = (w - moved / 1e-7) / parameters["a"]
    assert np.abs(lag).max() == pytest.approx(parameters["r"])


def test_range_switches_later_down_than_up(run: Run) -> None:
    x = np.concatenate((np.linspace(0.0, 10.0, 101), np.linspace(10.0, 0.0, 101)))
    state = sensor.upper(x, 5.0, 0.55)
    assert x[:101][state[:101] == 0.0].max() == pytest.approx(5.5)
    assert x[101:][state[101:] == 1.0].min() == pytest.approx(4.5)
    assert set(state.tolist()) == {0.0, 1.0}
    parameters = sensor.range_switch.draw(np.random.default_rng(1), run)
    error = sensor.range_switch.contribution(run, parameters, 0.01)
    changed = error != 0.0
    assert np.allclose(error[changed], 0.01 * run.displacement[changed])
    assert 0.05 < np.mean(changed) < 0.95


def test_flicker_is_stationary_and_correlated_over_its_time() -> None:
    times: FloatArray = np.linspace(0.0, 59.999, 60_000)
    n = sensor.flicker(times, 0.05, 3)
    assert np.mean(n) == pytest.approx(0.0, abs=1e-12)
    assert np.std(n) == pytest.approx(1.0)
    # two equal poles: correlation (1 + s/T) exp(-s/T)
    for lag in (25, 50, 100):
        expected = (1.0 + lag / 50.0) * np.exp(-lag / 50.0)
        assert np.mean(n[lag:] * n[:-lag]) == pytest.approx(expected, abs=0.06)
    assert np.std(n[:30_000]) == pytest.approx(np.std(n[30_000:]), rel=0.2)


def test_asymmetric_memory_is_a_play_and_its_square(run: Run) -> None:
    """No weight on squares gives the plays alone; branches differ most at the top of the span."""
    drawn = ceramic.asymmetric_memory.draw(np.random.default_rng(3), run)
    plain = ceramic.asymmetric_memory.contribution(run, {**drawn, "b": 0.0}, 0.1)
    assert np.allclose(plain, ceramic.hysteresis_memory.contribution(run, drawn, 0.1), atol=1e-15)
    squares = ceramic.asymmetric_memory.contribution(run, {**drawn, "b": 1.0}, 0.1) - plain
    top = run.command > 0.8 * run.command.max()
    low = run.command < 0.2 * run.command.max()
    assert np.ptp(squares[top]) > 2.0 * np.ptp(squares[low])
