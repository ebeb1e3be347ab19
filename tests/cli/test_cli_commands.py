"""Single commands: stacks, models, what CI asks, the mechanism, and what is said of mistakes."""

import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest

from psa_casadi.cli.screen import show_table
from psa_casadi.diagnosis import diagnose
from psa_casadi.effects import EFFECTS
from psa_casadi.export.check.check import CheckReport, CheckRow
from psa_casadi.identification import identify
from psa_casadi.model.model_file import save_model
from psa_casadi.model.stacks import stack_model
from psa_casadi.report.documents.junit import check_cases, junit_text
from psa_casadi.report.page import playground
from psa_casadi.report.words.tables import Table, effects_table
from tests.cli.test_cli import psa
from tests.records.record_files import HEADER, ROWS, write
from tests.report.report_cases import diagnosis, identification


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


#: Elements of Jenkins' schema of JUnit files that we write: attributes (* must be), what is inside.
JUNIT: dict[str, tuple[set[str], set[str]]] = {
    "testsuites": ({"name", "time", "tests", "failures", "disabled", "errors"}, {"testsuite"}),
    "testsuite": (
        {"name*", "tests*", "failures", "errors", "time", "disabled", "skipped", "timestamp",
         "hostname", "id", "package"},
        {"properties", "testcase", "system-out", "system-err"},
    ),
    "testcase": (
        {"name*", "assertions", "time", "classname", "status"},
        {"skipped", "error", "failure", "system-out", "system-err"},
    ),
    "failure": ({"type", "message"}, set()),
    "system-out": (set(), set()),
}  # fmt: skip


def cases_of(text: str) -> dict[str, str | None]:
    """Check a file against the schema and its own counts; return each case with its failure."""
    root = ElementTree.fromstring(text)
    assert root.tag == "testsuites"
    for element in root.iter():
        attributes, inside = JUNIT[element.tag]
        assert set(element.attrib) <= {a.strip("*") for a in attributes}
        assert {a[:-1] for a in attributes if a.endswith("*")} <= set(element.attrib)
        assert {inner.tag for inner in element} <= inside
        for count in ("tests", "failures", "errors", "skipped"):
            assert re.fullmatch(r"\d+", element.get(count, "0"))
        if element.tag.startswith("testsuite"):
            assert int(element.attrib["tests"]) == len(list(element.iter("testcase")))
            assert int(element.attrib["failures"]) == len(list(element.iter("failure")))
            assert float(element.attrib["time"]) >= 0.0
    failures = ((c.attrib["name"], c.find("failure")) for c in root.iter("testcase"))
    return {name: None if f is None else f.attrib["message"] for name, f in failures}


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str | Path]:
    """The command on a record whose diagnosis is known: its cause is named, 0.5 % is left."""
    known = diagnosis("cause_named")
    known = replace(
        known, extended_errors=replace(known.extended_errors, holdout_nrmse_percent=0.5)
    )
    monkeypatch.setattr(diagnose, "diagnose", lambda *_, **__: known)
    return ["diagnose", write(tmp_path / "a.csv", HEADER, *ROWS), "--quiet"]


@pytest.mark.parametrize(
    ("options", "wrong"),
    [
        ((), ""),
        (("--expect", "adequate,cause_named", "--max-error", "0.5%"), ""),
        (("--expect", "Cause named", "--max-error", "1 %"), ""),
        (
            ("--expect", "adequate,unexplained"),
            "The verdict is cause_named; expected adequate or unexplained.",
        ),
        (
            ("--max-error", ".4%"),
            "The extended model's held-out error is 0.500 % of the range; expected 0.4 % at most.",
        ),
    ],
)
def test_a_result_that_is_not_as_expected_ends_with_1(
    asked: list[str | Path], options: tuple[str, ...], wrong: str, tmp_path: Path
) -> None:
    file = tmp_path / "tests.xml"
    result = psa(*asked, *options, "--junit", file)
    assert result.exit_code == bool(wrong), result.output
    assert result.output == (f"Not as expected: {wrong}\n" if wrong else "")
    cases = cases_of(file.read_text(encoding="utf-8"))
    assert list(cases) == ["verdict", "held-out error"]
    assert [f for f in cases.values() if f] == [wrong] * bool(wrong)


def test_the_checks_of_an_fmu_are_tests() -> None:
    rows = (
        CheckRow("calls", 0.0, 0.0, True, ""),
        CheckRow("agreement", 3e-3, 1e-4, False, 'at "0.1 s" & <\x1b>'),
        CheckRow("states", float("nan"), 0.0, False, "the check stopped"),
    )
    report = CheckReport(Path("a.fmu"), rows, compared=True)
    text = junit_text("check", "a.fmu", check_cases(report), 1.0)
    assert cases_of(text) == {
        "calls": None,
        "agreement": 'found 0.00300, allowed 1.00e-4: at "0.1 s" & <\ufffd>',
        "states": "found not finite, allowed 0: the check stopped",
    }
