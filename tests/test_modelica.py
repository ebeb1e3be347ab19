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
from psa_casadi.export.modelica.package import export_modelica, modelica_text
from psa_casadi.model.compose import compose
from psa_casadi.model.ode_model import ode_model
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


@pytest.mark.parametrize(("start", "rests"), [(0.0, True), (2.0, True), (1.0, False)])
def test_the_text_says_whether_the_states_rest_at_the_start(start: float, rests: bool) -> None:
    """x' = x (2 - x) rests at 0 and at 2."""
    x = ca.SX.sym("x")
    states = [State("x", "1", "a population", 1.0, start=start)]
    model = ode_model({"x": x, "ode": x * (2.0 - x)}, name="logistic", states=states)
    text = modelica_text(model)
    assert ("states start at rest." in text) == rests
    assert ("states start at their start values" in text) != rests
