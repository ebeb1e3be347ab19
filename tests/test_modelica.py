import difflib
import re
from pathlib import Path

import casadi as ca
import pytest
from typer.testing import CliRunner

from psa_casadi.cli.app import app
from psa_casadi.component import Component, Equations
from psa_casadi.components import BASE
from psa_casadi.effects import EFFECTS
from psa_casadi.errors import InputError
from psa_casadi.export.modelica.package import class_names, export_modelica, modelica_text
from psa_casadi.model.compose import compose
from psa_casadi.model.ode_model import ode_model
from psa_casadi.model.parts import part_model
from psa_casadi.model.stacks import stack_model
from psa_casadi.variables import Input, Output, Parameter, State

_GOLDEN = Path(__file__).parent / "golden" / "P-885.51.mo"
_ACCEPT = "psa export modelica --stack P-885.51 -o tests/golden/P-885.51.mo"


def _without_version(text: str) -> list[str]:
    return re.sub(r"psa_casadi \d[\w.+]*", "psa_casadi", text).splitlines(keepends=True)


def test_the_package_is_the_one_that_was_accepted(tmp_path: Path) -> None:
    path = export_modelica(stack_model("P-885.51"), tmp_path / "stack.mo")
    expected = _without_version(_GOLDEN.read_text(encoding="utf-8"))
    found = _without_version(path.read_text(encoding="utf-8"))
    diff = "".join(difflib.unified_diff(expected, found, "accepted", "found", n=1))
    assert not diff, f"{diff}\nIf this is meant: {_ACCEPT}"


def test_every_balance_and_state_has_one_equation_and_is_declared_once() -> None:
    model = compose((*BASE, *EFFECTS.values()))
    text = modelica_text(model, include_sensor=True)
    signal = re.sub(r"//[^\n]*", "", text.split("  model Signal")[1].split("annotation(")[0])
    declared, equations = signal.split("\n  equation\n")
    names = [*model.structure.balances, *model.output_names]
    for name in dict.fromkeys(names):
        assert len(re.findall(rf"(?:^|;)\s*{name} =", equations, re.M)) == 1, name
        assert len(re.findall(rf"Real {name}\b", declared)) == 1, name
    for name in model.state_names:
        assert equations.count(f"der({name}) =") == 1, name
    for parameter in model.structure.parameters:
        assert f'parameter Real {parameter.name}(unit="{parameter.unit}"' in declared


def test_declarations_carry_units_bounds_starts_and_usual_sizes() -> None:
    text = modelica_text(stack_model("P-885.51"))
    assert (
        'parameter Real C_p(unit="F", displayUnit="uF", min=1e-10, max=0.01) = 1.5e-06'
        ' "capacitance of the stack";'
    ) in text
    assert 'input Real voltage(unit="V", start=0.0, nominal=120.0) ' in text
    assert (
        'Real x(unit="m", displayUnit="um", start=0.0, fixed=true, nominal=2.1e-05)'
        ' "displacement of the output mass";'
    ) in text
    assert "Yang and Zhu 2015, eqs. 4 and 5" in text


def test_equations_are_short_and_speak_the_models_words() -> None:
    text = modelica_text(stack_model("P-885.51"))
    for line in (
        "drive_current = (drive_voltage - u)/R_s; // drive",
        "free_force = k_L*u + f_H; // linear_force, bouc_wen",
        "der(v_y) = (wafer_force - transmitted_force)/m_P;",
        "velocity = der(x);",
    ):
        assert f"    {line}\n" in text


def test_the_sensor_stays_out_unless_it_is_wanted() -> None:
    model = stack_model("P-885.51").with_effect(EFFECTS["sensor_lag"])
    assert "sensor_lag" not in modelica_text(model)
    assert "sensor_lag_time" in modelica_text(model, include_sensor=True)


def test_the_same_model_gives_the_same_text() -> None:
    first = modelica_text(compose((*BASE, *EFFECTS.values())))
    assert modelica_text(compose((*BASE, *EFFECTS.values()))) == first


def test_classes_are_those_in_the_text() -> None:
    model = stack_model("P-885.51").plant()
    text = modelica_text(model)
    assert class_names(model) == ("Signal", "Acausal", "Examples.Sine", "Examples.Wired")
    for name in class_names(model):
        assert f"model {name.rpartition('.')[2]} " in text
        assert f"end {name.rpartition('.')[2]};" in text


def _decay(parameter: str = "rate", output: str = "shown", state: str = "z") -> Component:
    return Component(
        "decay",
        'a "decay" \\ of <z>',
        "none",
        lambda s: Equations(
            der={state: -getattr(s, parameter) * getattr(s, state) + s.pull},
            out={output: 2 * getattr(s, state)},
        ),
        parameters=(Parameter(parameter, 2.0, "1/s", (0.0, float("inf")), "rate"),),
        states=(State(state, "counts", "z", 1.0, start=1.0),),
        inputs=(Input("pull", "counts/s", "pull", start=0.5),),
        outputs=(Output(output, "counts", "twice z"),),
    )


def test_names_that_modelica_has_taken_are_changed_and_texts_escaped() -> None:
    text = modelica_text(compose([_decay("model", "output", "der")], name="decay"))
    assert 'parameter Real model_2(unit="1/s", min=0.0) = 2.0 "rate";' in text
    assert "der(der_2) = pull - model_2*der_2;" in text
    assert "output_2 = 2*der_2;" in text
    assert 'input Real pull(unit="1/s", start=0.5, nominal=1.0)' in text
    assert 'decay: a "decay" \\ of <z>' in text  # in a comment
    assert 'a \\"decay\\" \\\\ of &lt;z&gt;' in text  # in the documentation
    assert (
        "Signal device(pull=0.5 + 0.5*height*(1 - cos(6.283185307179586*frequency*time)))" in text
    )
    assert "Acausal" not in text.split("annotation(Doc")[0]
    assert "uses(Modelica" not in text


@pytest.mark.parametrize("name", ["2stack", "model", "Piezo-Stack", ""])
def test_a_name_that_no_package_can_have_is_refused(name: str) -> None:
    with pytest.raises(InputError, match="cannot name a Modelica package"):
        modelica_text(stack_model("P-885.51"), name=name)


def test_names_that_clash_are_refused() -> None:
    with pytest.raises(InputError, match="named 'z', which Modelica does not allow"):
        modelica_text(compose([_decay(output="z")]))
    with pytest.raises(InputError, match="output 'tip_force' of 'psa' differs from the balance"):
        modelica_text(compose([*BASE, _decay(output="tip_force")]))


def test_a_start_that_is_not_finite_is_refused(tmp_path: Path) -> None:
    endless = Component(
        "endless",
        "no start",
        "none",
        lambda s: Equations(der={"z": -s.z}),
        states=(State("z", "1", "z", 1.0, start=float("inf")),),
    )
    with pytest.raises(InputError, match="start of state 'z' is inf, which Modelica cannot write"):
        export_modelica(compose([endless]), tmp_path / "x.mo")
    assert not list(tmp_path.iterdir())


def test_the_command_writes_the_package_and_says_what_is_in_it(tmp_path: Path) -> None:
    path = tmp_path / "PiezoStack.mo"
    arguments = ["export", "modelica", "--stack", "P-885.51", "-o", str(path)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "left out: sensor" in result.output
    assert "PiezoStack.Signal, PiezoStack.Acausal, PiezoStack.Examples.Sine" in result.output
    assert path.read_text(encoding="utf-8") == modelica_text(stack_model("P-885.51"))


def test_the_command_refuses_an_impossible_name(tmp_path: Path) -> None:
    arguments = ["export", "modelica", "--stack", "P-885.51", "--name", "end"]
    result = CliRunner().invoke(app, [*arguments, "-o", str(tmp_path / "x.mo")])
    assert result.exit_code == 2
    assert "'end' cannot name a Modelica package" in result.output


def test_a_stack_has_a_stacks_icon_and_everything_else_a_plain_one() -> None:
    stack, amplifier = (
        modelica_text(m) for m in (stack_model("P-885.51"), part_model("voltage_amplifier"))
    )
    assert "extends Icons.Stack;" in stack
    assert "Icons.Block" not in stack
    assert "extends Icons.Block;" in amplifier
    assert "partial model Block" in amplifier
    assert "Stack" not in amplifier.replace("PiezoStack", "")


@pytest.mark.parametrize(("start", "rests"), [(0.0, True), (2.0, True), (1.0, False)])
def test_the_text_says_whether_the_states_rest_at_the_start(start: float, rests: bool) -> None:
    """x' = x (2 - x) rests at 0 and at 2."""
    x = ca.SX.sym("x")
    states = [State("x", "1", "a population", 1.0, start=start)]
    model = ode_model({"x": x, "ode": x * (2.0 - x)}, name="logistic", states=states)
    text = modelica_text(model)
    assert ("states start at rest." in text) == rests
    assert ("states start at their start values" in text) != rests
