"""What CI asks of a command: expected verdicts, a largest error, files of tests."""

import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest
from typer.testing import CliRunner, Result

from psa_casadi.cli.app import app
from psa_casadi.diagnosis import diagnose
from psa_casadi.export.check.check import CheckReport, CheckRow
from psa_casadi.report.documents.junit import check_cases, junit_text
from tests.record_files import HEADER, ROWS, write
from tests.report_cases import diagnosis

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


def run(*words: str | Path) -> Result:
    return CliRunner().invoke(app, [str(w) for w in words])


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
    result = run(*asked, *options, "--junit", file)
    assert result.exit_code == bool(wrong), result.output
    assert result.output == (f"Not as expected: {wrong}\n" if wrong else "")
    cases = cases_of(file.read_text(encoding="utf-8"))
    assert list(cases) == ["verdict", "held-out error"]
    assert [f for f in cases.values() if f] == [wrong] * bool(wrong)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--expect", "cause_name"), "'cause_name' is no verdict; is 'cause_named' meant? there"),
        (("--expect", "good"), "there are adequate, cause_named, partly_explained, ambiguous,"),
        (("--expect", ","), "--expect names no verdict"),
        (("--max-error", "0.5"), "give a positive percentage of the range, as 0.5%"),
        (("--max-error", "-1%"), "give a positive percentage"),
        (("--max-error", "nan%"), "give a positive percentage"),
        (("--junit", "a.csv/x"), "a.csv"),
    ],
)
def test_what_cannot_be_expected_is_refused(
    asked: list[str | Path], options: tuple[str, ...], said: str
) -> None:
    result = run(*asked, *options)
    assert result.exit_code == 2
    assert said in result.output


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
