"""Named stacks from the command line and from Python."""

import re
from pathlib import Path

import fmpy
import numpy as np
import pytest
from typer.testing import CliRunner, Result

import psa_casadi
from psa_casadi.cli.app import app
from psa_casadi.cli.screen import show_table
from psa_casadi.effects import EFFECTS
from psa_casadi.errors import InputError
from psa_casadi.identification import identify
from psa_casadi.model.model_file import save_model
from psa_casadi.model.stacks import STACKS, stack_model
from psa_casadi.records import read_record, sine, time_grid, write_record
from psa_casadi.report.page import playground
from psa_casadi.report.words.tables import Table, effects_table
from psa_casadi.simulation.simulate import simulate_record
from tests.record_files import HEADER, ROWS, write
from tests.report_cases import identification
from tests.test_schemas import valid
from tests.tiers import slow


def psa(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(a) for a in arguments])


@pytest.fixture
def planned(tmp_path: Path) -> Path:
    path, time = tmp_path / "planned.csv", time_grid(0.1, 1e-3)
    write_record(path, {"time [s]": time, "voltage [V]": sine(time, 0.0, 80.0, 20.0)})
    return path


@pytest.mark.parametrize("name", sorted(STACKS))
def test_every_figure_of_a_stack_is_shown_with_its_source(name: str) -> None:
    shown = psa("stacks", name)
    assert shown.exit_code == 0
    head, table = shown.stdout.split("\n\n")
    assert " ".join(head.split()) == f"{name}: {STACKS[name].description}"
    assert max(map(len, shown.stdout.splitlines())) <= 80
    source = table.splitlines()[0].index("source")
    rows = re.split(r"\n(?=\S)", table)[2:]
    assert len(rows) == len(STACKS[name].values)
    for row in rows:
        lines = row.splitlines()
        figure = STACKS[name].values[lines[0].split()[0]]
        assert " ".join(line[source:] for line in lines).split() == figure.source.split()
        assert (" assumed " in lines[0][:source]) == figure.assumed


def test_stacks_are_listed() -> None:
    listed = psa("stacks").stdout
    for name, stack in STACKS.items():
        line = re.search(rf"^{re.escape(name)} .*$", listed, re.MULTILINE)
        assert line is not None
        assert f"{len(stack.assumed)} of 19" in line[0]
    assert psa("stacks", "--quiet").stdout.split() == list(STACKS)
    assert psa("stacks", "demo", "--quiet").stdout == "demo\n"


def test_simulate_takes_a_stack(planned: Path, tmp_path: Path) -> None:
    out = tmp_path / "motion.csv"
    done = psa("simulate", "--stack", "P-885.51", "--input", planned, "-o", out)
    assert done.exit_code == 0, done.output
    record = read_record(planned, need_displacement=False)
    expected = simulate_record(stack_model("P-885.51"), record).displacement
    found = read_record(out).displacement
    assert found is not None
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-18)
    assert 10e-6 < np.ptp(found) < 13e-6


@slow
def test_export_takes_a_stack_and_the_fmu_passes_its_check(tmp_path: Path) -> None:
    fmu = tmp_path / "p.fmu"
    done = psa("export", "fmu", "--stack", "P-885.51", "-o", fmu)
    assert done.exit_code == 0, done.output
    description = fmpy.read_model_description(str(fmu))
    assert description.modelName == "P_885_51"
    start = {v.name: v.start for v in description.modelVariables}
    assert float(start["k_B"]) == STACKS["P-885.51"].values["k_B"].value
    assert psa("check", fmu, "--json", tmp_path / "check.json").exit_code == 0
    content = valid("check", (tmp_path / "check.json").read_text())
    assert (content["passed"], content["compared"]) == (True, True)
    assert "equations" in {row["name"] for row in content["rows"]}


@slow
def test_model_files_and_fmus_are_also_named_by_text(tmp_path: Path) -> None:
    path, fmu = str(tmp_path / "model.json"), str(tmp_path / "stack.fmu")
    psa_casadi.save_model(stack_model("PTBS200"), path)
    model = psa_casadi.load_model(path)
    assert model.values == stack_model("PTBS200").values
    assert "16 of its 19 figures are assumed" in model.provenance.notes[0]
    assert psa_casadi.export_fmu(model, fmu) == Path(fmu)
    report = psa_casadi.check_fmu(fmu, model)
    assert (report.path, report.passed) == (Path(fmu), True)


def test_a_wrong_choice_of_model_is_one_sentence(planned: Path, tmp_path: Path) -> None:
    fmu = tmp_path / "x.fmu"
    commands = (
        ("simulate", "--input", planned, "-o", tmp_path / "y.csv"),
        ("export", "fmu", "-o", fmu),
    )
    for command in commands:
        for choice, expected in (
            ((), "No model is given; add --model MODEL.json, or --stack NAME"),
            (("--stack", "p885"), "did you mean P-885.51?"),
            (("--stack", "xyzzy"), "there are PTBS200, WYDS0808020"),
            (("--stack", "demo", "--model", tmp_path / "m.json"), "are both given"),
        ):
            result = psa(*command, *choice)
            assert result.exit_code == 2
            assert expected in result.stderr
            assert len(result.stderr.splitlines()) == 1
    assert psa("stacks", "xyzzy").exit_code == 2
    assert list(tmp_path.iterdir()) == [planned]
    with pytest.raises(InputError, match="no stack named"):
        stack_model("PTBS2")


@pytest.mark.parametrize("way", [["--model"], []], ids=["option", "file alone"])
def test_the_playground_and_a_posterior_take_a_model(
    way: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, played = tmp_path / "model.json", []
    save_model(stack_model("demo"), file)
    monkeypatch.setattr(playground, "write_playground", lambda *given: played.append(given))
    assert psa("web", *way, file, "-o", tmp_path / "p.html").exit_code == 0
    ((path, model),) = played
    assert path == tmp_path / "p.html"
    assert model.values == stack_model("demo").values
    twice = psa("web", *way, file, file)
    assert twice.exit_code == 2
    assert "is one file too many" in twice.output
    words: list[str | Path] = [*way, file, tmp_path / "absent.csv"]
    assert psa("sample", *words).stderr.startswith(f"Error: {tmp_path / 'absent.csv'}: there is no")
    without = psa("sample", tmp_path / "absent.csv")
    assert "No model is given; add --model MODEL.json" in without.stderr


def test_an_identification_needs_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(identify, "identify", lambda *_, **__: identification())
    monkeypatch.chdir(tmp_path)
    record = write(tmp_path / "a.csv", HEADER, *ROWS)
    shown = psa("identify", record, "--stack", "P-885.51")
    assert shown.exit_code == 0, shown.output
    assert "95 % interval" in shown.stdout
    assert "written" not in shown.stdout
    assert max(map(len, shown.stdout.splitlines())) <= 80
    assert [p.name for p in tmp_path.iterdir()] == ["a.csv"]


def test_one_model_at_most_and_one_directory(tmp_path: Path) -> None:
    record = write(tmp_path / "a.csv", HEADER, *ROWS)
    both = psa("diagnose", record, "--stack", "demo", "--model", tmp_path / "m.json")
    assert "--model and --stack are both given; leave one of them out." in both.output
    two = psa("demo", tmp_path / "a", "-o", tmp_path / "b")
    assert two.exit_code == 2
    assert "name two directories" in two.output


@pytest.mark.parametrize("width", [1, 8, 20, 26, 30, 80])
def test_a_table_has_the_width_that_there_is(width: int) -> None:
    table = Table(("name", "what it is"), (("a_long_name", "it goes on and on and on"), ("b", "")))
    lines = table.fitted(width).splitlines()
    # a column has one character at least, and two spaces part it from the next
    assert max(map(len, lines)) <= max(width, 4)
    if width >= 20:  # the longest words are whole
        words = (w for line in lines for w in line.split() if "--" not in w)
        whole = " ".join((*table.head, *(cell for row in table.rows for cell in row)))
        assert sorted(words) == sorted(whole.split())
    if width == 80:
        assert str(table).splitlines() == lines
        assert lines[2] == "a_long_name  it goes on and on and on"


@pytest.mark.parametrize("terminal", [False, True])
def test_a_table_on_a_terminal_is_neither_cut_nor_too_wide(
    terminal: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: terminal)
    monkeypatch.setenv("COLUMNS", "80")
    show_table(effects_table(EFFECTS.values()))
    lines = re.sub(r"\x1b\[[\d;]*m", "", capsys.readouterr().out).splitlines()
    assert max(len(line.rstrip()) for line in lines) <= 80
    words = {word for line in lines for word in line.split()}
    assert set(EFFECTS) <= words
    assert {w for e in EFFECTS.values() for w in e.looks_like.split()} <= words
