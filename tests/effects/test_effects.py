"""The signatures of the plant's effects: each shows the figures that its equation promises.

And what holds for all: finite slopes, ordinary costs, no run-away, rest at a hold.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from numpy.polynomial import Legendre

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.export.modelica.package import modelica_text
from psa_casadi.identification.fitting.unknowns import static_compliance
from psa_casadi.identification.start.ordinary import forms_of
from psa_casadi.model.component import Component
from psa_casadi.model.components import BASE, COMPONENTS, SIMPLIFIED
from psa_casadi.model.compose import Model, compose
from psa_casadi.model.effects import EFFECTS
from psa_casadi.model.effects.ageing import ageing, self_heating
from psa_casadi.model.effects.drive import charge_leakage, drive_lag, voltage_saturation
from psa_casadi.model.effects.environment import mains_hum, temperature
from psa_casadi.model.effects.mechanics import backlash, load_stiffness, preload_loss
from psa_casadi.model.effects.sensor import sensor_jump, sensor_nonlinearity, sensor_ripple
from psa_casadi.model.effects.strain import (
    field_dependent_gain,
    hysteresis_memory,
    rate_dependent_hysteresis,
    saturation_of_strain,
)
from psa_casadi.model.shapes import stiffness_scale, stroke_scale
from psa_casadi.model.stacks import STACKS
from psa_casadi.simulation.compiler import functions_of
from psa_casadi.simulation.simulate import simulate
from psa_casadi.simulation.start import start_state
from psa_casadi.simulation.stepper import Steps, run
from tests.export.modelica_runs import right_side_error
from tests.model.random_models import random_model, random_point
from tests.model.stack_models import LINEAR, stack
from tests.studies.plants.ceramic import play
from tests.studies.plants.make import make_record
from tests.tiers import slow

#: The stack without its lags, so that slow drives are quasi-static to 1e-3.
QUICK = {"tau": 1e-6, "R_s": 0.1, "delta": 0.0}


#: The hysteresis of the stack.
HYSTERESIS = {name: STACKS["P-885.51"].values[name].value for name in LINEAR}


def linear(
    effect: Component, gain: float, base: Sequence[Component] = BASE, **more: float
) -> Model:
    """Return the stack without hysteresis and with one effect."""
    model = stack("P-885.51", **LINEAR, **{k: v for k, v in QUICK.items() if k != "delta"})
    if base is SIMPLIFIED:
        model = model.with_components(SIMPLIFIED).with_values({"c": 2e3})
    return model.with_effect(effect, {str(effect.gain): gain, **more})


def driven(model: Model, t: FloatArray, voltage: FloatArray, force: float = 0.0) -> Steps:
    u = np.column_stack([voltage, np.full_like(t, force)])
    return run(model, t, u, np.zeros(len(model.state_names)))


def ordinary(effect: Component, **values: float) -> Model:
    """Return the whole stack with one effect at the ordinary size of its gain."""
    model = stack("P-885.51").with_effect(effect, values)
    gain = model.parameter(str(effect.gain))
    return model.with_values({gain.name: gain.typical({**model.values, gain.name: 0.0})})


def sine_and_steps() -> tuple[FloatArray, FloatArray]:
    """Two seconds at 1 kHz: six cycles of 60 V, a step to 90 V, a step to 30 V."""
    t = np.arange(2001) / 1000.0
    cycles = 30.0 * (1.0 - np.cos(2 * np.pi * 5.0 * t))
    return t, np.where(t < 1.2, cycles, np.where(t < 1.6, 90.0, 30.0))


def triangle(frequency: float, peak: float, cycles: int = 3) -> tuple[FloatArray, FloatArray]:
    n = 400
    t = np.arange(cycles * n + 1) / (n * frequency)
    return t, peak * (1.0 - np.abs(2.0 * ((t * frequency) % 1.0) - 1.0))


def third_harmonic(effect: Component, gain: float, peak: float) -> tuple[float, float]:
    """Return fundamental and third harmonic [m] of a slow sine drive of both signs."""
    n = 2000
    t = np.arange(2 * n + 1) / n
    model = linear(effect, gain)
    x = driven(model, t, peak * np.sin(2 * np.pi * t)).y[n:-1, -1]
    parts = np.fft.rfft(x) * 2.0 / n
    return float(-parts[1].imag), float(-parts[3].imag)


every_base = pytest.mark.parametrize("base", [BASE, SIMPLIFIED], ids=["cascade", "single mass"])


@pytest.mark.parametrize("peak", [120.0, 24.0])
def test_loop_width_follows_the_logarithm_of_rate(peak: float) -> None:
    """By rate_gain per decade to 10 %, at small and large loops; the stroke moves against it."""
    rates = np.array([0.05, 0.5, 5.0])

    def width_and_stroke(gain: float, frequency: float) -> tuple[float, float]:
        model = stack("P-885.51", **QUICK).with_effect(
            rate_dependent_hysteresis, {"rate_gain": gain, "rate_onset": 1e-3}
        )
        t, voltage = triangle(frequency, peak)
        result = driven(model, t, voltage)
        u, x = result.x[-401:, 0], result.y[-401:, -1]
        up = np.interp(peak / 2, u[:200], x[:200])
        down = np.interp(peak / 2, u[200:][::-1], x[200:][::-1])
        return float(down - up), float(np.ptp(x))

    table = {g: np.log([width_and_stroke(g, f) for f in rates]) for g in (0.0, 0.05, -0.05)}
    for gain in (0.05, -0.05):
        width, reach = np.polyfit(np.log10(rates), table[gain] - table[0.0], 1)[0]
        assert width == pytest.approx(gain, rel=0.1)
        assert -0.5 < reach / gain < -0.05


def test_rayleigh_gain_grows_with_amplitude() -> None:
    """Gain in proportion to the peak; third harmonic -8/(15 pi) of it, as its square."""
    peaks = np.array([30.0, 60.0, 120.0])
    gains = []
    for peak in peaks:
        t, voltage = triangle(1.0, peak, cycles=1)
        gains.append(np.ptp(driven(linear(field_dependent_gain, 0.1), t, voltage).y[:, -1]) / peak)
    slope, start = np.polyfit(peaks / 120.0, gains, 1)
    assert slope / start == pytest.approx(0.1, rel=0.01)
    small, large = (third_harmonic(field_dependent_gain, 0.1, peak) for peak in (50.0, 100.0))
    assert large[1] / small[1] == pytest.approx(4.0, rel=0.01)
    assert large[1] / large[0] == pytest.approx(
        -8 / (15 * np.pi) * 0.1 / (1.2 + 0.1 * 8 / (3 * np.pi)), rel=0.01
    )


def test_saturation_flattens_both_branches() -> None:
    """1/sqrt(1 + g) at rated voltage; third harmonic of the other sign than Rayleigh's, g a^2/8."""
    full = []
    for gain in (0.0, 0.2):
        t, voltage = triangle(1.0, 120.0, cycles=1)
        full.append(np.ptp(driven(linear(saturation_of_strain, gain), t, voltage).y[:, -1]))
    assert full[1] / full[0] == pytest.approx(1 / np.sqrt(1.2), rel=1e-4)
    first, third = third_harmonic(saturation_of_strain, 0.02, 60.0)
    assert third / first == pytest.approx(0.02 / 8 * 0.25, rel=0.01)


@every_base
@pytest.mark.parametrize(("volt", "force"), [(120.0, 0.0), (60.0, 0.0), (0.0, 900.0)])
def test_load_hardens_with_displacement(
    base: tuple[Component, ...], volt: float, force: float
) -> None:
    """k x + h k_s x^3 / x_s^2 = the force that holds the linear stack there, whoever exerts it."""
    t = np.linspace(0.0, 1.0, 201)
    angle, gain = np.arctan(0.2), 0.05  # a pure cubic
    model, plain = (linear(load_stiffness, g, base, load_angle=angle) for g in (gain, 0.0))
    x, free = (
        driven(m, t, volt * np.minimum(t / 0.5, 1.0), force).y[-1, -1] for m in (model, plain)
    )
    p = model.values
    k = p["k_B"] if "k_B" in p else p["k"]
    k_s, x_s = stiffness_scale(p), stroke_scale(p)
    h = 20.0 * gain * np.sin(angle)
    share = h * (x / x_s) ** 3
    load = k_s * x_s * share / np.sqrt(1.0 + (2.0 * share) ** 2)  # levels off at 0.5 k_s x_s
    assert k * x + load == pytest.approx(k * free, rel=1e-5)
    assert x < 0.97 * free


@every_base
def test_contact_kinks_the_curve_at_one_displacement(base: tuple[Component, ...]) -> None:
    """Slope 1 below, k / (k + g k_s) above, meeting at contact_position of the stroke."""
    t, voltage = triangle(0.5, 120.0, cycles=1)
    touched, free = (
        driven(linear(preload_loss, g, base, contact_position=0.45), t, voltage).y[:, -1]
        for g in (0.25, 0.0)
    )
    p = linear(preload_loss, 0.25, base).values
    k, k_s = p["k_B"] if "k_B" in p else p["k"], stiffness_scale(p)
    x_c = 0.45 * stroke_scale(p)
    for branch in (slice(2, 199), slice(202, 399)):
        below, above = free[branch] < 0.9 * x_c, free[branch] > 1.1 * x_c
        lines = [np.polyfit(free[branch][w], touched[branch][w], 1) for w in (below, above)]
        assert lines[0][0] == pytest.approx(1.0, abs=2e-3)
        assert lines[1][0] == pytest.approx(k / (k + 0.25 * k_s), abs=2e-3)
        meeting = (lines[1][1] - lines[0][1]) / (lines[0][0] - lines[1][0])
        assert meeting == pytest.approx(x_c, rel=0.01)


@pytest.mark.parametrize(
    "weights",
    [{"play": (0.05, 0.02, 0.0)}, {"square": (0.04, 0.0, -0.01)}, {"cube": (0.03, -0.02, 0.0)},
     {"play": (-0.02, 0.0, 0.01), "square": (0.08, 0.03, 0.0), "cube": (-0.05, 0.0, 0.0)}],
    ids=["plays", "squares", "cubes", "all"],
)  # fmt: skip
def test_memory_is_a_sum_of_plays_their_squares_and_cubes(
    weights: dict[str, tuple[float, float, float]],
) -> None:
    """Of ideal plays with the same weights and thresholds, to the roundness of its stops."""
    values = {f"memory_{name}_{k}": 0.0 for name in ("play", "square", "cube") for k in range(3)}
    values |= {f"memory_{name}_{k}": w for name, row in weights.items() for k, w in enumerate(row)}
    plain = linear(hysteresis_memory, 0.0)
    model = plain.with_values({"memory_gain": 1.0, "memory_threshold": 0.02, **values})
    t = np.linspace(0.0, 60.0, 6001)
    voltage = 60.0 * (1.0 - np.cos(2 * np.pi * t / 20.0)) * (1.0 - t / 90.0)
    displayed = driven(model, t, voltage).y[:, -1] - driven(plain, t, voltage).y[:, -1]
    rated, expected = model.values["u_rated"], np.zeros_like(t)
    for i, ratio in enumerate((1.0, 2.5, 6.0, 15.0)):
        p = play(voltage, 0.02 * ratio * rated)
        for power, name in enumerate(("play", "square", "cube"), 1):
            terms = np.cos(np.pi * np.arange(3) * (i + 0.5) / 4) * weights.get(name, (0.0,) * 3)
            expected += np.sum(terms) * (voltage**power - p**power) / rated ** (power - 1)
    expected *= model.values["k_L"] * static_compliance(model.values)
    assert np.sqrt(np.mean((displayed - expected) ** 2)) < 0.05 * np.ptp(expected)


@pytest.mark.parametrize("peak", [30.0, 120.0])
def test_backlash_dwells_over_the_gap(peak: float) -> None:
    """Whatever the amplitude: none of the first w of motion, 4 w of the first 6 w get through."""
    model = linear(backlash, 1.0, backlash_width=0.01)
    w = 0.01 * stroke_scale(model.values)
    t, voltage = triangle(1.0, peak)
    result = driven(model, t, voltage)
    tip, displayed = result.x[:, model.state_names.index("x")], result.y[:, -1]
    for first, sign in ((600, -1.0), (800, 1.0)):  # the last downward and the last upward branch
        moved = sign * (tip[first : first + 200] - tip[first])
        through = sign * (displayed[first : first + 200] - displayed[first])
        crossed = [float(np.interp(d * w, moved, through)) / w for d in (0.9, 2.0, 6.0)]
        assert crossed[0] < 0.01
        assert crossed[1] < 0.2
        assert crossed[2] == pytest.approx(4.0, abs=0.02)


def test_self_heating_climbs_and_recovers() -> None:
    """By the area of the loop while it is driven; back with heating_time at a hold.

    What is lost is the loop's work less what the hysteresis stores, A f_H u' - (f_H^2/2)'.
    """
    cooling = 0.8
    t = np.arange(6001) / 1000.0
    voltage = np.where(t < 3.0, 60.0 * (1.0 - np.cos(2 * np.pi * 20.0 * t)), 60.0)
    model = stack("P-885.51", **{**QUICK, "delta": 0.0, "gamma": 0.0}).with_effect(
        self_heating, {"heating_gain": 0.02, "heating_time": cooling}
    )
    result = driven(model, t, voltage)
    states = dict(zip(model.state_names, result.x.T, strict=True))
    p = model.values
    h, u, a = states["f_H"], states["u"], p["A"]
    share = p["beta"] * p["h_ref"] * p["u_rated"]  # what makes one unit of heat, times |A|
    lost = 0.5 * (h[1:] + h[:-1]) * np.diff(u) * a - 0.5 * np.diff(h**2)
    fading = np.exp(-(t[3000] - 0.5 * (t[1:3001] + t[:3000])) / cooling)
    wanted = float(lost[:3000] @ fading) / share
    assert states["heat"][3000] == pytest.approx(wanted, rel=0.03)
    cold = driven(model.with_values({"heating_gain": 0.0}), t, voltage).y[:, -1]
    excess = (result.y[3100:, -1] - cold[3100:]) / cold[3100:]
    assert excess[0] == pytest.approx(0.02 * states["heat"][3100], rel=1e-3)
    rate = np.polyfit(t[3100:5000], np.log(excess[:1900]), 1)[0]
    assert -1.0 / rate == pytest.approx(cooling, rel=0.01)


def test_ageing_is_a_straight_line_in_log_time() -> None:
    """Of ageing_gain of the gain per decade, and nothing before time zero."""
    t = np.concatenate([[-20.0, -10.0, 0.0], np.geomspace(0.01, 100.0, 60)])
    model = linear(ageing, 0.02, ageing_time=1e-3)
    x = simulate(model, t, np.full(t.size, 80.0)).displacement
    fresh = simulate(model.with_values({"ageing_gain": 0.0}), t, np.full(t.size, 80.0)).displacement
    lost = 1.0 - x / fresh
    assert np.abs(lost[:3]).max() < 1e-7
    slope = np.polyfit(np.log10(t[20:]), lost[20:], 1)[0]
    assert slope == pytest.approx(0.02, rel=1e-3)
    np.testing.assert_allclose(lost[20:], 0.02 * np.log10(1 + t[20:] / 1e-3), rtol=1e-4)


PLANT = tuple(e for e in EFFECTS.values() if e.belongs_to == "plant")
#: Parameters of a curve's form.
ANGLES, WAVES = ("load_angle",), ("load_wave",)
every_effect = pytest.mark.parametrize("effect", PLANT, ids=lambda e: e.name)


def bounded(effect: Component) -> bool:
    """Whether the gain's bounds are within a thousand of its ordinary sizes."""
    model = ordinary(effect)
    gain = model.parameter(str(effect.gain))
    return max(map(abs, gain.bounds)) <= 1e3 * model.values[gain.name]


@every_effect
@every_base
def test_slopes_are_finite(effect: Component, base: tuple[Component, ...]) -> None:
    """At random points, at rest, and far away before time zero; with gain and without."""
    if not set(effect.needs) <= {c.name for c in base}:
        pytest.skip(f"needs {effect.needs}")
    generator = np.random.default_rng(11)
    for gains in (False, True):
        model = random_model((effect,), generator, gains=gains, base=base)
        point = random_point(model, generator)
        for time, size in ((point.time, 1.0), (0.0, 0.0), (-5.0, 100.0)):
            p = ca.DM(model.parameter_vector())
            at = [ca.DM(time), ca.DM(size * point.x), ca.DM(size * point.u), p]
            for function in functions_of(model.structure, sensitivities=True).values():
                slopes = function.call(at)
                assert all(np.isfinite(np.array(part)).all() for part in slopes)


@every_effect
def test_ordinary_size_shows_and_costs_little(effect: Component) -> None:
    """Between 0.05 and 10 % of the range, at no more than 1.5 times the steps, at any probe.

    A further resonance costs the steps of its oscillation. A weight may be 0 if others are not.
    """
    t, voltage = sine_and_steps()
    base = driven(stack("P-885.51"), t, voltage)
    grids = {n: grid for n, grid in effect.probe.items() if isinstance(grid, tuple)}
    grid = [{n: float(v)} for n, values in grids.items() for v in values]
    grid = [g for g in grid if any(g.values()) or not set(g) & set(effect.linear)]
    for values in grid or [{}]:
        result = driven(ordinary(effect, **values), t, voltage)
        change = np.abs(result.y[:, -1] - base.y[:, -1]).max() / np.ptp(base.y[:, -1])
        assert 5e-4 < change < 0.1, values
        assert effect.tone or result.steps <= 1.5 * base.steps, values


@pytest.mark.parametrize("effect", [e for e in PLANT if bounded(e)], ids=lambda e: e.name)
@pytest.mark.parametrize("end", [0, 1])
def test_no_gain_within_its_bounds_runs_away(effect: Component, end: int) -> None:
    """Within a thousand ordinary sizes: wider bounds say that stacks have no size in common."""
    t, voltage = sine_and_steps()
    bound = ordinary(effect).parameter(str(effect.gain)).bounds[end]
    grid = [{n: float(v)} for n, values in effect.probe.items() for v in values if n in ANGLES]
    waves = [{n: v} for n in WAVES for v in (-20.0, 20.0) if n in ordinary(effect).values]
    for shape in [{}, *grid, *waves]:
        model = ordinary(effect).with_values({str(effect.gain): bound, **shape})
        x = driven(model, t, voltage).y[:, -1]
        assert np.abs(x).max() < 3.0 * stroke_scale(model.values), shape


@pytest.mark.parametrize(
    ("effect", "base"),
    [
        *(pytest.param(e, BASE, id=e.name) for e in PLANT if e is not ageing),
        *(
            pytest.param(e, SIMPLIFIED, id=f"{e.name}, single mass", marks=slow)
            for e in (load_stiffness, preload_loss, backlash, hysteresis_memory)
        ),
    ],
)
def test_a_held_voltage_holds_the_output(effect: Component, base: tuple[Component, ...]) -> None:
    """The start at 100 V is an equilibrium of the extended model; ageing alone goes on.

    With a single mass: the effects that act on its force.
    """
    model = linear(effect, 0.3, base, **HYSTERESIS)
    x = simulate(model, np.arange(11) * 10.0, np.full(11, 100.0)).displacement
    assert x[0] > 0.3 * stroke_scale(model.values)
    assert np.ptp(x) < 1e-6 * x[0]


_STROKE, _RATED, _NOISE = 20e-6, 100.0, 20e-9


def _loops() -> dict[str, FloatArray]:
    """Loops of rising and falling amplitude of a generalised Prandtl-Ishlinskii stack."""
    t = np.arange(3000) * 2e-3
    swing = 0.5 * _RATED * np.interp(t, [0.0, 3.0, 6.0], [0.1, 1.0, 0.3])
    v = swing * (1.0 - np.cos(2.0 * np.pi * 1.5 * t))
    radii = _RATED * np.array([0.015, 0.04, 0.08, 0.13, 0.2, 0.3])
    plays = np.column_stack([play(v, radius) for radius in radii]) / _RATED
    weights = np.array([0.04, 0.035, 0.03, 0.03, 0.025, 0.02])
    x = 0.75 * v / _RATED + plays @ weights + plays**2 @ (0.6 * weights[::-1])
    noise = np.random.default_rng(7).normal(0.0, _NOISE, t.size)
    return {"time [s]": t, "voltage [V]": v, "displacement [m]": _STROKE * x / x.max() + noise}


def _with_spectrum(**values: Any) -> Model:
    items = [COMPONENTS["memory_spectrum"] if c.name == "bouc_wen" else c for c in BASE]
    return compose(items, {"u_rated": 120.0, "play_0": -0.05, "square_0": 0.02, **values})


@slow
def test_loops_of_plays_and_squares_prefer_the_spectrum(tmp_path: Path) -> None:
    record = psa.record_from(_loops())
    bouc_wen = psa.identify(record)
    best = psa.identify(record, hysteresis="best")
    assert "memory_spectrum" in [c.name for c in best.model.components]
    assert any("a spectrum of elements" in s for s in best.sentences)
    assert bouc_wen.fit.rms > 3.0 * _NOISE
    assert best.fit.rms < 1.3 * _NOISE
    psa.save_model(best.model, tmp_path / "model.json")
    again = psa.load_model(tmp_path / "model.json")
    assert again.values == best.model.values
    x = psa.simulate(again, record.time, record.voltage).outputs["displacement"]
    assert np.ptp(x) == pytest.approx(record.range_m, rel=0.03)


@slow
def test_loops_of_bouc_wen_keep_it(tmp_path: Path) -> None:
    make_record(None, 3, tmp_path / "record.csv")
    record = psa.read_record(tmp_path / "record.csv").slice(0, 1000)
    result = psa.identify(record, hysteresis="best")
    assert "bouc_wen" in [c.name for c in result.model.components]
    assert any(s.startswith("hysteresis: Bouc-Wen") for s in result.sentences)


def test_a_model_without_hysteresis_has_no_other_form() -> None:
    bare = compose([c for c in BASE if c.name != "bouc_wen"])
    with pytest.raises(psa.InputError, match="no hysteresis that could"):
        forms_of(bare, "spectrum")


def test_modelica_has_the_equations_of_the_model() -> None:
    model = _with_spectrum()
    assert right_side_error(model, modelica_text(model, include_sensor=True)) < 1e-12


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
    """Return the complex amplitude of one frequency in a signal, without its mean."""
    angle = 2 * np.pi * frequency * t
    columns = np.column_stack([np.cos(angle), np.sin(angle), np.ones_like(t)])
    a, b, _ = np.linalg.lstsq(columns, signal, rcond=None)[0]
    return complex(a, -b)


@pytest.mark.parametrize("level", [0.7, 0.85])
def test_a_clip_makes_flat_tops_at_its_level(level: float) -> None:
    """Behind a hard clip the stack does what it does at the clipped command: twice a flat top."""
    t = np.linspace(0.0, 1.0, 2001)
    voltage = 60.0 * (1.0 - np.cos(4 * np.pi * t))
    hard = simulated(with_effect(voltage_saturation, clip_gain=1.0, clip_level=level), t, voltage)
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
def test_a_drive_lag_joins_the_base_at_every_amplitude(
    frequency: float, amplitude: float, shape: float
) -> None:
    """Without hysteresis the response is the base's over 1 + i w T - shape (w T)^2."""
    lag = 2e-4
    t = np.linspace(0.0, 40.0 / frequency, 8001)
    voltage = amplitude * np.sin(2 * np.pi * frequency * t)
    late = t > 20.0 / frequency
    responses = []
    lagging = with_effect(drive_lag, drive_lag_time=lag, drive_lag_shape=shape)
    for model in (lagging, stack(STACK)):
        displayed = simulated(model.with_values(LINEAR), t, voltage)["measured_displacement"]
        responses.append(tone(t[late], displayed[late], frequency))
    ratio = responses[0] / responses[1]
    angle = 2 * np.pi * frequency * lag
    expected = 1.0 / (1.0 + 1j * angle - shape * angle**2)
    assert abs(ratio - expected) < 0.01


def test_a_leaking_charge_drive_droops_to_what_does_not_leak() -> None:
    """u = G v (1 - g (1 - exp(-t/T))) after a step from rest, and G v (1 - g) long after one."""
    gain, time = 0.3, 2.0
    model = with_effect(charge_leakage, leak_gain=gain, leak_time=time).with_values(LINEAR)
    t = np.linspace(0.0, 20.0, 4001)
    voltage = np.where(t > 0.0, 100.0, 0.0)
    late = t > 0.02
    expected = 1 - gain * (1 - np.exp(-(t[late] - 0.0025) / time))  # the ramp's middle
    result = simulated(model, t, voltage)
    np.testing.assert_allclose(result["u"][late], 100.0 * expected, rtol=1e-4)
    displayed = result["measured_displacement"][late] / (stroke(model) * 100.0 / 120.0)
    np.testing.assert_allclose(displayed, expected, rtol=3e-4)
    settled = simulated(model, t, np.full_like(t, 100.0))["u"]
    np.testing.assert_allclose(settled, 70.0, rtol=1e-9)


@pytest.mark.parametrize(("angle", "wave"), [(0.0, 0.0), (np.pi / 2, 0.0), (-1.0, 0.3)])
def test_a_bent_sensor_reads_a_function_of_the_displacement_alone(
    angle: float, wave: float
) -> None:
    """The bend is a Legendre series on 0 to 1 without its constant and its slope."""
    model = with_effect(
        sensor_nonlinearity, nonlinearity_gain=0.01, nonlinearity_angle=angle,
        nonlinearity_wave=wave,
    )  # fmt: skip
    t = np.linspace(0.0, 2.0, 2001)
    voltage = 60.0 * (1.0 - np.cos(4 * np.pi * t)) * (0.5 + 0.25 * t)
    result = simulated(model, t, voltage)
    x, size = result["displacement"], stroke(model)
    residual = result["measured_displacement"] - x
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


def read_by_the_sensor(model: psa.Model) -> tuple[FloatArray, FloatArray]:
    """Return displacement and error of the reading, 0 at first, under two cycles of 100 V."""
    t = np.linspace(0.0, 2.0, 4001)
    result = simulated(model, t, 50.0 * (1.0 - np.cos(2 * np.pi * t)))
    x = result["displacement"]
    residual = result["measured_displacement"] - x
    assert residual[0] == 0.0
    return x, residual


def test_a_ripple_repeats_with_the_displacement_on_both_branches() -> None:
    """Its first harmonic has the gain as amplitude, the second what its two shares say."""
    period = 1.3e-6
    model = with_effect(
        sensor_ripple, ripple_gain=2e-8, ripple_period=period, ripple_phase=0.7,
        ripple_second_cosine=0.3, ripple_second_sine=-0.4,
    )  # fmt: skip
    x, residual = read_by_the_sensor(model)
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
    model = with_effect(sensor_jump, jump_gain=3e-8, jump_place=place, jump_width=0.003)
    width = 0.003 * stroke_scale(model.values)
    x, residual = read_by_the_sensor(model)
    far = np.abs(x - place) > 10 * width
    np.testing.assert_allclose(residual[far], 3e-8 * (x[far] > place), rtol=0, atol=1e-15)
    for branch in (np.gradient(x) > 0, np.gradient(x) < 0):
        near = branch & (np.abs(x - place) < width)
        assert near.sum() > 5
        slope = np.polyfit(x[near] - place, residual[near], 1)[0]
        assert slope == pytest.approx(0.5 * 3e-8 / width, rel=0.3)


def test_hum_is_a_sine_that_keeps_amplitude_and_phase_for_a_thousand_periods() -> None:
    """At the fit's tolerance and a sample rate below the line, moving voltage or not."""
    model = with_effect(mains_hum, hum_gain=2e-8, hum_frequency=50.0)
    t: FloatArray = 0.3 + 0.011 * np.arange(
        2001.0
    )  # 90.9 samples per second: 50 Hz shows at its alias
    voltage = np.where(t < 10.0, 40.0, 40.0 * (1.0 + 0.5 * np.sin(t - 10.0)))
    result = simulated(model, t, voltage, memory={"hum_cosine": 0.6, "hum_sine": -0.8}, rtol=1e-6)
    hum = result["measured_displacement"] - result["displacement"]
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
    model = base.with_effect(temperature, {"expansion_gain": 2e-3, "temperature_lag": lag})
    t = np.linspace(0.0, 1000.0, 1001)
    result = simulated(model, t, np.zeros_like(t), temperature=ROOM + 1.5 + 0.003 * t)
    displayed = result["measured_displacement"]
    follows = 1.5 + 0.003 * (t - lag + lag * np.exp(-t / lag))
    np.testing.assert_allclose(displayed, 2e-3 * follows * stroke(model), rtol=1e-5, atol=0)
    assert not np.any(result["displacement"])


def test_the_gain_grows_with_temperature() -> None:
    """Without hysteresis, a slow voltage gives stroke v/u_rated (1 + ratio g dT) + g dT stroke."""
    values = {"expansion_gain": 2e-3, "temperature_gain_ratio": 1.5}
    model = with_effect(temperature, **values).with_values(LINEAR)
    t = np.linspace(0.0, 1000.0, 1001)
    rise, voltage = 0.01 * t, 60.0 * (1.0 - np.cos(0.1 * t))
    displayed = simulated(model, t, voltage, temperature=ROOM + rise)["measured_displacement"]
    g = 2e-3 * rise
    expected = stroke(model) * (voltage / 120.0 * (1 + 1.5 * g) + g)
    np.testing.assert_allclose(displayed, expected, rtol=0, atol=1e-4 * stroke(model))
