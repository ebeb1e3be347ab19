"""Several modes at once: read off a residual, fitted with the base, exported like any effect."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter, lsim

import psa_casadi as psa
from psa_casadi import reference
from psa_casadi.common.units import FloatArray
from psa_casadi.identification.search import fit_base
from psa_casadi.identification.start.linear_response import Response, modes_of
from psa_casadi.identification.start.ordinary import capacitance_of, starting_model
from psa_casadi.model.effects.mechanics import MODAL_SERIES
from psa_casadi.records import multisine
from psa_casadi.records.split import whole
from psa_casadi.report.words.tables import parameter_table
from tests.studies.exam.hysteresis import relay_means
from tests.studies.plants.base import simulate_base
from tests.studies.plants.mechanics import structural_mode
from tests.studies.plants.stack import draw_stack
from tests.tiers import slow

#: Frequency [Hz], damping ratio and static share of the modes that are hidden.
HIDDEN = ((212.0, 0.012, 0.06), (487.0, 0.02, 0.11), (905.0, 0.015, 0.05), (1330.0, 0.01, 0.09))
RATE, COUNT = 5000.0, 4000


def response(frequency: float, damping: float, drive: FloatArray, time: FloatArray) -> FloatArray:
    """Displacement q of a mode, q'' + 2 zeta w q' + w^2 q = w^2 drive, by SciPy."""
    omega = 2.0 * np.pi * frequency
    system = ([omega**2], [1.0, 2.0 * damping * omega, omega**2])
    return np.asarray(lsim(system, drive, time)[1])


def noise(count: int, seed: int) -> FloatArray:
    return np.random.default_rng(seed).standard_normal(count)


def drive_and_time(seed: int = 1) -> tuple[FloatArray, FloatArray]:
    time = np.arange(COUNT) / RATE
    drive = np.cumsum(noise(COUNT, seed)) * 1e-8
    return drive - drive[0], time


def test_modes_are_read_off_a_residual() -> None:
    drive, time = drive_and_time()
    left = sum(share * response(f, z, drive, time) for f, z, share in HIDDEN)
    left = left + 1e-3 * np.std(left) * noise(COUNT, 2)
    shaken = Response(1.0 / RATE, drive, left, np.ones(COUNT, bool))
    items = sorted(
        modes_of([shaken], np.ones((COUNT, 1)), most=9, better=0.95), key=lambda m: m.frequency
    )
    assert len(items) == len(HIDDEN)
    for mode, (frequency, damping, share) in zip(items, HIDDEN, strict=True):
        assert mode.frequency == pytest.approx(frequency, rel=1e-3)
        assert mode.damping == pytest.approx(damping, rel=0.03)
        assert mode.share == pytest.approx(share, rel=0.03)
        assert abs(mode.ahead) < 0.03 * share


def test_noise_has_no_modes() -> None:
    drive, _ = drive_and_time()
    shaken = Response(1.0 / RATE, drive, noise(COUNT, 3), np.ones(COUNT, bool))
    assert modes_of([shaken], np.ones((COUNT, 1)), most=9, better=0.95) == []


def with_two_modes() -> psa.Model:
    values = {"series_gain": 1.0}
    for k, (frequency, damping, share) in enumerate(HIDDEN[:2], 1):
        values |= {
            f"series_frequency_{k}": frequency,
            f"series_damping_{k}": damping,
            f"series_share_{k}": share,
        }
    return psa.stack_model("P-885.51").with_effect(MODAL_SERIES[2], values)


def test_its_equations_are_those_of_modal_superposition() -> None:
    model, time = with_two_modes(), np.arange(4000) / 20_000.0
    voltage = multisine(time, 0.0, 80.0, (20.0, 1500.0), seed=3)
    voltage *= np.clip((time - 0.002) / 0.01, 0.0, 1.0)  # it starts at rest
    base = psa.simulate(psa.stack_model("P-885.51"), time, voltage, rtol=1e-6)
    extended = psa.simulate(model, time, voltage, rtol=1e-6)
    k = model.values
    rest = base.states["f_out"] * (1.0 / k["k_P"] + 1.0 / k["k_B"])
    added = sum(share * response(f, z, rest, time) for f, z, share in HIDDEN[:2])
    size = np.ptp(added)
    np.testing.assert_allclose(extended.displacement - base.displacement, added, atol=2e-3 * size)


def shaken_stack(seed: int, modes: Sequence[tuple[float, float, float]] = HIDDEN) -> psa.Record:
    """Return a record of a stack in a structure with modes, plain NumPy and SciPy."""
    rng = np.random.default_rng(seed)
    stack, time = draw_stack(rng), np.arange(COUNT) / RATE
    wave = multisine(time, 0.0, 1.0, (5.0, 1800.0), seed=seed)
    command = stack.u_rated * wave * np.clip((time - 0.01) / 0.05, 0.0, 1.0)
    run = simulate_base(stack, time, command)
    x = run.displacement + sum(
        structural_mode.contribution(run, {"frequency": f, "zeta": z}, share)
        for f, z, share in modes
    )
    x = x + 1e-3 * np.ptp(x) * rng.standard_normal(COUNT)
    return psa.Record(name="shaken", time=time, voltage=command, displacement=x)


@slow
def test_several_modes_are_identified_together_and_again_from_the_result() -> None:
    like = [psa.EFFECTS[n] for n in ("structural_mode", "drive_lag", "sensor_delay")]
    more = [psa.EFFECTS[n] for n in ("hysteresis_memory", "slow_creep", "load_stiffness")]
    result = psa.diagnose([shaken_stack(11)], effects=[*like, *more])
    (cause,) = result.causes
    assert cause.effect.startswith("modal_series")
    assert result.base_errors.holdout_nrmse_percent > 1.0
    assert result.extended_errors.holdout_nrmse_percent < 0.12  # the noise is 0.1
    values = result.extended_fit.model.values
    tones = np.array([v for n, v in values.items() if n.startswith("series_frequency")])
    for frequency, _, _ in HIDDEN:
        assert np.min(np.abs(tones / frequency - 1.0)) < 2e-3
    again = psa.diagnose([shaken_stack(11)], model=result.model, effects=like)
    assert again.base_errors.holdout_nrmse_percent > 1.0
    assert [c.effect.startswith("modal_series") for c in again.causes] == [True]


@slow
def test_a_fast_record_without_modes_has_none() -> None:
    effects = [psa.EFFECTS[n] for n in ("structural_mode", "drive_lag", "sensor_delay", "backlash")]
    assert psa.diagnose([shaken_stack(14, ())], effects=effects).verdict == "adequate"


@slow
@pytest.mark.usefixtures("code_runs_here")
def test_a_model_with_modes_becomes_an_fmu(tmp_path: Path) -> None:
    path = tmp_path / "modes.fmu"
    psa.export_fmu(with_two_modes(), path)
    assert psa.check_fmu(path, with_two_modes()).passed


STACK = psa.stack_model("P-885.51")
C_P = STACK.values["C_p"]


def _recorded(step: float, tones: tuple[float, ...], *, noise: float = 0.01) -> psa.Record:
    """A record of the independent reference, whose current has a separate noise and zero."""
    rng = np.random.default_rng(3)
    t = step * np.arange(1500.0)
    phases = rng.uniform(0.0, 6.28, len(tones))
    waves = [np.sin(2 * np.pi * f * t + p) for f, p in zip(tones, phases, strict=True)]
    voltage: FloatArray = 60.0 + 50.0 * np.sum(waves, axis=0) / len(tones)
    result = reference.simulate(
        STACK.values,
        lambda time: float(np.interp(time, t, voltage)),
        t,
        breakpoints=list(t),
        initial={"u": voltage[0]},
        rtol=1e-7,
    )
    current = result.current + noise * np.std(result.current) * rng.standard_normal(t.size)
    displayed = result.displacement + 2e-9 * rng.standard_normal(t.size)
    return psa.Record(
        name="r", time=t, voltage=voltage, displacement=displayed, current=current + 0.003
    )


@pytest.fixture(scope="module")
def fast() -> psa.Record:
    return _recorded(5e-6, (300.0, 1100.0, 2900.0, 7000.0))


def test_a_current_determines_the_capacitance(fast: psa.Record) -> None:
    capacitance = capacitance_of([fast])
    assert capacitance is not None
    assert capacitance.value == pytest.approx(C_P, abs=4.0 * capacitance.error)
    assert capacitance.error < 0.005 * C_P
    assert capacitance.interval.low < capacitance.value < capacitance.interval.high
    assert "C_p =" in capacitance.sentence(capacitance.value)
    assert "keeps the 3 uF given" in capacitance.sentence(3e-6)


@pytest.mark.parametrize("capacitance", [1e-8, 1.6e-6, 5e-5])
def test_a_slow_current_of_any_size_and_a_lossy_ceramic(capacitance: float) -> None:
    """A loss tangent of 3 % turns the current's phase; it makes no other capacitance of it."""
    t = np.linspace(0.0, 3.0, 3001)
    voltage = 50.0 - 40.0 * np.cos(2 * np.pi * t)
    omega, loss = 2 * np.pi, 0.03
    clean = capacitance * omega * 40.0 * (np.sin(omega * t) - loss * np.cos(omega * t))
    noise = 0.01 * np.std(clean) * np.random.default_rng(2).standard_normal(t.size)
    result = capacitance_of(
        [psa.Record(name="r", time=t, voltage=voltage, displacement=None, current=clean + noise)]
    )
    assert result is not None
    assert result.value == pytest.approx(capacitance, rel=0.01)
    assert result.error < 0.01 * capacitance


@slow
def test_a_current_that_is_not_the_stack_s_determines_nothing(fast: psa.Record) -> None:
    noise = np.random.default_rng(1).standard_normal(fast.n)
    assert fast.current is not None
    for current in (noise, np.zeros(fast.n), None, 1e6 * fast.current, -fast.current):
        assert capacitance_of([replace(fast, current=current)]) is None
    uneven = np.cumsum(np.where(np.arange(fast.n) % 2, 1.0, 3.0))
    assert capacitance_of([replace(fast, time=5e-6 * uneven)]) is None


@slow
def test_an_identified_model_has_the_measured_capacitance(fast: psa.Record) -> None:
    """Without the current the capacitance is assumed, and the simulated current as wrong."""
    result = psa.identify([fast.slice(0, 700)])
    assert result.model.values["C_p"] == pytest.approx(C_P, rel=0.01)
    interval = result.model.provenance.intervals["C_p"]
    assert interval.low < result.model.values["C_p"] < interval.high
    assert any("measured current" in n for n in result.model.provenance.notes)
    rows = {row[0]: row for row in parameter_table(result.model, result).rows}
    assert [rows[n][4] for n in ("C_p", "k_L")] == ["current", "fit"]
    inputs = replace(result.model, values={**result.model.values, "C_p": 3e-6})
    noted = psa.identify([fast.slice(0, 200)], model=inputs).model.provenance.notes
    assert any("keeps the 3 uF given" in n for n in noted)


FINER, LEAK_TIME = 20, 2.5


def _leaking(name: str, frequency: float, duration: float, rate: float, seed: int) -> psa.Record:
    """A sine of 0 to 100 V behind a high-pass of 2.5 s, on a Bouc-Wen loop; 5 nm of noise."""
    step = 1.0 / (rate * FINER)
    time = np.linspace(0.0, duration, round(duration * rate) * FINER, endpoint=False)
    u = 50.0 * (1.0 - np.cos(2.0 * np.pi * frequency * time))
    # (T/h)(q - q_1) + (q + q_1)/2 = (T/h)(u - u_1), exact to h^2
    one, half = LEAK_TIME / step, 0.5
    q = lfilter([one / (one + half), -one / (one + half)], [1.0, (half - one) / (one + half)], u)
    h = np.zeros_like(q)
    for k, dq in enumerate(np.diff(q)):
        middle = h[k] + 0.5 * _rate(h[k], dq)
        h[k + 1] = h[k] + _rate(middle, dq)
    x = 1e-7 * (q + h)[::FINER]
    noise = 5e-9 * np.random.default_rng(seed).standard_normal(x.size)
    return psa.Record(name=name, time=time[::FINER], voltage=u[::FINER], displacement=x + noise)


def _rate(h: float, dq: float) -> float:
    return -0.2 * dq - 0.025 * abs(dq) * h - 0.006 * dq * abs(h)


@pytest.mark.slow
def test_it_is_named_alone_and_predicts_a_record_that_no_fit_has_used() -> None:
    fitted = [_leaking("slow", 0.05, 60.0, 50.0, 1), _leaking("fast", 1.0, 10.0, 500.0, 2)]
    slow = ("charge_leakage", "slow_creep", "ageing", "self_heating", "offset_drift", "drive_lag")
    like = [psa.EFFECTS[n] for n in (*slow, "sensor_lag", "hysteresis_memory")]
    d = psa.diagnose(fitted, holdout=[_leaking("judged", 20.0, 0.5, 5000.0, 3)], effects=like)
    assert [c.effect for c in d.causes] == ["charge_leakage"], d
    values = d.causes[0].parameters
    assert values["leak_gain"].value == pytest.approx(1.0, abs=2e-3)
    assert values["leak_time"].value == pytest.approx(LEAK_TIME, rel=5e-3)
    assert d.extended_errors.train_rms_m < 5.5e-9
    # base: 29 to 31 %
    assert d.extended_errors.holdout_nrmse_percent < 0.2


_MEMORY = psa.EFFECTS["hysteresis_memory"]
_STROKE, _RATED, _NOISE = 20e-6, 100.0, 20e-9


def _relays() -> psa.Record:
    """Loops of rising and falling amplitude of relays, whose density has a bell in its middle.

    4000 relays switch up at m + w/2 and down at m - w/2; w exponential, m as 1 + 0.8 exp(-(...)^2)
    (Mayergoyz, Mathematical Models of Hysteresis, ch. 1). None of the effects has relays.
    """
    rng = np.random.default_rng(11)
    t = np.arange(3000) * 2e-3
    swing = 0.5 * _RATED * np.interp(t, [0.0, 3.0, 6.0], [0.1, 1.0, 0.3])
    v = swing * (1.0 - np.cos(2.0 * np.pi * 1.5 * t))
    width = rng.exponential(0.12, 4000).clip(0.0, 0.9) * _RATED
    drawn = rng.uniform(-0.1, 1.1, 40_000)
    likely = 1.0 + 0.8 * np.exp(-(((drawn - 0.5) / 0.3) ** 2))
    middle = _RATED * drawn[rng.uniform(0.0, 1.8, drawn.size) < likely][:4000]
    up, down = middle + width / 2.0, middle - width / 2.0
    means = relay_means(v, up, down, np.full(4000, -1.0))
    x = 0.7 * v / _RATED + 0.15 * (means + 1.0)
    noise = rng.normal(0.0, _NOISE, t.size)
    return psa.record_from(
        {"time [s]": t, "voltage [V]": v, "displacement [m]": _STROKE * x / x.max() + noise}
    )


def test_a_gain_is_a_factor_of_the_linear_parameters() -> None:
    at = _MEMORY.at_gain(-3.0, {"memory_threshold": 0.1, "memory_square_0": 0.5})
    assert at["memory_gain"] == 1.0
    assert at["memory_threshold"] == 0.1
    assert at["memory_square_0"] == pytest.approx(-1.5)
    declared = next(p.value for p in _MEMORY.parameters if p.name == "memory_play_0")
    assert at["memory_play_0"] == pytest.approx(-3.0 * declared)
    assert psa.EFFECTS["slow_creep"].at_gain(0.2, {}) == {psa.EFFECTS["slow_creep"].gain: 0.2}


@slow
def test_a_fit_switches_an_effect_on_that_the_model_has_off() -> None:
    record = _relays()
    base = starting_model([record])
    model = psa.compose([*psa.BASE, _MEMORY], dict(base.values))
    assert model.values["memory_gain"] == 0.0
    fit = fit_base(model, [whole(record)])
    assert fit.model.values["memory_gain"] == 1.0
    assert fit.rms < 0.5 * fit_base(base, [whole(record)]).rms
