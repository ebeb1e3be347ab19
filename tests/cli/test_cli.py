"""The version, and what goes on from the demonstration; `tests/contract` has the commands."""

import os
import re
import shlex
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import fromstring

import pytest
import typer
from rich.console import Console
from typer.testing import CliRunner

import psa_casadi as psa
from build_scripts.page_commands import block_in_tests, run_block
from psa_casadi.cli import screen
from psa_casadi.cli.app import app
from psa_casadi.cli.check import check_cases
from psa_casadi.cli.failures import junit_text
from psa_casadi.cli.screen import DIAGNOSE, IDENTIFY, Course, ProgressLine, show_table, working
from psa_casadi.examples.index import examples
from psa_casadi.export.check.rows import CheckRow
from psa_casadi.identification import identify
from psa_casadi.identification.fitting.fit import fit
from psa_casadi.records.split import whole
from psa_casadi.report.page import playground
from psa_casadi.report.words.tables import Table, effects_table
from tests.contract.helpers import PSA, command, done
from tests.identification.identified_plants import same_as_the_named_stack
from tests.records.record_files import HEADER, ROWS, write
from tests.report.report_cases import identification
from tests.tiers import slow


def test_the_version_is_one() -> None:
    assert done("--version").out == f"psa_casadi {psa.__version__}\n"
    root = Path(__file__).parents[2]
    citation = (root / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {psa.__version__}\n" in citation
    released = re.search(r"^date-released: (\S+)$", citation, re.MULTILINE)
    assert released is not None
    heading = f"\n## [{psa.__version__}] - {released[1]}\n"
    assert heading in (root / "CHANGELOG.md").read_text(encoding="utf-8")


@slow
@pytest.mark.xdist_group("demo")
def test_the_page_goes_on_from_the_demo_whose_stack_is_what_its_record_gives(
    tmp_path: Path,
) -> None:
    block = block_in_tests("docs/howto/fmu_export.md")
    assert shlex.split(block.commands[0]) == ["psa", "demo"]
    assert run_block(block, tmp_path) is None
    record = psa.read_record(tmp_path / "psa_demo" / "synthetic_record.csv")
    model = psa.load_model(tmp_path / "psa_demo" / "model.json")
    rms = fit(model, [whole(record)], [], sigma=[1e-3 * record.range_m]).rms
    same_as_the_named_stack(rms, record, "demo")


@pytest.mark.parametrize("way", [["--model"], []], ids=["option", "file alone"])
def test_the_playground_and_a_posterior_take_a_model(
    way: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, played = tmp_path / "model.json", []
    psa.save_model(psa.stack_model("demo"), file)
    monkeypatch.setattr(playground, "write_playground", lambda *inputs: played.append(inputs))
    assert command("web", *way, file, "-o", tmp_path / "p.html").code == 0
    ((path, model),) = played
    assert path == tmp_path / "p.html"
    assert model.values == psa.stack_model("demo").values
    twice = command("web", *way, file, file)
    assert twice.code == 2
    assert "is one file too many" in twice.words
    words: list[str | Path] = [*way, file, tmp_path / "absent.csv"]
    text = command("sample", *words).err
    assert text.startswith(f"Error: {tmp_path / 'absent.csv'}: there is no")
    without = command("sample", tmp_path / "absent.csv")
    assert "The model is missing; add --model MODEL.json" in without.err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["export", "fmu", "--stack", "demo", "-o", "a.csv"], "--output writes an FMU, .fmu"),
        (["export", "ssp", "--stack", "demo", "-o", "a.csv"], "--output writes an SSP archive"),
        (["linearize", "--stack", "demo", "--at", "voltage=nan"], "--at is 'voltage=nan'; give"),
        (["diagnose", "a.csv", "--model", "a.py:mak"], "one that does, as a.py:make."),
    ],
)
def test_mistakes_end_in_a_sentence_and_leave_files(
    words: list[str | Path], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    record = write(tmp_path / "a.csv", HEADER, *ROWS)
    before = record.read_bytes()
    write(tmp_path / "a.py", "def make(): ...", "def data(): ...")
    ended = command(*words)
    assert (ended.code, message in ended.words) == (2, True), ended.words
    assert record.read_bytes() == before


def test_an_identification_needs_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(identify, "identify", lambda *_, **__: identification())
    monkeypatch.chdir(tmp_path)
    record = write(tmp_path / "a.csv", HEADER, *ROWS)
    displayed = command("identify", record, "--stack", "P-885.51")
    assert displayed.code == 0, displayed.words
    assert "95 % interval" in displayed.out
    assert "written" not in displayed.out
    assert max(map(len, displayed.out.splitlines())) <= 80
    assert [p.name for p in tmp_path.iterdir()] == ["a.csv"]


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


def test_a_table_is_turned_where_only_so_its_words_are_whole() -> None:
    devices = tuple(f"device_{k}" for k in range(8))
    table = Table(("parameter", *devices), (("mass", *map(str, range(8))),))
    assert table.laid_out(100) is table
    lines = table.fitted(40).splitlines()
    assert [line.split() for line in lines[0:3:2]] == [["parameter", "mass"], ["device_0", "0"]]
    assert lines[-1].split() == ["device_7", "7"]
    assert table.laid_out(10) is table  # it is too narrow either way


@pytest.mark.parametrize("terminal", [False, True])
def test_a_table_on_a_terminal_is_neither_cut_nor_too_wide(
    terminal: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: terminal)
    monkeypatch.setenv("COLUMNS", "80")
    show_table(effects_table(psa.EFFECTS.values()))
    lines = re.sub(r"\x1b\[[\d;]*m", "", capsys.readouterr().out).splitlines()
    assert max(len(line.rstrip()) for line in lines) <= 80
    words = {word for line in lines for word in line.split()}
    assert set(psa.EFFECTS) <= words
    assert {w for e in psa.EFFECTS.values() for w in e.looks_like.split()} <= words


def cases_of(text: str) -> dict[str, str | None]:
    """Return each case of a file with its failure."""
    failures = ((c.attrib["name"], c.find("failure")) for c in fromstring(text).iter("testcase"))
    return {name: None if f is None else f.attrib["message"] for name, f in failures}


def test_the_checks_of_an_fmu_are_tests() -> None:
    rows = (
        CheckRow("calls", 0.0, 0.0, True, ""),
        CheckRow("agreement", 3e-3, 1e-4, False, 'at "0.1 s" & <\x1b>'),
        CheckRow("states", float("nan"), 0.0, False, "the check stopped"),
    )
    report = psa.CheckReport(Path("a.fmu"), rows, compared=True)
    text = junit_text("check", "a.fmu", check_cases(report), 1.0)
    whole = fromstring(text)
    counts = {"name": "psa check a.fmu", "tests": "3", "failures": "2", "errors": "0"}
    assert whole.attrib == {**counts, "time": "1.000"}
    assert {c.attrib["classname"] for c in whole.iter("testcase")} == {"psa.check.a.fmu"}
    assert next(c.text for c in whole.iter("system-out")) == "found 0, allowed 0"
    assert cases_of(text) == {
        "calls": None,
        "agreement": 'found 0.00300, allowed 1.00e-4: at "0.1 s" & <\ufffd>',
        "states": "found not finite, allowed 0: the check stopped",
    }


SOURCE = Path(screen.__file__).parents[1]


class Clock:
    """A clock that shows the time it is set to."""

    now = 0.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    result = Clock()
    monkeypatch.setattr(screen, "clock", result)
    return result


def test_a_line_states_step_time_and_what_is_usual(clock: Clock) -> None:
    output = ProgressLine("diagnosing", DIAGNOSE)
    assert output.line() == "diagnosing, 0 s (most take up to 40 s)"
    clock.now = 7.4
    output.update("screening effects")
    step = "diagnosing, step 3 of 6 (screening the effects)"
    assert output.line() == f"{step}, 7 s (most take up to 40 s): screening effects"
    clock.now = 130.0
    output.update("base fit from zero")  # parts of the work come again; the step does not go back
    assert output.line() == f"{step}, 2 min (longer than most: 40 s): base fit from zero"
    assert output.line(drawn=False) == output.line()
    console = Console(width=200)
    with console.capture() as displayed:
        console.print(output)
    assert displayed.get().strip() == output.line()


def test_lines_that_stay_state_once_what_is_usual(
    clock: Clock, capsys: pytest.CaptureFixture[str]
) -> None:
    with working("diagnosing", DIAGNOSE) as progress:
        clock.now = 3.0
        progress("screening effects")
        clock.now = 41.0
        progress("judging")
    first, early, late = capsys.readouterr().err.splitlines()
    assert first == "diagnosing (most take up to 40 s) ..."
    assert early == "  diagnosing, step 3 of 6 (screening the effects), 3 s: screening effects"
    assert "(longer than most: 40 s)" in late


@pytest.mark.parametrize(
    ("course", "rooms"),
    [
        (IDENTIFY, ["identification/**/*.py"]),
        (DIAGNOSE, ["identification/search.py", "diagnosis/**/*.py"]),
    ],
)
def test_every_message_of_progress_belongs_to_a_step(course: Course, rooms: list[str]) -> None:
    texts = [p.read_text("utf-8") for r in rooms for p in SOURCE.glob(r)]
    result = {m for t in texts for m in re.findall(r'progress\(f?"([^"{]{3,})', t)}
    assert len(result) > 5
    unknown = {output for output in result if not course.step_of(output)}
    assert not unknown


def commands(item: Any, *path: str) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield a command of click, which some versions of typer vendor."""
    yield path, item
    for name, inner in getattr(item, "commands", {}).items():
        yield from commands(inner, *path, name)


EVERY = dict(commands(typer.main.get_command(app)))


def written(item: Any) -> list[str]:
    """Return the texts of a command's help, with single spaces."""
    displayed = (p for p in item.params if not getattr(p, "hidden", False))
    texts = [item.help, item.epilog, *(getattr(p, "help", None) for p in displayed)]
    return [" ".join(text.replace("\b", "").split()) for text in texts if text]


@pytest.mark.parametrize("path", EVERY, ids=" ".join)
def test_the_help_shows_its_texts_whole_in_80_columns(path: tuple[str, ...]) -> None:
    displayed = CliRunner().invoke(app, [*path, "--help"], env={"COLUMNS": "80"}).output
    joined = " ".join(displayed.split())
    assert "\\" not in displayed
    assert [text for text in written(EVERY[path]) if text not in joined] == []
    assert [p.name for p in EVERY[path].params if not getattr(p, "help", "")] == []
    lines = [line.strip() for line in displayed.splitlines()]
    if not hasattr(EVERY[path], "commands"):
        (example,) = (line for line in lines if line.startswith("Example: "))
        assert example.startswith(f"Example: psa {' '.join(path)} ")
        assert f"\b\n{example}" == EVERY[path].epilog
    assert [line for line in lines if len(line) > 78 and "Example: " not in line] == []
    assert [line for line in lines if line.endswith("...") and "Usage: " not in line] == []


@pytest.mark.parametrize(
    ("line", "names"),
    [
        ("psa stacks ", psa.STACKS),
        ("psa simulate --stack P", ["P-885.51", "PTBS200"]),
        ("psa effects slow", ["slow_creep"]),
        ("psa diagnose a.csv --leave-out ", psa.EFFECTS),
        ("psa design experiment --separate sensor_r", ["sensor_ripple"]),
        ("psa export fmu --part ", psa.PARTS),
        ("psa datasets steering_mirror_", ["steering_mirror_test"]),
        ("psa examples use_in_", [n for n in examples() if n.startswith("use_in_")]),
        ("psa diagnose a.csv --expect adequate,cau", ["adequate,cause_named"]),
    ],
)
def test_a_shell_completes_the_names_that_there_are(line: str, names: Any) -> None:
    table = {"_PSA_COMPLETE": "complete_bash", "COMP_WORDS": line}
    table["COMP_CWORD"] = str(line.count(" "))
    displayed = subprocess.run(
        PSA, env=os.environ | table, capture_output=True, text=True, check=True
    )
    assert set(displayed.stdout.split()) == set(names)
