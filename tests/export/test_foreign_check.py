"""`psa check` of FMUs of other tools: each fault of a small one fails its row alone."""

import json
from functools import cache
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

import psa_casadi as psa
from tests.contract.helpers import command
from tests.export.fmu_models import rewritten
from tests.export.supplied import compiled_fmu, supplied
from tests.tiers import slow_but

#: The row that each fault fails, and its remark.
FAULTS = {
    1: ("start values", "'k' starts at 2.5, its description has 2"),
    2: ("values are taken", "'k' was set to 2.02 and is 2"),
    3: ("life cycle", "after a reset it gives other results"),
    4: ("several instances", "two instances disturb each other in step 1"),
    5: ("memory", "bytes left by each of 1000 cycles"),
    6: ("state saved", "a state that is restored replays"),
    7: ("derivatives", "that of 'der(x)' is"),
    8: ("dependencies", "'y' depends on 'u', which is not declared"),
    9: ("step sizes", "fmi2DoStep returned status 3"),
    10: ("description valid", "InitialUnknowns"),
    11: ("instances", "the FMU gives no instance"),
    12: ("inputs at events", "'u' was set to 0.1 at an event and is 0"),
}
#: What else a fault does.
_ALSO = {4: {"life cycle", "state saved"}}


@cache
def faulty(number: int, lines: str = "false") -> Path:
    """Return the FMU with a fault, 0 for none, that takes `lines` as inputs or does not say so."""
    initial = "" if number == 10 else '<Unknown index="4"/>'
    known = "1" if number == 8 else "1 3"
    flag = f"-DFAULT={number}"
    return compiled_fmu("faulty/filter.c", flag, known=known, initial=initial, lines=lines)


def test_an_fmu_without_a_fault_passes() -> None:
    report = psa.check_fmu(faulty(0))
    assert report.foreign
    assert [(r.name, r.remark) for r in report.failures] == []
    assert {r.clause.partition(",")[0] for r in report.rows if r.clause} == {"FMI 2.0"}
    notes = {r.name for r in report.rows if r.noted}
    assert {"units defined", "speed", "step sizes"} <= notes <= {
        "units defined", "speed", "step sizes", "memory", "same bits again",
    }  # fmt: skip


def test_the_unit_of_a_type_must_be_defined(tmp_path: Path) -> None:
    typed = b'<TypeDefinitions><SimpleType name="t"><Real unit="ell"/></SimpleType>'
    typed += b"</TypeDefinitions><ModelVariables>"
    changes = {"modelDescription.xml": lambda text: text.replace(b"<ModelVariables>", typed)}
    rows = psa.check_fmu(rewritten(faulty(0), tmp_path / "a.fmu", changes)).failures
    remarks = {r.name: r.remark for r in rows}
    assert remarks["units defined"].startswith("the unit 'ell' is not defined")


@pytest.mark.parametrize("number", slow_but([1, 8], FAULTS))
def test_each_fault_fails_its_row(number: int) -> None:
    rows = {r.name: r for r in psa.check_fmu(faulty(number)).failures}
    name, remark = FAULTS[number]
    assert remark in rows[name].remark
    if number != 11:  # without an instance no other row can pass
        assert set(rows) <= {name} | _ALSO.get(number, set())


def test_the_command_writes_the_clauses(tmp_path: Path) -> None:
    json_file, junit = tmp_path / "check.json", tmp_path / "check.xml"
    ended = command("check", faulty(8), "--json", json_file, "--junit", junit)
    assert ended.code == 1
    assert "FMI 2.0, 2.2.8" in ended.out
    assert "did not pass: dependencies. It was checked by the standard" in ended.words
    rows = {r["name"]: r for r in json.loads(json_file.read_text("utf-8"))["rows"]}
    assert (rows["dependencies"]["clause"], rows["speed"]["noted"]) == ("FMI 2.0, 2.2.8", True)
    cases = ET.parse(junit).getroot().iter("testcase")
    assert [c.get("name") for c in cases if c.find("failure") is not None] == ["dependencies"]


def test_what_a_tool_s_fmus_lack_is_reported() -> None:
    tank = {r.name for r in psa.check_fmu(supplied("tank")).failures}
    assert tank <= {"description valid", "memory"}  # PythonFMU 0.7: no initial unknowns, a leak
    assert psa.check_fmu(supplied("ball")).passed


def test_one_of_ours_is_checked_so_on_request(tmp_path: Path) -> None:
    path = psa.export_fmu(psa.stack_model("P-885.51"), tmp_path / "stack.fmu", fmi=3)
    report = psa.check_fmu(path, foreign=True)
    assert [(r.name, r.remark) for r in report.failures] == []
    assert not psa.check_fmu(path).foreign
