"""Effects of drive, sensor and environment: each one's signature against a closed form."""

from collections.abc import Mapping

import numpy as np
import pytest
from numpy.polynomial import Legendre
from numpy.typing import NDArray

import psa_casadi as psa
from psa_casadi.effects.drive import CHARGE_LEAKAGE, DRIVE_LAG, VOLTAGE_SATURATION
from psa_casadi.effects.environment import MAINS_HUM, TEMPERATURE
from psa_casadi.effects.sensor import SENSOR_JUMP, SENSOR_NONLINEARITY, SENSOR_RIPPLE
from psa_casadi.identification.fitting.unknowns import static_compliance
from psa_casadi.scales import stroke_scale
from psa_casadi.simulation.start import start_state
from tests.model.stack_models import LINEAR, stack

FloatArray = NDArray[np.float64]

STACK = "P-885.51"
ROOM = 293.15


def with_effect(effect: psa.Component, **values: float) -> psa.Model:
    return stack(STACK).with_effect(effect, values)


def simulated(
    model: psa.Model,
    t: FloatArray,
    voltage: FloatArray,
    *,
    temperature: FloatArray | None = None,
    memory: Mapping[str, float] | None = None,
    rtol: float = 1e-8,
) -> dict[str, FloatArray]:
    """Return states and outputs by name; the record starts at rest at its first voltage."""
    inputs = {"voltage": voltage, "load_force": np.zeros_like(t)}
    if temperature is not None:
        inputs["temperature"] = temperature
    u = np.column_stack([inputs[name] for name in model.input_names])
    x0 = start_state(model, list(u[0]), None, memory).x
    steps = psa.run(model, t, u, x0, rtol=rtol)
    states = dict(zip(model.state_names, steps.x.T, strict=True))
    return states | dict(zip(model.output_names, steps.y.T, strict=True))


def stroke(model: psa.Model) -> float:
    return model.values["k_L"] * model.values["u_rated"] * static_compliance(model.values)


def tone(t: FloatArray, signal: FloatArray, frequency: float) -> complex:
    """Return the complex amplitude of one frequency in a signal, beside its mean."""
    angle = 2 * np.pi * frequency * t
    columns = np.column_stack([np.cos(angle), np.sin(angle), np.ones_like(t)])
    a, b, _ = np.linalg.lstsq(columns, signal, rcond=None)[0]
    return complex(a, -b)


@pytest.mark.parametrize("level", [0.7, 0.85])
def test_a_clip_makes_flat_tops_at_its_level(level: float) -> None:
    """Behind a hard clip the stack does what it does at the clipped command: twice a flat top."""
    t = np.linspace(0.0, 1.0, 2001)
    voltage = 60.0 * (1.0 - np.cos(4 * np.pi * t))
    hard = simulated(with_effect(VOLTAGE_SATURATION, clip_gain=1.0, clip_level=level), t, voltage)
    clipped = simulated(stack(STACK), t, np.minimum(voltage, 120.0 * level))
    width, excess = 0.005 * 120.0, voltage - 120.0 * level
    rounding = width * np.log1p(np.exp(-np.abs(excess) / width))  # of the corner [V]
    assert rounding.max() > 0.3
    np.testing.assert_allclose(clipped["u"] - hard["u"], rounding, rtol=0, atol=0.02)
    for half in (t < 0.5, t > 0.5):
        top = half & (excess > 10 * width)
        assert np.count_nonzero(top) > 150
        assert np.ptp(voltage[top]) > 0.05 * 120.0
        assert np.abs(hard["u"][top] - 120.0 * level).max() < 1e-3 * 120.0 * level
        assert np.ptp(hard["measured_displacement"][top]) < 1e-4 * stroke(stack(STACK))


@pytest.mark.parametrize("frequency", [50.0, 300.0, 1500.0])
@pytest.mark.parametrize("amplitude", [1.0, 30.0])
@pytest.mark.parametrize("shape", [1e-4, 0.5])
def test_a_drive_lag_stands_beside_the_base_at_every_amplitude(
    frequency: float, amplitude: float, shape: float
) -> None:
    """Without hysteresis the response is the base's over 1 + i w T - shape (w T)^2."""
    lag = 2e-4
    t = np.linspace(0.0, 40.0 / frequency, 8001)
    voltage = amplitude * np.sin(2 * np.pi * frequency * t)
    late = t > 20.0 / frequency
    responses = []
    lagging = with_effect(DRIVE_LAG, drive_lag_time=lag, drive_lag_shape=shape)
    for model in (lagging, stack(STACK)):
        shown = simulated(model.with_values(LINEAR), t, voltage)["measured_displacement"]
        responses.append(tone(t[late], shown[late], frequency))
    ratio = responses[0] / responses[1]
    angle = 2 * np.pi * frequency * lag
    expected = 1.0 / (1.0 + 1j * angle - shape * angle**2)
    assert abs(ratio - expected) < 0.01


def test_a_leaking_charge_drive_droops_to_what_does_not_leak() -> None:
    """u = G v (1 - g (1 - exp(-t/T))) after a step from rest, and G v (1 - g) long after one."""
    gain, time = 0.3, 2.0
    model = with_effect(CHARGE_LEAKAGE, leak_gain=gain, leak_time=time).with_values(LINEAR)
    t = np.linspace(0.0, 20.0, 4001)
    voltage = np.where(t > 0.0, 100.0, 0.0)
    late = t > 0.02
    expected = 1 - gain * (1 - np.exp(-(t[late] - 0.0025) / time))  # the ramp's middle
    found = simulated(model, t, voltage)
    np.testing.assert_allclose(found["u"][late], 100.0 * expected, rtol=1e-4)
    shown = found["measured_displacement"][late] / (stroke(model) * 100.0 / 120.0)
    np.testing.assert_allclose(shown, expected, rtol=3e-4)
    settled = simulated(model, t, np.full_like(t, 100.0))["u"]
    np.testing.assert_allclose(settled, 70.0, rtol=1e-9)


@pytest.mark.parametrize(("angle", "wave"), [(0.0, 0.0), (np.pi / 2, 0.0), (-1.0, 0.3)])
def test_a_bent_sensor_reads_a_function_of_the_displacement_alone(
    angle: float, wave: float
) -> None:
    """The bend is a Legendre series on 0 to 1 without its constant and its slope."""
    model = with_effect(
        SENSOR_NONLINEARITY, nonlinearity_gain=0.01, nonlinearity_angle=angle,
        nonlinearity_wave=wave,
    )  # fmt: skip
    t = np.linspace(0.0, 2.0, 2001)
    voltage = 60.0 * (1.0 - np.cos(4 * np.pi * t)) * (0.5 + 0.25 * t)
    found = simulated(model, t, voltage)
    x, size = found["displacement"], stroke(model)
    residual = found["measured_displacement"] - x
    series = Legendre([0.0, 0.0, np.cos(angle), np.sin(angle), wave], domain=[0.0, 1.0])
    bent = series(x / size) - series(0.0) - series.deriv()(0.0) * x / size
    np.testing.assert_allclose(residual, 0.01 * bent * size, rtol=0, atol=1e-9 * size)
    assert 0.01 * size < np.abs(residual).max() < 0.2 * size
    # the branches lie apart against the voltage, and on each other against the displacement
    rising = np.gradient(x) > 0
    at = np.linspace(0.2, 0.6, 9)
    apart = [
        np.interp(at * top, np.sort(axis[branch]), residual[branch][np.argsort(axis[branch])])
        for axis, top in ((voltage, 120.0), (x, size))
        for branch in (rising & (t < 0.5), ~rising & (t < 0.5))
    ]
    assert np.abs(apart[0] - apart[1]).max() > 50 * np.abs(apart[2] - apart[3]).max()


def test_a_ripple_repeats_with_the_displacement_on_both_branches() -> None:
    """Its first harmonic has the gain as amplitude, the second what its two shares say."""
    period = 1.3e-6
    model = with_effect(
        SENSOR_RIPPLE, ripple_gain=2e-8, ripple_period=period, ripple_phase=0.7,
        ripple_second_cosine=0.3, ripple_second_sine=-0.4,
    )  # fmt: skip
    t = np.linspace(0.0, 2.0, 4001)
    found = simulated(model, t, 50.0 * (1.0 - np.cos(2 * np.pi * t)))
    x = found["displacement"]
    residual = found["measured_displacement"] - x
    assert residual[0] == 0.0
    for branch in (np.gradient(x) > 0, np.gradient(x) < 0):
        angle = 2 * np.pi * x[branch] / period
        columns = [np.ones_like(angle), *(f(k * angle) for k in (1, 2) for f in (np.sin, np.cos))]
        fitted, left, *_ = np.linalg.lstsq(np.column_stack(columns), residual[branch], rcond=None)
        _, sine, cosine, second_sine, second_cosine = fitted / 2e-8
        assert (sine, cosine) == pytest.approx((np.cos(0.7), np.sin(0.7)), rel=1e-6)
        assert (second_cosine, second_sine) == pytest.approx((0.3, -0.4), rel=1e-6)
        assert left[0] < 1e-12 * np.sum(residual**2)


def test_a_jump_is_a_step_of_the_reading_at_one_displacement_on_both_branches() -> None:
    place = 4e-6
    model = with_effect(SENSOR_JUMP, jump_gain=3e-8, jump_place=place, jump_width=0.003)
    width = 0.003 * stroke_scale(model.values)
    t = np.linspace(0.0, 2.0, 4001)
    found = simulated(model, t, 50.0 * (1.0 - np.cos(2 * np.pi * t)))
    x = found["displacement"]
    residual = found["measured_displacement"] - x
    assert residual[0] == 0.0
    far = np.abs(x - place) > 10 * width
    np.testing.assert_allclose(residual[far], 3e-8 * (x[far] > place), rtol=0, atol=1e-15)
    for branch in (np.gradient(x) > 0, np.gradient(x) < 0):
        near = branch & (np.abs(x - place) < width)
        assert near.sum() > 5
        slope = np.polyfit(x[near] - place, residual[near], 1)[0]
        assert slope == pytest.approx(0.5 * 3e-8 / width, rel=0.3)


def test_hum_is_a_sine_that_keeps_amplitude_and_phase_for_a_thousand_periods() -> None:
    """At the fit's tolerance and a sample rate below the line, moving voltage or not."""
    model = with_effect(MAINS_HUM, hum_gain=2e-8, hum_frequency=50.0)
    t: FloatArray = 0.3 + 0.011 * np.arange(
        2001.0
    )  # 90.9 samples per second: 50 Hz shows at its alias
    voltage = np.where(t < 10.0, 40.0, 40.0 * (1.0 + 0.5 * np.sin(t - 10.0)))
    found = simulated(model, t, voltage, memory={"hum_cosine": 0.6, "hum_sine": -0.8}, rtol=1e-6)
    hum = found["measured_displacement"] - found["displacement"]
    angle = 100 * np.pi * t
    expected = 2e-8 * (0.6 * np.cos(angle) - 0.8 * np.sin(angle))
    assert t[-1] - t[0] > 1000 / 50.0
    np.testing.assert_allclose(hum, expected, rtol=0, atol=1e-4 * 2e-8)


@pytest.mark.parametrize("single", [False, True], ids=["cascade", "single mass"])
def test_expansion_follows_the_temperature_with_its_lag(single: bool) -> None:
    base = stack(STACK)
    if single:
        kept = {n: v for n, v in base.values.items() if n in psa.compose(psa.SIMPLIFIED).values}
        base = psa.compose(psa.SIMPLIFIED, kept)
    lag = 20.0
    model = base.with_effect(TEMPERATURE, {"expansion_gain": 2e-3, "temperature_lag": lag})
    t = np.linspace(0.0, 1000.0, 1001)
    found = simulated(model, t, np.zeros_like(t), temperature=ROOM + 1.5 + 0.003 * t)
    shown = found["measured_displacement"]
    follows = 1.5 + 0.003 * (t - lag + lag * np.exp(-t / lag))
    np.testing.assert_allclose(shown, 2e-3 * follows * stroke(model), rtol=1e-5, atol=0)
    assert not np.any(found["displacement"])


def test_the_gain_grows_with_temperature() -> None:
    """Without hysteresis, a slow voltage gives stroke v/u_rated (1 + ratio g dT) + g dT stroke."""
    values = {"expansion_gain": 2e-3, "temperature_gain_ratio": 1.5}
    model = with_effect(TEMPERATURE, **values).with_values(LINEAR)
    t = np.linspace(0.0, 1000.0, 1001)
    rise, voltage = 0.01 * t, 60.0 * (1.0 - np.cos(0.1 * t))
    shown = simulated(model, t, voltage, temperature=ROOM + rise)["measured_displacement"]
    g = 2e-3 * rise
    expected = stroke(model) * (voltage / 120.0 * (1 + 1.5 * g) + g)
    np.testing.assert_allclose(shown, expected, rtol=0, atol=1e-4 * stroke(model))
