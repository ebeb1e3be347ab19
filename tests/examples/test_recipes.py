"""The recipes for other tools: what can run here runs, and every name the rest uses is checked."""

import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import replace
from functools import cache
from pathlib import Path
from unittest.mock import MagicMock

import fmpy.cli
import numpy as np
import pytest
import yaml  # type: ignore[import-untyped]
from fmpy import read_model_description

import psa_casadi as psa
from build_scripts.measured_data import ROOT
from psa_casadi.examples.index import Example, Script, examples
from psa_casadi.export.fmu.platforms import chosen_platforms
from psa_casadi.model.component import BALANCES
from tests.contract.helpers import done, table
from tests.export.modelica_runs import STUB, load
from tests.tiers import slow

_FOLDER = tempfile.TemporaryDirectory()


def run_command(command: str) -> None:
    """Run a command of `psa` in the current folder, for the platform of this machine only.

    What binaries of other platforms do is tested by tests/export/test_fmu_platforms.py.
    """
    words = shlex.split(command)
    assert words[0] == "psa"
    if "--platforms" in words:
        at = words.index("--platforms")
        assert chosen_platforms(words[at + 1].split(","))
        del words[at : at + 2]
    if words[1] != "export" or "--model" in words:
        done(*words[1:])
        return
    at = words.index("-o") + 1
    shutil.copy(_exported(tuple(words[:at]), words[at]), words[at])


@cache
def _exported(words: tuple[str, ...], name: str) -> Path:
    """Run an export that reads no file, once for all pages that have the command."""
    path = Path(tempfile.mkdtemp(dir=_FOLDER.name)) / name
    done(*words[1:], path)
    return path


RECIPES = [e.name for e in examples().values() if e.kind == "recipe"]


def _shell(recipe: Example) -> list[str]:
    return re.findall(r"^\$ (.*)$", recipe.text, re.MULTILINE)


@pytest.fixture
def made(request: pytest.FixtureRequest, made_files: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder with what the page's `psa` commands make; the current one for the test."""
    folder = made_files / str(request.param)
    folder.mkdir(exist_ok=True)
    monkeypatch.chdir(folder)
    for command in _shell(examples()[request.param]):
        run_command(command)
    return folder


@pytest.fixture(scope="module")
def made_files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("recipes")


def _script(recipe: str, name: str) -> Script:
    return next(s for s in examples()[recipe].scripts if s.name == name)


def test_every_page_has_what_was_executed() -> None:
    assert set(RECIPES) >= {"openmodelica", "dymola", "simulink", "omsimulator", "fmpy", "ci"}
    for name in RECIPES:
        assert "\n## What was executed\n" in examples()[name].text, name


#: The names that each tool accepts in its scripts, from its documentation.
WORDS = {
    "openmodelica": "loadModel loadFile getErrorString getClassNames simulate startTime stopTime"
    " numberOfIntervals tolerance outputFormat importFMU workdir loglevel fullPath true wrapper"
    " Modelica",
    "dymola": "openModel simulateModel startTime stopTime numberOfIntervals method tolerance"
    " resultFile importFMU includeAllVariables integrate promptReplacement true false",
}
#: Blocks of Simulink, and the parameters that they have.
BLOCKS = {
    "simulink_extras/FMU Import/FMU": {
        "FMUName", "FMUMode", "FMUSampleTime", "FMUInputMapping", "FMUOutputMapping"},
    "simulink/Sources/Sine Wave": {"Amplitude", "Bias", "Frequency", "Phase"},
    "simulink/Sources/Constant": {"Value"},
    "simulink/Sinks/To Workspace": {"VariableName"},
}  # fmt: skip


@pytest.mark.parametrize("made", WORDS, indirect=True)
def test_modelica_scripts(made: Path) -> None:
    """Functions and arguments exist in the tool; files, classes, times and variables in ours."""
    package = (made / "PiezoStack.mo").read_text(encoding="utf-8")
    text = "\n".join(script.text.strip() for script in examples()[made.name].scripts)
    assert all(line.endswith(");") for line in text.splitlines())
    bare = re.sub(r'"[^"]*"|PiezoStack[.\w]*|\b[\d.e-]+\b', "", text)
    assert set(re.findall(r"\w+", bare)) == {*WORDS[made.name].split()}
    assert all((made / name).is_file() for name in re.findall(r'"(\w+\.(?:fmu|mo))"', text))
    runs = re.findall(r'(PiezoStack[.\w]*)"?, startTime=([^,]*), stopTime=([^,]*),', text)
    assert len(runs) == 2
    for name, *times in runs:
        assert load(package + STUB, name) is not None
        body = package.partition(f"model {name.rpartition('.')[2]} ")[2]
        stated = re.search(r"experiment\(StartTime=(\S+), StopTime=(\S+),", body)
        assert stated is not None
        assert [float(t) for t in times] == [float(t) for t in stated.groups()]
    page = examples()[made.name].text
    for variable in read_model_description("stack.fmu").modelVariables:
        if variable.causality == "input":
            assert f"`{variable.name}` [{variable.unit}]" in page


@pytest.mark.parametrize("made", ["simulink"], indirect=True)
@pytest.mark.usefixtures("made")
def test_the_matlab_script() -> None:
    """Blocks are added before they are used, ports and parameters are those of the FMU."""
    text = _script("simulink", "run_stack.m").text
    variables = read_model_description("stack.fmu").modelVariables
    ports = {k: [v for v in variables if v.causality == k] for k in ("input", "output")}
    known = {"model": {"StopTime", "SolverType", "FixedStep"}}
    wires: dict[str, str] = {}
    for call, inputs in re.findall(
        r"^(add_block|set_param|add_line)\((.*)\);$", text, re.MULTILINE
    ):
        words = re.findall(r"'([^']*)'", inputs)
        if call == "add_line":
            wires[words[1]] = words[0]
            continue
        kind = words.pop(0) if call == "add_block" else ""
        name = words.pop(0)[1:] if words[0].startswith("/") else "model"
        if kind:
            known[name] = BLOCKS[kind]
        tunable = {v.name for v in variables if name == "Stack" and v.causality == "parameter"}
        assert {*words[::2]} <= known[name] | (set() if kind else tunable), words
    assert {end.split("/")[0] for wire in wires.items() for end in wire} <= known.keys()
    assert "'FMUName', 'stack.fmu'" in text
    fed = {v.name: wires[f"Stack/{k}"] for k, v in enumerate(ports["input"], 1)}
    assert fed == {"voltage": "Voltage/1", "load_force": "Load/1"}
    displayed = int(wires["Displacement/1"].removeprefix("Stack/"))
    assert ports["output"][displayed - 1].name == "displacement"
    for kind, row in ports.items():
        listed = ", ".join(f"{i} {v.name} [{v.unit}]" for i, v in enumerate(row, 1))
        assert f"% {kind}s: {listed}\n" in text


@slow
@pytest.mark.parametrize("made", ["omsimulator"], indirect=True)
def test_the_scripts_for_omsimulator_wire_what_fits(
    made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Run with a module that only notes its calls: ports exist, and fit by pairs."""
    tool = MagicMock()
    tool.CRef = lambda *names: names
    monkeypatch.setitem(sys.modules, "OMSimulator", tool)
    for name in ("push_the_stage.py", "move_the_stage.py"):
        exec(compile(_script("omsimulator", name).text, name, "exec"), {})
    ports = {
        ("default", part, v.name): v
        for part in ("stack", "stage")
        for v in read_model_description(f"{part}.fmu").modelVariables
    }
    wires = [call.args for call in tool.SSP().addConnection.call_args_list]
    assert len(wires) == 3
    for source, target in wires:
        assert (ports[source].causality, ports[target].causality) == ("output", "input")
        assert ports[source].unit == ports[target].unit
    model = tool.SSP().instantiate()
    (pushed, _), (moved, _) = (call.args for call in model.setValue.call_args_list)
    assert ports[pushed].causality == "input"
    reached = model.getValue.call_args_list[0].args[0]
    assert ports[reached].causality in ("local", "output")
    with zipfile.ZipFile("nanopositioner.ssp") as archive:
        drawing = archive.read("SystemStructure.ssd").decode()
    assert f'name="{moved[1]}"' in drawing
    assert moved[0] in drawing
    files = re.findall(r"\S+\.(?:fmu|ssp)\b", _script("omsimulator", "run_omsimulator.sh").text)
    assert files == ["held.fmu", "held.fmu", "nanopositioner.ssp"]
    assert all((made / name).is_file() for name in files)


@slow
@pytest.mark.skipif(shutil.which("OMSimulator") is None, reason="OMSimulator is not installed")
@pytest.mark.parametrize("made", ["omsimulator"], indirect=True)
def test_what_omsimulator_makes_of_them(made: Path) -> None:
    """A stack that is held at 60 V stays there, a closed loop rests."""
    for line in _script("omsimulator", "run_omsimulator.sh").text.splitlines():
        subprocess.run(shlex.split(line), cwd=made, check=True, timeout=120)
    held = psa.settled_at(psa.stack_model("P-885.51"), 60.0, [120.0, 0.0])
    expected = psa.simulate(held, [0.0, 1e-3], [60.0, 60.0]).displacement[-1]
    for name in ("held.csv", "held_cs.csv"):
        result = np.genfromtxt(made / name, delimiter=",", names=True)["displacement"]
        assert result == pytest.approx(expected, rel=1e-9)
    rows = np.loadtxt(made / "nanopositioner.csv", delimiter=",", skiprows=1)
    assert rows[-1, 0] == pytest.approx(0.01)


@slow
@pytest.mark.parametrize("made", ["fmpy"], indirect=True)
def test_the_shell_commands_of_fmpy(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (made / "voltage.csv").write_text(_script("fmpy", "voltage.csv").text, encoding="utf-8")
    for line in _script("fmpy", "run_fmpy.sh").text.splitlines():
        monkeypatch.setattr(sys, "argv", shlex.split(line))
        if "validate" in line:  # ends with the number of problems
            with pytest.raises(SystemExit, match=r"^0$"):
                fmpy.cli.main()
        else:
            fmpy.cli.main()
    two, three = (table(made / name)["displacement"] for name in ("out.csv", "out3.csv"))
    assert two.max() == pytest.approx(16e-6, rel=0.05)
    assert three[-1] == pytest.approx(two[-1], rel=1e-3)


@slow
def test_the_jobs_of_ci_are_yaml_and_their_commands_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """GitHub's actions excepted, and what the installation depends on."""
    (job,) = yaml.safe_load(_script("ci", "fmu.yml").text)["jobs"].values()
    assert job["runs-on"] == "ubuntu-latest"
    actions = [step["uses"] for step in job["steps"] if "uses" in step]
    assert all(re.fullmatch(r"actions/[a-z-]+@v\d+", a) for a in actions)
    commands = [c for step in job["steps"] for c in step.get("run", "").splitlines()]
    other = yaml.safe_load(_script("ci", "gitlab-ci.yml").text)
    assert set(other["fmu"]["script"]) <= set(commands)
    assert other["fmu"]["artifacts"]["reports"]["junit"] == "*.xml"
    assert job["steps"][0]["with"]["submodules"] is True
    monkeypatch.chdir(tmp_path)
    (tmp_path / "psa_casadi").symlink_to(ROOT)
    psa.save_model(psa.stack_model("demo"), "model.json")
    shutil.copy(ROOT / "psa_casadi" / "data" / "demo.csv", "record.csv")
    Path("judge.py").write_text(_script("ci", "judge.py").text, encoding="utf-8")
    for command in commands:
        program, *words = shlex.split(command)
        if program == "psa":
            run_command(command)
            continue
        if "install" in words:  # its build tools are here, its dependencies may be absent
            pytest.importorskip("pip")
            words += ["--dry-run", "--no-deps", "--no-build-isolation", "--no-index"]
        subprocess.run([sys.executable, *words], check=True, timeout=300)
    kept = {
        p.name for glob in job["steps"][-1]["with"]["path"].split() for p in tmp_path.glob(glob)
    }
    assert kept == {"stack.fmu", "stack3.fmu", "diagnosis.xml", "check.xml", "check3.xml"}
    psa.export_fmu(psa.stack_model("P-885.51"), "other.fmu")
    judge = [sys.executable, "judge.py", "model.json", "other.fmu"]
    statement = subprocess.run(judge, check=False, capture_output=True, text=True).stderr
    assert statement.endswith("ModelExchange differs by more than 0.1 % of the range\n")


def test_scripts_are_read_from_a_page() -> None:
    page = replace(examples()["fmpy"], text="# T\n```sh run.sh\na\nb\n```\n```console\n$ c\n```\n")
    assert page.scripts == (Script("sh", "run.sh", "a\nb\n"),)


def test_the_page_on_users_effects_has_every_balance() -> None:
    text = examples()["own_effect"].text
    rows = [f"| `{b.name}` | {b.unit} | {b.description} |" for b in BALANCES.values()]
    assert [row for row in rows if row not in text] == []


@slow
def test_a_users_effect_is_named_with_the_size_that_was_put_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for command in _shell(examples()["own_effect"]):
        if command.startswith("python "):
            subprocess.run([sys.executable, *shlex.split(command)[1:]], check=True)
        else:
            run_command(command)
    components = psa.load_effects("pickup")
    monkeypatch.delitem(sys.modules, "pickup")
    values = psa.load_model("extended.json", components.values()).values
    assert values["pickup_gain"] == pytest.approx(4e-9, rel=0.02)
    assert values["pickup_time"] == pytest.approx(0.05, rel=0.02)
    names = [v.name for v in read_model_description("stack.fmu").modelVariables]
    assert "pickup_gain" in names
    assert (tmp_path / "pickup.png").stat().st_size > 0
