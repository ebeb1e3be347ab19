"""The independent plants: their numerics and their physics are what they claim."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from psa_casadi.cli.demo import HIDDEN
from tests.studies.plants.base import (
    SUB_INTERVALS,
    Run,
    elastic_displacement,
    force_to_displacement,
    hysteresis_force,
    simulate_base,
)
from tests.studies.plants.ceramic import creep, play
from tests.studies.plants.drive import limited_drive
from tests.studies.plants.effect import HiddenEffect
from tests.studies.plants.excitations import draw_voltage
from tests.studies.plants.hide import RATIO
from tests.studies.plants.make import HEADER, make_demo, make_record
from tests.studies.plants.mechanics import friction, structural_mode
from tests.studies.plants.sensor import offset_drift, sensor_delay
from tests.studies.plants.stack import FloatArray, Stack, draw_stack, loop_width
from tests.studies.plants.table import HIDDEN_EFFECTS
from tests.tiers import slow_but

CONVERGENCE = 2e-5
"""Largest change of the displacement over its range when the grid is refined by 4."""
EFFECTS = list(HIDDEN_EFFECTS.values())


def solve_as_ode(s: Stack, times: FloatArray, command: FloatArray) -> FloatArray:
    """The contract's equations as one set of differential equations, restarted at every sample."""

    def rate(t: float, z: FloatArray) -> FloatArray:
        u, force, out, y, v_y, x, v_x = z
        du = (np.interp(t, times, command) - u) / s.drive_time
        sign = du / np.hypot(du, s.hold_rate)
        power = (abs(force) / s.h_ref) ** s.n
        hysteresis = s.a * du - power * (s.beta * du * sign * np.sign(force) + s.gamma * du)
        reaction = s.c_p * v_y + s.k_p * y
        a_x = (reaction - s.c_b * (v_x - v_y) - s.k_b * (x - y)) / s.m_b
        lag = (s.k_l * u + force - out) / s.tau
        return np.array(
            [du, hysteresis + s.delta * u * sign, lag, v_y, (out - reaction) / s.m_p, v_x, a_x]
        )

    state = np.zeros(7)
    displacement = [0.0]
    scale = np.array([1e-9, 1e-7, 1e-7, 1e-14, 1e-9, 1e-14, 1e-9])
    for start, end in pairwise(times.tolist()):
        found = solve_ivp(rate, (start, end), state, method="LSODA", rtol=1e-9, atol=scale)
        state = found.y[:, -1]
        displacement.append(float(state[5]))
    return np.asarray(displacement)


@pytest.fixture(scope="module")
def run() -> Run:
    """One base simulation over a full record."""
    return _base_run(5)


@pytest.fixture(scope="module")
def clean_lines(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """The file of a record that hides nothing."""
    path = tmp_path_factory.mktemp("clean") / "clean.csv"
    make_record(None, 11, path)
    return path.read_text(encoding="utf-8").splitlines()


def _base_run(seed: int) -> Run:
    rng = np.random.default_rng(seed)
    stack = draw_stack(rng)
    return simulate_base(stack, *draw_voltage(rng, stack.u_rated))


def _part(run: Run, samples: int, sub_intervals: int = SUB_INTERVALS) -> Run:
    return simulate_base(
        run.stack, run.times[:samples], run.command[:samples], sub_intervals=sub_intervals
    )


@pytest.mark.parametrize("seed", [5, 6])
def test_refining_the_grid_by_four_changes_nothing(seed: int) -> None:
    base = _base_run(seed)
    fine = _part(base, 1500, 4 * SUB_INTERVALS).displacement
    error = np.abs(_part(base, 1500).displacement - fine).max()
    assert error < CONVERGENCE * np.ptp(fine)


def test_base_solves_the_differential_equations(run: Run) -> None:
    samples = 150
    part = _part(run, samples)
    expected = solve_as_ode(run.stack, part.times, part.command)
    assert np.ptp(part.command) > 0.5 * run.stack.u_rated
    assert np.abs(part.displacement - expected).max() < CONVERGENCE * np.ptp(expected)


def test_elastic_path_is_exact_on_any_grid(run: Run) -> None:
    step = float(run.times[1] - run.times[0])
    on_samples = elastic_displacement(run.stack, run.command, step)
    path = run.path
    on_fine = force_to_displacement(run.stack, run.stack.k_l * path.voltage, run.fine_step)
    error = np.abs(on_samples - on_fine[:: run.sub_intervals]).max()
    assert error < 5e-4 * np.ptp(on_samples)


@pytest.mark.parametrize("seed", range(6))
def test_drawn_stacks_are_typical(seed: int) -> None:
    stack = draw_stack(np.random.default_rng(seed))
    assert 0.08 <= loop_width(stack) / (stack.k_l * stack.u_rated) <= 0.16
    assert 10e-6 <= stack.stroke <= 40e-6
    assert stack.a < 0.0
    assert stack.delta < 0.0
    assert np.all(stack.force_poles().real < 0.0)


@pytest.mark.parametrize("seed", range(6))
def test_voltage_is_rich_in_both_parts(seed: int) -> None:
    span = 80.0
    times, voltage = draw_voltage(np.random.default_rng(seed), span)
    assert 4000 <= voltage.size <= 6000
    assert voltage[0] == 0.0
    assert voltage.min() >= 0.0
    assert voltage.max() <= span
    split = 3 * voltage.size // 4
    for part in (voltage[:split], voltage[split:]):
        change = np.diff(part)
        still = np.flatnonzero(change != 0.0)
        longest = np.diff(np.concatenate(([-1], still, [change.size]))).max()
        assert longest * (times[1] - times[0]) > 0.4
        assert np.abs(change).max() > 0.2 * span
        assert np.ptp(part) > 0.75 * span


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.name)
def test_effect_vanishes_at_gain_zero(effect: HiddenEffect, run: Run) -> None:
    part = _part(run, 800)
    parameters = effect.draw(np.random.default_rng(1), part)
    assert np.all(effect.contribution(part, parameters, 0.0) == 0.0)
    largest = effect.contribution(part, parameters, effect.plausible[1])
    assert np.ptp(largest) > 1e-3 * np.ptp(part.displacement)


@pytest.mark.parametrize(
    "effect",
    slow_but([EFFECTS[0]], [EFFECTS[0], *(e for e in EFFECTS if e.room is not None), None]),
    ids=lambda e: e.name if e else "none",
)
def test_strength_zero_is_the_clean_record(
    effect: HiddenEffect | None, clean_lines: list[str], tmp_path: Path
) -> None:
    """One effect, those that need a thermometer, and none; the test above has all of them."""
    name = None if effect is None else effect.name
    truth = make_record(name, 11, tmp_path / "effect.csv", strength=0.0)
    assert np.array_equal(truth.displacement, truth.base_displacement)
    lines = (tmp_path / "effect.csv").read_text(encoding="utf-8").splitlines()
    if truth.temperature is not None:
        lines = [line.rpartition(",")[0] for line in lines]
    assert lines == clean_lines


def test_record_holds_what_the_truth_says(tmp_path: Path) -> None:
    truth = make_record("slow_creep", 3, tmp_path / "a.csv")
    make_record("slow_creep", 3, tmp_path / "b.csv")
    make_record("slow_creep", 4, tmp_path / "c.csv")
    text = (tmp_path / "a.csv").read_text(encoding="utf-8")
    assert text == (tmp_path / "b.csv").read_text(encoding="utf-8")
    assert text != (tmp_path / "c.csv").read_text(encoding="utf-8")
    assert text.startswith(HEADER + "\n")
    table = np.loadtxt(tmp_path / "a.csv", delimiter=",", skiprows=1)
    assert np.allclose(table[:, 0], truth.times, atol=1e-9)
    assert np.array_equal(table[:, 1], truth.voltage)
    noise = table[:, 2] * 1e-6 - truth.displacement
    assert np.std(noise) == pytest.approx(np.hypot(truth.sigma, truth.quantum / 12**0.5), rel=0.05)
    assert RATIO[0] * 0.99 <= truth.visible <= RATIO[1] * 1.01
    assert not truth.gain_limited


def test_unknown_effect_is_named() -> None:
    with pytest.raises(KeyError, match="gremlin"):
        make_record("gremlin", 1, Path("unused.csv"))


def test_demo_fits_its_size(tmp_path: Path) -> None:
    truth = make_demo(tmp_path / "demo.csv")
    assert truth.effect == "slow_creep"
    assert (tmp_path / "demo.csv").stat().st_size < 300_000
    assert f"{100 * truth.gain:.1f} % of the elongation for each decade" in HIDDEN
    assert f"from {truth.parameters['t_0']:.2f} s on" in HIDDEN


def test_creep_is_straight_in_log_time() -> None:
    times: FloatArray = np.linspace(0.0, 5.999, 6000)
    step: FloatArray = np.full(times.size, 1e-5)
    step[0] = 0.0
    grown = creep(times, step, t_0=0.05)
    decades = np.log10(1.0 + (times - 0.0005) / 0.05)
    slope, intercept = np.polyfit(decades[10:], grown[10:], 1)
    assert slope == pytest.approx(1e-5, rel=1e-3)
    assert np.abs(grown[10:] - slope * decades[10:] - intercept).max() < 1e-3 * grown.max()


def test_delay_shifts() -> None:
    base = _part(_base_run(6), 1200)
    step = float(base.times[1] - base.times[0])
    moved = base.displacement + sensor_delay.contribution(base, {}, 3.0 * step)
    assert np.allclose(moved[3:], base.displacement[:-3], atol=1e-9 * np.ptp(moved))


def test_current_limit_caps_the_rate(run: Run) -> None:
    part = _part(run, 1500)
    slew = 0.3 * np.abs(np.diff(part.command)).max() / float(part.times[1] - part.times[0])
    rate = np.diff(limited_drive(part, slew).voltage) / part.fine_step
    assert np.abs(rate).max() == pytest.approx(slew, rel=1e-6)
    free = limited_drive(part, 1e12)
    assert np.allclose(free.voltage, part.path.voltage, atol=1e-9)
    force = hysteresis_force(run.stack, part.path)
    assert np.allclose(hysteresis_force(run.stack, free), force, atol=1e-6 * np.ptp(force))


def test_play_wipes_out_smaller_loops() -> None:
    def ramps(*corners: float) -> FloatArray:
        return np.concatenate([np.linspace(a, b, 50) for a, b in pairwise(corners)])

    plain = play(ramps(0.0, 60.0, 10.0), 8.0)
    detour = play(ramps(0.0, 40.0, 20.0, 35.0, 60.0, 10.0), 8.0)
    assert plain[-1] == detour[-1] == 18.0
    assert play(ramps(0.0, 40.0), 8.0)[-1] == 32.0
    dwell = play(ramps(0.0, 40.0, 26.0), 8.0)
    assert np.all(dwell[50:] == 32.0)


def test_play_equals_its_sample_by_sample_recursion(run: Run) -> None:
    voltage = run.path.path_voltage[:20000]
    state, expected = 0.0, []
    for value in voltage.tolist():
        state = max(value - 5.0, min(value + 5.0, state))
        expected.append(state)
    assert np.array_equal(play(voltage, 5.0), np.asarray(expected))


def test_drift_ignores_the_voltage(run: Run) -> None:
    quiet = simulate_base(run.stack, run.times, np.zeros_like(run.command), 1)
    for seed in range(4):
        parameters = offset_drift.draw(np.random.default_rng(seed), run)
        drift = offset_drift.contribution(run, parameters, 1e-7)
        assert np.array_equal(drift, offset_drift.contribution(quiet, parameters, 1e-7))
        line = np.polyval(np.polyfit(run.times, drift, 1), run.times)
        assert np.ptp(drift - line) > 1e-3 * np.ptp(drift)


def test_mode_rings_at_its_frequency(run: Run) -> None:
    times: FloatArray = np.linspace(0.0, 3.999, 4000)
    command: FloatArray = np.full(times.size, 40.0)
    command[:51] = 0.0
    base = simulate_base(run.stack, times, command, 8)
    mode = structural_mode.contribution(base, {"frequency": 60.0, "zeta": 0.01}, 0.01)
    tail = mode[100:1124] - mode[-1]
    spectrum = np.abs(np.fft.rfft(tail * np.hanning(tail.size), 16384))
    assert np.argmax(spectrum) / (16384 * 1e-3) == pytest.approx(60.0, abs=0.3)
    assert mode[-1] == pytest.approx(0.01 * base.force[-1] * run.stack.compliance, rel=1e-3)


def test_friction_sticks_then_slips() -> None:
    up, down = np.linspace(0.0, 10.0, 1001), np.linspace(10.0, 0.0, 1001)
    lost = friction(np.concatenate((up, down)), stiction=1.0, coulomb=0.5, kappa=4.0)
    assert lost.max() <= 1.0
    assert lost[1000] == 0.5
    assert lost[-1] == -0.5
    assert lost[: 1 + int(np.argmax(np.diff(lost) < 0.0))].max() == pytest.approx(1.0, abs=0.01)
    band = np.flatnonzero(np.abs(lost[1001:]) != 0.5) * 0.01
    assert band.max() == pytest.approx(1.5 * 5.0 / 4.0, abs=0.03)
