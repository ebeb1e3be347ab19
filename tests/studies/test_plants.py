"""The independent plants: their numerics and their physics are what they claim."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from psa_casadi.report.words.catalogue import say
from tests.studies.plants.base import (
    SUB_INTERVALS,
    Run,
    first_order,
    follow,
    simulate_base,
)
from tests.studies.plants.effect import HiddenEffect
from tests.studies.plants.excitations import EXCITATIONS, ExcitationKind, draw_voltage
from tests.studies.plants.hide import (
    RATIO,
    Effect,
    added_by,
    base_directions,
    effect_called,
    refitted_ratio,
    visible_ratio,
)
from tests.studies.plants.make import HEADER, make_demo, make_record
from tests.studies.plants.stack import FloatArray, Stack, draw_stack
from tests.studies.plants.table import HIDDEN_EFFECTS
from tests.tiers import slow, slow_but

CONVERGENCE = 2e-5
"""Largest change of the displacement over its range when the grid is refined by 4."""
EFFECTS = list(HIDDEN_EFFECTS.values())
KEPT = Path(__file__).parent / "plants" / "added.tsv"
_ROWS = [line.split("\t") for line in KEPT.read_text("utf-8").splitlines()[1:]]
ADDED = {name: [float(x) for x in figures] for name, *figures in _ROWS}


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
        result = solve_ivp(rate, (start, end), state, method="LSODA", rtol=1e-9, atol=scale)
        state = result.y[:, -1]
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
def test_effect_vanishes_at_gain_zero_and_adds_what_it_did(effect: HiddenEffect, run: Run) -> None:
    """Rms, extremes and end of its contribution [nm] are those kept: a seed fixes the truth."""
    part = _part(run, 800)
    parameters = effect.draw(np.random.default_rng(1), part)
    assert np.all(effect.contribution(part, parameters, 0.0) == 0.0)
    added = 1e9 * effect.contribution(part, parameters, effect.plausible[1])
    assert np.ptp(added) > 1e6 * np.ptp(part.displacement)
    figures = [np.sqrt(np.mean(added**2)), added.min(), added.max(), added[-1]]
    line = "\t".join([effect.name, *(f"{x:.7g}" for x in figures)])
    text = f"Add this line to {KEPT.name}, or its present line is of another plant: {line}"
    assert effect.name in ADDED, text
    np.testing.assert_allclose(figures, ADDED[effect.name], rtol=1e-5, atol=1e-6, err_msg=text)


@pytest.mark.parametrize(
    "effect",
    slow_but([EFFECTS[0]], [EFFECTS[0], *(e for e in EFFECTS if e.room is not None), None]),
    ids=lambda e: e.name if e else "none",
)
def test_a_gain_of_zero_is_the_clean_record(
    effect: HiddenEffect | None, clean_lines: list[str], tmp_path: Path
) -> None:
    """One effect, those that need a thermometer, and none; the test above has all of them."""
    name = None if effect is None else effect.name
    truth = make_record(name, 11, tmp_path / "effect.csv", gain=0.0)
    assert np.array_equal(truth.displacement, truth.base_displacement)
    lines = (tmp_path / "effect.csv").read_text(encoding="utf-8").splitlines()
    if truth.temperature is not None:
        lines = [line.rpartition(",")[0] for line in lines]
    assert lines == clean_lines


def test_record_matches_its_truth(tmp_path: Path) -> None:
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


def test_demo_fits_its_size(tmp_path: Path) -> None:
    truth = make_demo(tmp_path / "demo.csv")
    assert truth.effect == "slow_creep"
    assert (tmp_path / "demo.csv").stat().st_size < 300_000
    assert f"{100 * truth.gain:.1f} % of the elongation for each decade" in say("demo.hidden")
    assert f"from {truth.parameters['t_0']:.2f} s on" in say("demo.hidden")


@pytest.mark.parametrize("kind", slow_but(["rich", "bipolar", "small"], EXCITATIONS))
def test_every_voltage_starts_at_rest_and_stays_in_its_span(
    kind: ExcitationKind, tmp_path: Path
) -> None:
    truth = make_record(None, 2, tmp_path / "a.csv", excitation=kind)
    rich = make_record(None, 2, tmp_path / "b.csv")
    assert truth.stack == rich.stack
    assert truth.voltage[0] == truth.voltage[1] == 0.0
    span, top = truth.stack.u_rated, truth.voltage.max()
    assert -span <= truth.voltage.min() <= (-0.1 * span if kind == "bipolar" else 0.0)
    least, most = (0.03, 0.4) if kind == "small" else (0.55, 1.0)
    assert least * span < top <= most * span
    assert np.all(np.isfinite(truth.displacement))
    assert (truth.times[-1] > 240.0) == (kind == "slow")
    assert (np.array_equal(truth.voltage, rich.voltage)) == (kind == "rich")


@pytest.mark.parametrize("effect", slow_but(["slow_creep"], ["slow_creep", "backlash"]))
def test_visible_ratio_is_what_was_requested(effect: str, tmp_path: Path) -> None:
    truth = make_record(effect, 4, tmp_path / "a.csv", visible=0.4)
    assert truth.visible == pytest.approx(0.4, rel=0.05)
    assert not truth.gain_limited
    drawn = make_record(effect, 4, tmp_path / "a.csv", visible=(0.8, 1.2))
    assert 0.75 <= drawn.visible <= 1.25
    huge = make_record(effect, 4, tmp_path / "a.csv", visible=1e4)
    assert huge.gain_limited
    assert huge.visible < 1e4


@slow
def test_a_pole_before_the_drive_vanishes_in_a_fit(tmp_path: Path) -> None:
    """Why a lag is scaled by a base that is fitted again: its linearisation cannot see this."""
    truth = make_record(None, 1, tmp_path / "a.csv")
    run = simulate_base(truth.stack, truth.times[:2000], truth.voltage[:2000], 12)
    late = first_order(-1.0 / 2e-3 + 0j, run.fine_command, run.fine_step).real / 2e-3
    added = follow(run, late).displacement - run.displacement
    assert visible_ratio(base_directions(run), added, truth.sigma) > 1.0
    assert refitted_ratio(run, added, truth.sigma) < 0.5


_RATE, _FREQUENCY = 1000.0, 20.0
_LAG, _DELAY, _DRIVE, _ZETA = 4e-3, 2.5e-3, 3e-3, 0.8


@pytest.fixture(scope="module")
def linear() -> Run:
    """A stack without hysteresis, driven by a sine of 20 Hz for half a second."""
    stack = replace(draw_stack(np.random.default_rng(3)), a=0.0, beta=0.0, gamma=0.0, delta=0.0)
    times = np.arange(501) / _RATE
    return simulate_base(stack, times, 20.0 * np.sin(2.0 * np.pi * _FREQUENCY * times), 24)


def _amplitude(run: Run, signal: FloatArray) -> complex:
    """Complex amplitude of the last five periods at the drive's frequency [m]."""
    last = slice(-250, None)
    turn = np.exp(-2j * np.pi * _FREQUENCY * run.times[last])
    return complex(2.0 * np.mean(signal[last] * turn))


def _effect(name: str, gain: float, **parameters: float) -> Effect:
    return effect_called(name), parameters, gain


def test_lags_of_a_linear_stack_multiply(linear: Run) -> None:
    """Reference: the product of the transfer functions, by hand."""
    chain = [
        _effect("sensor_delay", _DELAY),
        _effect("sensor_lag", _LAG),
        _effect("drive_lag", _DRIVE, zeta=_ZETA),
    ]
    s = 2j * np.pi * _FREQUENCY
    expected = np.exp(-s * _DELAY) / (1.0 + s * _LAG)
    expected /= 1.0 + 2.0 * _ZETA * s * _DRIVE + (s * _DRIVE) ** 2
    moved = linear.displacement + added_by(linear, chain)
    result = _amplitude(linear, moved) / _amplitude(linear, linear.displacement)
    assert result == pytest.approx(expected, abs=2e-3)
    summed = linear.displacement + sum(e.contribution(linear, p, g) for e, p, g in chain)
    apart = _amplitude(linear, summed) / _amplitude(linear, linear.displacement)
    assert abs(apart - expected) > 0.2


def test_a_sensor_reads_what_the_stack_adds(linear: Run) -> None:
    """A converter's step occurs where the whole displacement passes its position."""
    place = 0.5 * float(linear.displacement.max())
    heights = {"mid": place, "quarter": 1.0, "next": 0.0}
    contact = _effect("preload_loss", 0.5, x_0=0.0, side=1.0)
    total = added_by(linear, [_effect("converter_step", 1e-7, **heights), contact])
    moved = linear.displacement + added_by(linear, [contact])
    assert np.allclose(total - added_by(linear, [contact]), 1e-7 * (moved > place), atol=1e-18)


def test_one_effect_and_none_are_as_without_others(linear: Run) -> None:
    effect, parameters, gain = _effect("charge_leakage", 0.1, t=0.2)
    alone = effect.contribution(linear, parameters, gain)
    assert np.array_equal(added_by(linear, [(effect, parameters, gain)]), alone)
    none = [_effect("drive_lag", 0.0, zeta=_ZETA), _effect("sensor_lag", 0.0)]
    assert not np.any(added_by(linear, none))
    assert not np.any(added_by(linear, []))


def test_two_drives_are_one_after_the_other(linear: Run) -> None:
    """A stack limited to a rate by its amplifier, with a slower command: the limit does nothing."""
    limit = _effect("current_limit", 1.0 / 2000.0)
    assert np.any(np.abs(added_by(linear, [limit])) > 1e-8)
    slow = _effect("drive_lag", 15e-3, zeta=_ZETA)
    both, only = added_by(linear, [slow, limit]), added_by(linear, [slow])
    assert np.allclose(both[100:], only[100:], atol=1e-11)
