import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from psa_casadi.components import COMPONENTS, SIMPLIFIED
from psa_casadi.effects import EFFECTS
from psa_casadi.export.modelica.package import modelica_text, reciprocal
from psa_casadi.model.compose import compose
from psa_casadi.model.stacks import STACKS, stack_model
from psa_casadi.simulation.stepper import run
from tests.modelica_runs import load, model_named, simulated, text_of
from tests.modelica_stub import STUB
from tests.tiers import slow_but

FloatArray = NDArray[np.float64]

_WIRED = "PiezoStack.Examples.Wired"


def _value(text: str, part: str, name: str) -> float:
    """Return what the example gives a parameter of one of its parts."""
    example = text.split("model Wired")[1]
    found = example.split(f" {part}(")[1].split(f"{name}=")[1]
    return float(found.split(",")[0].split(")")[0])


def _by_hand(p: dict[str, float], text: str, t: FloatArray) -> FloatArray:
    """Return displacement, mass position and current, from equations written out here.

    The load's spring and damper pull at the stack's output, the bonding layers at the wafers.
    """
    amplitude, frequency = _value(text, "source", "V"), _value(text, "source", "f")
    c, d = _value(text, "springDamper", "c"), _value(text, "springDamper", "d")
    m = _value(text, "mass", "m")

    def current(time: float, u: float) -> float:
        source = amplitude * (1.0 - np.cos(2.0 * np.pi * frequency * time))
        return float(source - u) / p["R_s"]

    def rates(time: float, state: FloatArray) -> list[float]:
        u, f_H, f_out, y, v_y, x, v_x, s, v = state
        rate = current(time, u) / p["C_p"]
        sign = rate / np.hypot(rate, p["hold_rate"])
        power = (abs(f_H) / p["h_ref"]) ** p["n"]
        bend = p["beta"] * rate * sign * np.sign(f_H) * power + p["gamma"] * rate * power
        pull = p["c_B"] * (v_x - v_y) + p["k_B"] * (x - y)
        load = c * (s - x) + d * (v - v_x)
        return [
            rate,
            p["A"] * rate - bend + p["delta"] * u * sign,
            (p["k_L"] * u + f_H - f_out) / p["tau"],
            v_y,
            (f_out + pull - p["c_P"] * v_y - p["k_P"] * y) / p["m_P"],
            v_x,
            (load - pull) / p["m_B"],
            v,
            -load / m,
        ]

    size = np.array([100.0, 100.0, 1e3, 1e-5, 1e-2, 1e-5, 1e-2, 1e-5, 1e-2])
    span = (0.0, float(t[-1]))
    found = solve_ivp(rates, span, np.zeros(9), "Radau", t, rtol=1e-10, atol=1e-12 * size)
    drawn = np.array([current(time, u) for time, u in zip(t, found.y[0], strict=True)])
    return np.array([found.y[5], found.y[7], drawn])


@pytest.mark.parametrize("name", slow_but(["P-885.51"], ["P-885.51", "WYDS0808020"]))
def test_the_wired_example_follows_equations_written_by_hand(name: str) -> None:
    model = stack_model(name)
    text = modelica_text(model)
    span = float(text.split("model Wired")[1].split("StopTime=")[1].split(",")[0])
    got = simulated(STUB + text, _WIRED, span, rtol=1e-10)
    t = got["time"]
    expected = _by_hand(dict(model.values), text, t)
    for values, name_of_it in zip(
        expected, ("stack.displacement", "mass.s", "stack.current"), strict=True
    ):
        assert np.abs(got[name_of_it] - values).max() < 1e-6 * np.ptp(values), name_of_it


@pytest.mark.parametrize(
    "name",
    slow_but(["P-885.51", "slow_creep", "every_effect"], [*STACKS, *EFFECTS, "every_effect"]),
)
def test_every_wired_example_is_a_balanced_system(name: str) -> None:
    model = load(STUB + text_of(name), _WIRED)
    structure = model.structure()
    assert structure.is_balanced
    assert structure.is_matched


def test_one_mass_needs_no_reaction() -> None:
    text = modelica_text(compose(SIMPLIFIED))
    assert "reciprocal" not in text
    assert load(STUB + text, _WIRED).structure().is_balanced


def test_the_reaction_is_there_whatever_the_gain_of_the_model() -> None:
    assert "final parameter Real reciprocal_gain" in text_of("P-885.51")
    model = model_named("reciprocal_coupling")
    assert model.values["reciprocal_gain"] == 0.25
    signal, acausal = modelica_text(model).split("  model Acausal")
    assert "max=1.2) = 0.25" in signal
    assert "max=1.2) = 1.0" in acausal
    assert "reciprocal_gain = 1, action and reaction" in acausal


def test_a_stage_has_a_flange_to_be_pushed_at() -> None:
    """The stage between a spring to the ground and a position that is given."""
    text = modelica_text(compose([COMPONENTS["flexure"]], name="flexure"), name="Stage")
    bench = """
    model Mover
      Modelica.Mechanics.Translational.Interfaces.Flange_b flange_b;
      Real s(start=0, fixed=true);
    equation
      der(s) = 1e-4;
      flange_b.s = s;
    end Mover;
    model Bench
      Stage.Acausal stage;
      Mover mover;
    equation
      connect(mover.flange_b, stage.flange_a);
    end Bench;
    """
    got = simulated(STUB + text + bench, "Bench", 0.05, rtol=1e-10)
    contact = 5e7 * (got["mover.s"] - got["stage.x_f"]) + 500.0 * (1e-4 - got["stage.v_f"])
    np.testing.assert_allclose(got["stage.flange_a.f"], contact, rtol=1e-6, atol=1e-9)
    # slow motion: contact and flexure are springs in series, but for the damper's drag
    drag = 50.0 * got["stage.v_f"][-1]
    assert contact[-1] == pytest.approx(5e6 * got["stage.x_f"][-1] + drag, rel=1e-3)


@pytest.mark.parametrize("name", STACKS)
def test_the_sine_moves_every_stack_up_and_down(name: str) -> None:
    text = modelica_text(stack_model(name))
    span = float(text.split("model Sine")[1].split("StopTime=")[1].split(",")[0])
    x = simulated(text, "PiezoStack.Examples.Sine", span, rtol=1e-8)["device.displacement"]
    assert 4 <= np.count_nonzero(np.diff(np.sign(np.diff(x))) < 0) <= 5
    assert x.max() > 1e-6


def test_scaled_forces_give_the_free_stroke_of_the_cascade() -> None:
    """What the documentation of `Acausal` says about its stroke."""
    model = stack_model("P-885.51")
    p = model.values
    scale = (p["k_P"] + p["k_B"]) / p["k_B"]
    assert f"{1 / scale:.4g} times that of the cascade" in modelica_text(model)
    forces = ("k_L", "A", "beta", "gamma", "delta", "h_ref")
    scaled = reciprocal(model.with_values({n: scale * p[n] for n in forces}))
    t = np.linspace(0.0, 1.0, 101)
    u = np.column_stack([60.0 * np.minimum(2 * t, 1.0), np.zeros(101)])
    ends = [
        run(m, t, u, np.zeros(len(m.state_names)), rtol=1e-9).x[-1, m.state_names.index("x")]
        for m in (model, scaled, reciprocal(model))
    ]
    assert ends[1] == pytest.approx(ends[0], rel=1e-6)
    assert ends[2] == pytest.approx(ends[0] / scale, rel=1e-6)
