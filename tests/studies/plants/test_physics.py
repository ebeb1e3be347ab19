"""Each plant does what its equation says: closed forms, known plants."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from tests.studies.plants import ceramic, drive, mechanics, sensor
from tests.studies.plants.base import Run, simulate_base
from tests.studies.plants.ceramic import since_reversal, with_memory
from tests.studies.plants.excitations import draw_voltage
from tests.studies.plants.stack import FloatArray, draw_stack


@pytest.fixture(scope="module")
def run() -> Run:
    rng = np.random.default_rng(5)
    stack = draw_stack(rng)
    times, command = draw_voltage(rng, stack.u_rated)
    return simulate_base(stack, times[:1500], command[:1500], 12)


@pytest.fixture(scope="module")
def held(run: Run) -> Run:
    """Half the rated voltage, reached in 50 ms and held until every lag is over."""
    times: FloatArray = np.linspace(0.0, 0.999, 1000)
    command = np.minimum(times / 0.05, 1.0) * 0.5 * run.stack.u_rated
    return simulate_base(run.stack, times, command, 8)


def ramps(*corners: float) -> FloatArray:
    return np.concatenate([np.linspace(a, b, 200) for a, b in pairwise(corners)])


def test_memory_equals_a_plane_of_relays() -> None:
    voltage = ramps(0.0, 60.0, 10.0, 45.0, 20.0, 50.0, 5.0, 80.0, 0.0)
    edge = (np.arange(320) + 0.5) * 0.25
    up, down = np.meshgrid(edge, edge, indexing="ij")
    relays = np.zeros_like(up, dtype=bool)
    expected = []
    for value in voltage.tolist():
        relays |= up <= value
        relays &= down < value
        expected.append(np.count_nonzero(relays & (up > down)) * 0.25**2)
    found = ceramic.rayleigh(voltage)
    assert np.abs(found - np.asarray(expected)).max() < 0.01 * found.max()


def test_memory_wipes_out_what_it_passes() -> None:
    plain = ceramic.rayleigh(ramps(0.0, 60.0, 10.0))
    detour = ceramic.rayleigh(ramps(0.0, 40.0, 20.0, 35.0, 60.0, 10.0))
    assert detour[-1] == pytest.approx(plain[-1], rel=1e-12)
    assert plain[199] == pytest.approx(1800.0)
    assert plain[-1] == pytest.approx(1800.0 - 1250.0)
    linear = with_memory(ramps(0.0, 30.0, 10.0), lambda swing: swing)
    assert np.allclose(linear, ramps(0.0, 30.0, 10.0))


def test_play_widens_with_the_logarithm_of_the_rate() -> None:
    distance = []
    for rate in (1.0, 99.0, 9999.0):
        voltage: FloatArray = np.linspace(0.0, 80.0, 401)
        wider = 1.0 + 0.1 * ceramic.growth(np.full(401, rate), q=1.0)
        play = ceramic.moving_play(voltage, 10.0 * wider)
        distance.append(voltage[-1] - play[-1])
    assert distance == pytest.approx([10.0 + math.log10(2.0), 12.0, 14.0])


def test_rate_is_that_of_the_drive(run: Run) -> None:
    path = run.path
    rate = ceramic.drive_rate(run)
    slope = np.diff(path.voltage) / run.fine_step
    middle = 0.5 * (rate[path.node][1:] + rate[path.node][:-1])
    assert np.corrcoef(middle, slope)[0, 1] > 0.95
    inserted = np.setdiff1d(np.arange(path.path_time.size), path.node)
    assert inserted.size > 20
    assert np.abs(rate[inserted]).max() < 1e-6 * np.abs(rate).max()


def test_gain_grows_with_the_field(held: Run) -> None:
    parameters = {"p": 1.0, "w": 0.4}
    added = ceramic.field_dependent_gain.contribution(held, parameters, 0.1)
    expected = 0.1 * held.stack.stroke * (0.6 * 0.5**2 + 0.4 * 0.5 * 0.5**2)
    assert added[-1] == pytest.approx(expected, rel=1e-6)


def test_strain_saturates(held: Run) -> None:
    assert ceramic.bent(np.array([1e4]), 2.0)[0] == pytest.approx(1.0)
    lost = ceramic.saturation_of_strain.contribution(held, {"p": 2.0}, 1.0)
    expected = held.stack.stroke * (0.5 / math.sqrt(1.25) - 0.5)
    assert lost[-1] == pytest.approx(expected, rel=1e-6)


def test_hardening_spring_is_in_balance() -> None:
    free = np.linspace(-2e-5, 4e-5, 301)
    for stiffness in (1e-3, 0.2, 5.0):
        x = mechanics.balance(free, 1e-5, stiffness)
        assert np.allclose(x + stiffness * 1e-5 * np.sinh(x / 1e-5), free, atol=1e-18)
        small = mechanics.balance(np.array([1e-9]), 1e-5, stiffness)
        assert small[0] == pytest.approx(1e-9 / (1.0 + stiffness), rel=1e-6)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_contact_changes_the_slope_on_one_side(side: float) -> None:
    free = np.linspace(0.0, 10.0, 101)
    x = free - mechanics.contact(free, 4.0, side, 0.25)
    slope = np.diff(x) / np.diff(free)
    touched = side * (0.5 * (free[1:] + free[:-1]) - 4.0) > 0.0
    assert slope[touched] == pytest.approx(0.8)
    assert slope[~touched] == pytest.approx(1.0)
    assert x[0] == 0.0


def test_backlash_dwells_for_its_width_whatever_the_amplitude(run: Run) -> None:
    for top in (10e-6, 3e-6):
        moved = 1e-6 * ramps(0.0, 1e6 * top, 0.0)
        trial = replace(run, fine_displacement=moved, sub_intervals=1)
        out = moved + mechanics.backlash.contribution(trial, {}, 0.5e-6)
        back = moved[200:][out[200:] < out[199] - 1e-12]
        assert out[199] == pytest.approx(top - 0.5e-6)
        assert top - back.max() == pytest.approx(1.0e-6, rel=0.1)


def test_heat_is_a_power_of_each_swing() -> None:
    voltage = ramps(0.0, 60.0, 20.0, 30.0)
    heat = ceramic.heat(voltage, 3.0)
    assert heat[-1] == pytest.approx((60.0**3 + 40.0**3 + 10.0**3) / 3.0)
    assert np.all(np.diff(heat) >= 0.0)
    assert since_reversal(voltage)[-1] == pytest.approx(10.0)
    energy = 2.0 * np.linspace(0.0, 5.0, 501)
    warm = ceramic.warmed(energy, 0.01, 1.5)
    assert np.allclose(warm, 2.0 * (1.0 - np.exp(-np.linspace(0.0, 5.0, 501) / 1.5)), atol=1e-12)


def test_ageing_counts_cycles(held: Run) -> None:
    assert ceramic.cycles(ramps(0.0, 40.0, 0.0, 20.0, 0.0), 80.0)[-1] == pytest.approx(0.75)
    lost = ceramic.ageing.contribution(held, {"n_0": 0.25}, 0.02)
    expected = -0.02 * math.log10(2.0) * held.displacement[-1]
    assert lost[-1] == pytest.approx(expected, rel=1e-6)


def test_clipped_command_is_the_base_with_that_command(held: Run) -> None:
    command = held.command.copy()
    parts = drive.voltage_saturation.contribution(held, {}, 0.2)
    clipped = simulate_base(held.stack, held.times, np.minimum(command, 0.8 * command.max()), 8)
    assert np.allclose(held.displacement + parts, clipped.displacement, atol=1e-13)
    assert np.ptp(parts) > 0.1 * np.ptp(held.displacement)


def test_drive_lag_has_the_gain_of_second_order(run: Run) -> None:
    constant, zeta, step = 2e-3, 0.8, 1e-5
    time = step * np.arange(100_000)
    for ratio in (0.3, 1.0, 2.0):
        out = drive.filtered(np.sin(ratio / constant * time), step, constant, zeta)
        expected = 1.0 / math.hypot(1.0 - ratio**2, 2.0 * zeta * ratio)
        assert out[50_000:].max() == pytest.approx(expected, rel=1e-3)
    quick = drive.drive_lag.contribution(run, {"zeta": 0.8}, 2e-5)
    slow = drive.drive_lag.contribution(run, {"zeta": 0.8}, 2e-3)
    assert np.std(quick) < 0.03 * np.std(slow)


def test_leak_droops_exponentially(held: Run) -> None:
    time = 1e-3 * np.arange(3000)
    low_pass = drive.droop(np.ones(3000), 1e-3, 0.7)
    assert np.allclose(low_pass, 1.0 - np.exp(-time / 0.7), atol=1e-12)
    elastic = replace(held.stack, a=0.0, beta=0.0, gamma=0.0, delta=0.0)
    quiet = simulate_base(elastic, held.times, held.command, 8)
    lost = drive.charge_leakage.contribution(quiet, {"t": 0.1}, 0.2)
    droop = np.exp(-(held.times[100:] - 0.05) / 0.1) * (np.exp(0.5) - 1.0) / 0.5
    left = -0.2 * 0.5 * elastic.stroke * (1.0 - np.exp(-0.5) * droop)
    assert np.allclose(lost[100:], left, atol=0.02 * np.abs(left).max())
    assert lost[-1] == pytest.approx(-0.1 * elastic.stroke, rel=1e-3)


def test_sensor_lag_follows_a_ramp_at_its_time_constant(run: Run) -> None:
    time: FloatArray = np.linspace(0.0, 0.1999, 2000)
    trial = replace(run, times=time, fine_displacement=time, sub_intervals=1)
    late = sensor.sensor_lag.contribution(trial, {}, 5e-3)
    assert np.allclose(late, -5e-3 * (1.0 - np.exp(-time / 5e-3)), atol=1e-12)


def test_sensor_error_is_a_function_of_the_displacement(run: Run) -> None:
    ends = sensor.bend(np.array([-2.0, 3.0, 8.0]), 3.0, 10.0, 1.7)
    assert np.allclose(ends, 0.0, atol=1e-12)
    parameters = sensor.sensor_nonlinearity.draw(np.random.default_rng(2), run)
    order = np.random.default_rng(3).permutation(run.times.size)
    mixed = replace(run, fine_displacement=run.displacement[order], sub_intervals=1)
    error = sensor.sensor_nonlinearity.contribution(run, parameters, 0.1)
    assert np.array_equal(
        error[order], sensor.sensor_nonlinearity.contribution(mixed, parameters, 0.1)
    )
    assert abs(error[0]) < 1e-18 + 1e-6 * np.ptp(error)


def test_hum_is_a_line_and_its_third_harmonic(run: Run) -> None:
    parameters = sensor.mains_hum.draw(np.random.default_rng(4), run)
    hum = sensor.mains_hum.contribution(run, parameters, 1e-7)
    angle = 2.0 * math.pi * parameters["frequency"] * run.times
    waves = np.column_stack([f(k * angle) for k in (1, 3) for f in (np.sin, np.cos)])
    found = np.linalg.lstsq(waves, hum, rcond=None)[0]
    assert np.hypot(found[0], found[1]) == pytest.approx(1e-7)
    assert np.hypot(found[2], found[3]) == pytest.approx(1e-7 * parameters["b"])
    assert np.allclose(waves @ found, hum, atol=1e-15)


def test_frame_follows_the_thermometer_through_the_wall(run: Run) -> None:
    """y = d L^-1{p^2/(s + p)^2 (1/s - 1/(s + a))}, a = 1/tau, p = 2/tau_f."""
    parameters = {**sensor.temperature.draw(np.random.default_rng(1), run), "walk": 0.0, "b": 0.0}
    d, a, p = parameters["d"], 1.0 / parameters["tau"], 2.0 / parameters["tau_f"]
    t, decay = run.times - run.times[0], np.exp(-p * (run.times - run.times[0]))
    slow = (p / (p - a)) ** 2 * (np.exp(-a * t) - (1.0 + (p - a) * t) * decay)
    grown = sensor.temperature.contribution(run, parameters, 1e-7)
    expected = 1e-7 * d * (1.0 - (1.0 + p * t) * decay - slow)
    assert np.allclose(grown, expected, atol=1e-5 * np.ptp(grown))
    room = sensor.room(run.times, {**parameters, "walk": 0.3})
    assert np.std(np.diff(room)) > 2.0 * np.std(np.diff(sensor.room(run.times, parameters)))
