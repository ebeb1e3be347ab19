"""The parts around a stack, against formulas, the reference and a closed loop in plain Python.

And each as FMU 2 and 3 and in Modelica, by Python and by name.
"""

import math
from collections.abc import Callable, Mapping
from functools import partial
from math import copysign, pi, sqrt, tan
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.integrate import odeint
from scipy.interpolate import CubicSpline

import psa_casadi as psa
from psa_casadi import reference
from psa_casadi.common.units import BoolArray, FloatArray
from psa_casadi.export.modelica.package import modelica_text
from psa_casadi.model.nanopositioner import positioner_plant
from psa_casadi.model.variables import nominal_value
from tests.export.modelica_runs import simulated
from tests.model.stack_models import stack_values
from tests.tiers import slow

Values = Mapping[str, float]

#: States: filter, compensator (u, f_H), amplifier, stack (7), stage (2); their usual sizes.
_SIZES = np.array([1e-5, 1e2, 1e2, 1e2, 1e2, 1e2, 1e3, 1e-5, 1e-1, 1e-5, 1e-1, 1e-5, 1e-2])


class Run(NamedTuple):
    """At the instants: stage and tip of the stack [m], command and voltage at the stack [V]."""

    time: FloatArray
    position: FloatArray
    tip: FloatArray
    command: FloatArray
    voltage: FloatArray


def hysteresis_rate(p: Values, u: float, rate: float, force: float) -> float:
    """Return f_H' [N/s] by eq. (8), a voltage below `hold_rate` held."""
    sign = rate / sqrt(rate * rate + p["hold_rate"] ** 2)
    power: float = (abs(force) / p["h_ref"]) ** p["n"]
    bend = p["beta"] * rate * sign * copysign(power, force) + p["gamma"] * rate * power
    return p["A"] * rate - bend + p["delta"] * u * sign


def _rates(parts: Mapping[str, Values]) -> Callable[..., list[float]]:
    """Return the rates of the states at a held command; without compensator it passes through."""
    k, a, s, f = (parts[n] for n in ("controller", "amplifier", "stack", "flexure"))
    c = parts.get("compensator")
    slew = a["current_limit"] / a["load_capacitance"]

    def rates(z: FloatArray, t: float, command: float) -> list[float]:
        x_a, u_c, f_c, v, u, f_H, f_out, y, v_y, x, v_x, x_f, v_f = z.tolist()
        du_c = df_c = 0.0
        if c is not None:
            command -= c["compensation"] * f_c / (c["k_L"] * c["drive_gain"])
            du_c = (c["drive_gain"] * command - u_c) / c["drive_time"]
            df_c = hysteresis_rate(c, u_c, du_c, f_c)
        inside = min(max(a["gain"] * command, a["lowest_output"]), a["highest_output"])
        dv = 2.0 * pi * a["bandwidth"] * (inside - v)
        dv /= (1.0 + (dv / slew) ** 8) ** 0.125
        du = (s["G"] * v - u) / (s["R_s"] * s["C_p"])
        elastic = s["c_P"] * v_y + s["k_P"] * y
        pull = s["c_B"] * (v_x - v_y) + s["k_B"] * (x - y)
        contact = f["k_c"] * (x - x_f) + f["c_c"] * (v_x - v_f)
        return [
            (x_f - x_a) / k["filter_time"], du_c, df_c, dv, du, hysteresis_rate(s, u, du, f_H),
            (s["k_L"] * u + f_H - f_out) / s["tau"],
            v_y, (f_out - elastic) / s["m_P"],
            v_x, (elastic - contact - pull) / s["m_B"],
            v_f, (contact - f["c_f"] * v_f - f["k_f"] * x_f) / f["m_f"],
        ]  # fmt: skip

    return rates


class Controller:
    """The sampled controller: the command for a reference and a filtered position."""

    def __init__(self, p: Values) -> None:
        self.p = p
        self.integral = self.last = 0.0
        self.errors = [0.0, 0.0]
        self.filtered = [0.0, 0.0]
        t = tan(pi * p["notch_frequency"] * p["sample_time"])
        top, below = 2.0 * p["notch_floor"] * t, 2.0 * p["notch_width"] * t
        self.b = np.array([1.0 + top + t * t, 2.0 * (t * t - 1.0), 1.0 - top + t * t])
        self.a = np.array([1.0 + below + t * t, 2.0 * (t * t - 1.0), 1.0 - below + t * t])

    def __call__(self, reference: float, position: float) -> float:
        """Return the command; the notch is the difference equation a * e = b * (r - x)."""
        p, raw = self.p, reference - position
        known = self.a[1] * self.filtered[0] + self.a[2] * self.filtered[1]
        inputs = self.b[0] * raw + self.b[1] * self.errors[0] + self.b[2] * self.errors[1]
        error = float((inputs - known) / self.a[0])
        self.errors, self.filtered = [raw, self.errors[0]], [error, self.filtered[0]]
        self.integral += 0.5 * p["integral_gain"] * p["sample_time"] * (error + self.last)
        self.last = error
        wanted = p["proportional_gain"] * error + self.integral + p["feed_forward"] * reference
        command = min(max(wanted, p["lowest_command"]), p["highest_command"])
        self.integral += p["anti_windup"] * (command - wanted)
        return command


def simulate_positioner(
    parts: Mapping[str, Values],
    reference: Callable[[float], float],
    end: float,
    period: float,
    rtol: float = 1e-8,
) -> Run:
    """Simulate from rest; `parts` are the values of the system's parts by their names.

    Without a part "compensator" the command goes to the amplifier.
    """
    rates, state = _rates(parts), np.zeros(len(_SIZES))
    control = Controller(parts["controller"])
    time: FloatArray = period * np.arange(round(end / period) + 1, dtype=np.float64)
    rows = []
    for t in time:
        command = control(reference(float(t)), float(state[0]))
        rows.append((state[11], state[9], command, state[3]))
        held = partial(rates, command=command)
        atol: Any = 1e-2 * rtol * _SIZES  # one for each state, which the stubs do not know
        state = odeint(held, state, [0.0, period], rtol=rtol, atol=atol)[1]
    return Run(time, *np.array(rows).T)


STACK = "P-885.51"
VALUES = stack_values(STACK)


def _driven(model: psa.Model, t: FloatArray, **inputs: FloatArray) -> dict[str, FloatArray]:
    """Return outputs and states of a run from rest."""
    u = np.column_stack([np.broadcast_to(inputs.get(n, 0.0), t.shape) for n in model.input_names])
    steps = psa.run(model, t, u, np.zeros(len(model.state_names)), rtol=1e-8)
    states = dict(zip(model.state_names, steps.x.T, strict=True))
    return states | dict(zip(model.output_names, steps.y.T, strict=True))


def _smooth(t: FloatArray, values: FloatArray) -> Callable[[float], float]:
    """Return a smooth curve through samples."""
    spline = CubicSpline(t, values)
    return lambda time: float(spline(time))


def _line_deviation(x: FloatArray, y: FloatArray) -> float:
    """Return the largest distance from the best line, over the range."""
    basis = np.column_stack([x, np.ones_like(x)])
    left = y - basis @ np.linalg.lstsq(basis, y, rcond=None)[0]
    return float(np.abs(left).max() / np.ptp(y))


def _two_periods(frequency: float) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return times, a sine from 0 to 1 that starts at rest, and which samples are the second."""
    t = np.linspace(0.0, 2.0 / frequency, 801)
    return t, 0.5 * (1.0 - np.cos(2.0 * np.pi * frequency * t)), t >= 1.0 / frequency


def test_the_compensator_makes_the_reference_linear() -> None:
    """At 0.2 Hz, where lags do not count: below 0.02 % of the range, from more than 3 %."""
    t, wave, last = _two_periods(0.2)
    compensator = psa.compensator_for(psa.stack_model(STACK))
    compensated = _driven(compensator, t, command=80.0 * wave)["compensated_command"]
    deviations = []
    for voltage in (80.0 * wave, compensated):
        plant = reference.simulate(VALUES, _smooth(t, voltage), t, rtol=1e-7)
        deviations.append(_line_deviation(wave[last], plant.displacement[last]))
    assert deviations[0] > 0.03
    assert deviations[1] < 2e-4


@pytest.mark.parametrize(
    ("effect", "gain"),
    [
        pytest.param("hysteresis_memory", 2.5, marks=slow),
        ("field_dependent_gain", 0.1),
        pytest.param("saturation_of_strain", 0.3, marks=slow),
    ],
)
def test_the_compensator_takes_the_stack_s_effects_on_the_force(effect: str, gain: float) -> None:
    """The force behind the lag follows the command; without the effect it does not."""
    component = psa.EFFECTS[effect]
    plain = psa.stack_model(STACK).plant()
    stack = plain.with_effect(component, {str(component.gain): gain})
    t, wave, last = _two_periods(20.0)
    errors = []
    for known in (stack, plain):
        wires = (("compensator.compensated_command", "stack.voltage"),)
        model = psa.connect(
            {"compensator": psa.compensator_for(known), "stack": stack}, wires, name="m"
        )
        result = _driven(model, t, compensator_command=80.0 * wave)
        lag = stack.values["tau"] + stack.values["R_s"] * stack.values["C_p"]
        late = 40.0 * (1.0 - np.cos(2.0 * np.pi * 20.0 * (t - lag)))
        ideal = stack.values["k_L"] * late
        errors.append(np.abs(result["stack_f_out"] - ideal)[last].max() / np.ptp(ideal))
    assert errors[0] < 1e-3
    assert errors[1] > 1e-2


def test_the_voltage_amplifier_has_bandwidth_range_and_slew_rate() -> None:
    amplifier = psa.part_model("voltage_amplifier", bandwidth=1e3)
    t = np.linspace(0.0, 2e-3, 401)
    small = _driven(amplifier, t, command=np.full_like(t, 1e-3))["output_voltage"]
    np.testing.assert_allclose(small, 1e-2 * (1.0 - np.exp(-2e3 * np.pi * t)), atol=1e-8)
    beyond = _driven(amplifier, t, command=np.full_like(t, 30.0))["output_voltage"]
    assert beyond.max() <= 120.0 + 1e-6
    assert beyond[-1] == pytest.approx(120.0, abs=1e-3)
    slow = psa.part_model("voltage_amplifier", bandwidth=1e5, current_limit=0.05)
    result = _driven(slow, t, command=np.full_like(t, 10.0))
    slew = 0.05 / 1.5e-6
    assert result["load_current"].max() <= 0.05
    middle = (result["output_voltage"] > 10.0) & (result["output_voltage"] < 80.0)
    rate = np.polyfit(t[middle], result["output_voltage"][middle], 1)[0]
    assert rate == pytest.approx(slew, rel=1e-3)


def _charge_drive(**values: float) -> psa.Model:
    wires = (
        ("amplifier.output_voltage", "stack.voltage"),
        ("stack.charge", "amplifier.load_charge"),
    )
    parts = {"amplifier": psa.part_model("charge_amplifier", **values),
             "stack": psa.stack_model(STACK).plant()}  # fmt: skip
    return psa.connect(parts, wires, name="charge_drive")


def test_the_charge_amplifier_sets_voltage_below_its_corner_and_charge_above() -> None:
    """Gain and phase of v over the command, against the circuit's transfer function."""
    C_s, C, tau, ratio, bandwidth = 12e-6, 1.5e-6, 0.1, 10.0, 3e3
    model = _charge_drive(sense_capacitance=C_s, leak_time=tau, gain=ratio)
    for frequency in (0.2, 1.6, 30.0):
        t = np.linspace(0.0, 4.0 / frequency + 1.0, 8001)
        s = 2j * np.pi * frequency
        wave = 1e-3 * np.sin(2.0 * np.pi * frequency * t)
        v = _driven(model, t, amplifier_command=wave)["amplifier_output_voltage"]
        late = t >= t[-1] - 1.0 / frequency
        basis = np.column_stack([np.sin(abs(s) * t), np.cos(abs(s) * t)])[late]
        in_phase, quadrature = np.linalg.lstsq(basis, v[late], rcond=None)[0]
        # q_s = (s q + C_s v / (ratio tau)) / (s + 1/tau), q = C v / (1 + s R_s C)
        q = C / (1.0 + s * VALUES["R_s"] * C)
        sensed = (s * q + C_s / (ratio * tau)) / (s + 1.0 / tau)
        loop = 2.0 * np.pi * bandwidth * (C_s / C) / s
        expected = loop / (1.0 + loop * sensed / C_s)
        assert abs(1e3 * (in_phase + 1j * quadrature) - expected) < 2e-3 * abs(expected)


def _closed_on(model: psa.Model, reference_m: Callable[[float], float], count: int) -> FloatArray:
    """Return the commands of a controller whose plant is a fixed gain of 1 um/V, by the model."""
    names = model.state_names, model.sampled_names
    T, z = model.values["sample_time"], np.zeros(len(names[1]))
    commands = []
    position = 0.0
    for k in range(count):
        p = model.parameter_vector()
        inputs = [reference_m(k * T), 0.0]
        z = np.array(model.structure.g(k * T, [position], inputs, p, z)).ravel()
        commands.append(z[names[1].index("held_command")])
        position = 1e-6 * commands[-1]
    return np.array(commands)


def test_the_controller_is_the_recursion_of_a_textbook() -> None:
    """Notch, PI, feed-forward, saturation and anti-windup against a plain recursion."""
    model = psa.part_model(
        "position_controller", proportional_gain=2e5, integral_gain=4e8, feed_forward=1e5,
        notch_floor=0.1, notch_width=0.7,
    )  # fmt: skip

    def wanted(t: float) -> float:
        return 20e-6 if t < 3e-3 else -15e-6 * math.sin(3e3 * t)

    plain, position, expected = Controller(model.values), 0.0, []
    for k in range(200):
        expected.append(plain(wanted(k * 5e-5), position))
        position = 1e-6 * expected[-1]
    values = _closed_on(model, wanted, 200)
    assert values.max() == 12.0
    assert values.min() == -2.0
    np.testing.assert_allclose(values, expected, atol=1e-9)


def test_the_plain_loop_has_the_reference_s_stack() -> None:
    """With a stage that does not push back, the benchmark's stack moves as the reference's does."""
    system = psa.nanopositioner(compensated=False)
    values = {n: dict(m.values) for n, m in system.parts.items()}
    values["flexure"] |= {"k_c": 1e-3, "c_c": 0.0}
    values["amplifier"]["bandwidth"] = 2e3
    values["controller"] |= {"proportional_gain": 0.0, "integral_gain": 0.0, "feed_forward": 1e6}
    run = simulate_positioner(
        values, lambda t: 3e-6 * (1.0 - math.cos(400.0 * math.pi * t)), 0.005, 1e-5
    )
    voltage = _smooth(run.time, run.voltage)
    plant = reference.simulate(VALUES, voltage, run.time, rtol=1e-8)
    assert np.ptp(plant.displacement) > 5e-6
    np.testing.assert_allclose(run.tip, plant.displacement, atol=1e-4 * np.ptp(run.tip))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: psa.part_model("voltage"), "voltage_amplifier"),
        (lambda: psa.part_model("voltage_amplifier", speed=1.0), "no parameter 'speed'"),
        (
            lambda: psa.compensator_for(psa.part_model("flexure_stage")),
            "no drive, linear_force, bouc_wen",
        ),
    ],
)
def test_what_is_no_part_of_a_stack_is_refused(make: Callable[[], psa.Model], message: str) -> None:
    with pytest.raises(psa.InputError, match=message):
        make()


@pytest.mark.parametrize("name", psa.PARTS)
def test_a_part_is_the_same_in_modelica(name: str) -> None:
    """The first input is a sine of half its usual size, the others rest; all outputs."""
    model = psa.part_model(name)
    text = modelica_text(model, name="Part")
    first, *others = model.structure.inputs
    peak = 0.5 * nominal_value(first.nominal, model.values)
    span, omega = 2e-3, 2.0 * math.pi * 1e3
    rest = "".join(f", {i.name}={i.start!r}" for i in others)
    harness = (
        f"model Harness Part.Signal part({first.name}={peak!r}*(1 - cos({omega!r}*time)){rest});"
        " end Harness;"
    )
    got = simulated(text + harness, "Harness", span)
    t = np.linspace(0.0, span, 4001)
    u = np.tile([i.start for i in model.structure.inputs], (len(t), 1))
    u[:, 0] = peak * (1.0 - np.cos(omega * t))
    steps = psa.run(model, t, u, np.zeros(len(model.state_names)), rtol=1e-8)
    names = (*model.state_names, *model.output_names)
    between = slice(40, None, 100)  # between two sample instants, where rumoca has points
    for variable, wanted in zip(names, np.hstack([steps.x, steps.y]).T, strict=True):
        at = np.interp(t[between], got["time"], got[f"part.{variable}"])
        error = np.abs(at - wanted[between]).max()
        assert error < 1e-4 * max(np.ptp(wanted), 1e-12), variable


STACK_AND_STAGE = (
    ("stack.displacement", "flexure.tip_position"),
    ("stack.velocity", "flexure.tip_velocity"),
    ("flexure.reaction_force", "stack.load_force"),
)


def _gain(name: str, unit: str = "V") -> psa.Model:
    """A part whose output follows its input at once."""
    part = psa.Component(
        name=name,
        description="twice the input",
        source="test",
        equations=lambda s: psa.Equations(out={"out": 2.0 * s.into}),
        inputs=(psa.Input("into", "V", "input", start=0.25),),
        outputs=(psa.Output("out", unit, "output"),),
    )
    return psa.compose([part], name=name)


def test_a_connected_model_has_the_equations_of_its_parts() -> None:
    """Derivatives and outputs of stack and stage at random points, wired by hand."""
    stack, stage = psa.stack_model("P-885.51").plant(), psa.part_model("flexure_stage")
    both = psa.connect({"stack": stack, "flexure": stage}, STACK_AND_STAGE, name="both")
    assert both.input_names == ("stack_voltage",)
    draw = np.random.default_rng(2)
    for _ in range(5):
        x = stack.state_nominals() * draw.normal(size=len(stack.state_names))
        x_f = stage.state_nominals() * draw.normal(size=2)
        tip = np.array([x[stack.state_names.index("x")], x[stack.state_names.index("v_x")]])
        slope, out = stage.structure.f(0.0, x_f, tip, stage.parameter_vector())
        force = float(out[stage.output_names.index("reaction_force")])
        rates, y = stack.structure.f(0.0, x, [30.0, force], stack.parameter_vector())
        got = both.structure.f(0.0, [*x, *x_f], [30.0], both.parameter_vector())
        parts = [np.array(v).ravel() for v in (rates, slope, y, out)]
        expected = np.concatenate(parts[:2]), np.concatenate(parts[2:])
        for result, wanted in zip(got, expected, strict=True):
            np.testing.assert_allclose(np.array(result).ravel(), wanted, rtol=1e-13)


def test_every_mistake_in_the_wires_is_reported_at_once() -> None:
    parts = {"a": _gain("a"), "b": _gain("b"), "c": _gain("c", unit="m")}
    wires = (("a.out", "b.into"), ("b.out", "b.into"), ("c.out", "a.into"), ("a.there", "c.into"),
             ("nowhere.out", "c.into"))  # fmt: skip
    with pytest.raises(psa.InputError) as caught:
        psa.connect(parts, wires, name="m", inputs={"x": "b.into", "2y": "c.into"})
    text = str(caught.value)
    for part in (
        "'2y' cannot name",
        "'b.into' has two sources, 'a.out' and 'b.out'",
        "from 'c.out' [m] to 'a.into' [V] joins different units",
        "'a.there' is no output",
        "'nowhere.out' names no part",
        "has two sources, 'b.out' and 'x'",
    ):
        assert part in text


def test_an_algebraic_loop_is_named() -> None:
    parts = {"a": _gain("a"), "b": _gain("b")}
    with pytest.raises(psa.InputError, match=r"a\.out -> b\.out -> a\.out"):
        psa.connect(parts, (("a.out", "b.into"), ("b.out", "a.into")), name="m")


def test_sampled_parts_of_different_periods_are_refused() -> None:
    parts = {n: psa.part_model("position_controller", sample_time=t)
             for n, t in (("one", 1e-4), ("two", 2e-4))}  # fmt: skip
    with pytest.raises(
        psa.InputError, match=r"one_sample_time = 0\.0001 s, two_sample_time = 0\.0002 s"
    ):
        psa.connect(parts, (), name="m")


def _reference(t: float) -> float:
    return 5e-6 * (1.0 - math.cos(2.0 * math.pi * 250.0 * t))


@pytest.mark.parametrize("compensated", [False, True])
def test_the_closed_loop_is_that_of_an_independent_simulation(compensated: bool) -> None:
    """Position, command and voltage at every instant, against the loop in plain Python."""
    system = psa.nanopositioner(compensated=compensated)
    run = simulate_positioner(
        {n: m.values for n, m in system.parts.items()}, _reference, 4e-3, 5e-5
    )
    model = system.model()
    samples = np.array([[_reference(t)] for t in run.time])
    steps = psa.run(model, run.time, samples, np.zeros(len(model.state_names)), rtol=1e-9)
    displayed = dict(zip(model.output_names, steps.y.T, strict=True))
    assert np.ptp(run.position) > 8e-6
    np.testing.assert_allclose(displayed["stage_position"], run.position, atol=1e-12)
    np.testing.assert_allclose(displayed["command"], run.command, atol=1e-6)
    np.testing.assert_allclose(displayed["voltage"], run.voltage, atol=1e-5)


@pytest.mark.parametrize("stack", ["P-885.51", "PTBS200", "WYDS0808020"])
def test_the_tuned_loop_keeps_its_margins(stack: str) -> None:
    """The required sensitivity is met with the resonance where it is, and used up nearly."""
    plant = positioner_plant(stack).model()
    table = {}
    for limit in (1.4, 1.6):
        tuned = psa.controller_for(plant, position="stage_position", sensitivity=limit)
        table[limit] = psa.margins_of(plant, tuned, "stage_position")
        assert 1.2 < table[limit].sensitivity <= limit * 1.0001
        assert table[limit].gain > limit / (limit - 1.0)
        assert table[limit].phase > 2.0 * np.arcsin(0.5 / limit)
        for share in (0.9, 1.1):
            notch = share * tuned.values["notch_frequency"]
            model = tuned.with_values({"notch_frequency": notch})
            assert psa.margins_of(plant, model, "stage_position").sensitivity <= limit * 1.0001
    assert table[1.6].crossover > table[1.4].crossover > 50.0


def test_a_plant_that_cannot_be_tuned_is_refused() -> None:
    stack = psa.stack_model("P-885.51").plant()
    with pytest.raises(psa.InputError) as caught:
        psa.controller_for(stack, sensitivity=9.0, sample_time=-1.0)
    assert [p.split()[0] for p in caught.value.problems] == [
        "The", "The", "sample_time", "sensitivity",
    ]  # fmt: skip
