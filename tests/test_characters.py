"""Characters that XML, HTML and UTF-8 cannot carry: refused wherever a file would hold them."""

import os
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

import psa_casadi as psa
from psa_casadi.cli.screen import show_table
from psa_casadi.common.characters import check_text, plain, visible
from psa_casadi.common.files import atomic_write
from psa_casadi.export.common.parameter_sets import parameter_set
from psa_casadi.export.fmu.description import model_description
from psa_casadi.export.fmu.documentation import documentation
from psa_casadi.export.modelica.package import modelica_text
from psa_casadi.report.page.document import render
from psa_casadi.report.words.tables import Table
from tests.contract.helpers import command
from tests.records.record_files import HEADER, ROWS, write

BARRED = ("\0", "\x0b", "\x1b", "\ud800", "\ufffe", "\uffff")
CARRIED = "\t\n\r <&>\"' ]]> \x7f\x85 µ \ud7ff\ue000\ufffd \U0001f600"

WRITERS: dict[str, Callable[[psa.Model], str]] = {
    "FMI 2": lambda m: model_description(m, "stack", "{0}", ["a.c"]),
    "FMI 3": lambda m: model_description(m, "stack", "{0}", ["a.c"], 3),
    "page": documentation,
    "parameters": parameter_set,
    "Modelica": modelica_text,
}


def described(text: str, name: str = "odd_gain") -> psa.Model:
    """A stack with a text in its description, its notes and the description of a parameter."""
    odd = psa.Component(
        "odd", f"an effect {text}", "none",
        lambda s: psa.Equations(add={"displacement": getattr(s, name) * s.u}), gain=name,
        parameters=(psa.Parameter(name, 0.0, "m/V", (-1.0, 1.0), f"a gain {text}"),),
    )  # fmt: skip
    model = replace(psa.compose((*psa.BASE, odd)), name="stack", description=f"a stack {text}")
    return replace(model, provenance=replace(model.provenance, notes=(f"a note {text}",)))


@pytest.mark.parametrize("character", BARRED, ids=ascii)
def test_what_no_document_can_carry_is_reported(character: str) -> None:
    with pytest.raises(psa.InputError) as caught:
        check_text(f"{'b' * 100}x{character}y", "The page")
    (problem,) = caught.value.problems
    assert problem.startswith(f"The page has the character U+{ord(character):04X} after 'bbb")
    assert "bbbx', which no document can carry; remove it from the names" in problem
    assert plain(f"x{character}y") == "x\ufffdy"


@pytest.mark.parametrize("writer", WRITERS)
def test_every_writer_refuses_what_a_document_cannot_carry(writer: str) -> None:
    with pytest.raises(psa.InputError, match=r"has the character U\+001B after '.*x', which no"):
        WRITERS[writer](described("x\x1by"))


@pytest.mark.parametrize("writer", WRITERS)
def test_what_a_document_can_carry_is_written(writer: str) -> None:
    text = WRITERS[writer](described(CARRIED))
    assert text.encode()
    if text.startswith("<?xml"):
        values = [v for e in ET.fromstring(text).iter() for v in e.attrib.values()]
        assert any(f"a gain {CARRIED}" in v for v in values)


def test_no_fmu_and_no_system_is_left_of_a_refused_model(tmp_path: Path) -> None:
    wrong = replace(psa.stack_model("demo"), name="stack", description="a\0b")
    with pytest.raises(psa.InputError, match=r"U\+0000"):
        psa.export_fmu(wrong, tmp_path / "a.fmu")
    system = psa.nanopositioner()
    with pytest.raises(psa.InputError, match=r"U\+000B"):
        psa.export_ssp(replace(system, name="a\x0bb"), tmp_path / "a.ssp")
    assert not os.listdir(tmp_path)


@pytest.mark.parametrize("name", ['a"b', "a\\b", "a\nb", "a\0"])
def test_a_name_that_c_would_read_otherwise_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(psa.InputError) as caught:
        psa.export_fmu(described("", name), tmp_path / "a.fmu")
    assert f"is named {name!r}; quotes, backslashes and control" in str(caught.value)


def test_a_text_that_is_no_utf_8_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(psa.InputError, match=r"cannot write, the text has the character U\+DC80"):
        atomic_write(tmp_path / "a.txt", "a\udc80")
    assert not os.listdir(tmp_path)


@pytest.mark.skipif(sys.platform != "linux", reason="names of files are bytes on Linux only")
def test_the_name_of_a_file_may_be_any_bytes(tmp_path: Path) -> None:
    path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/rig\xe9\x01.csv"))
    record = psa.read_record(write(path, HEADER, *ROWS))
    assert record.name == "rig\ufffd\ufffd"


def test_a_page_shows_a_mark_for_what_html_cannot_carry() -> None:
    page = render("base.html", "a\0b")
    assert "\0" not in page
    assert "<title>a\ufffdb</title>" in page
    assert plain(CARRIED) == CARRIED


def test_what_a_terminal_would_obey_is_spelled_out() -> None:
    raw, spelled = "a\x1b[31mb\r\x07\x9b2J\x7f\u202e.csv", r"a\x1b[31mb\r\x07\x9b2J\x7f\u202e.csv"
    assert visible(raw) == spelled
    assert visible("5 µm\n\tü \U0001f600 \\x1b") == "5 µm\n\tü \U0001f600 \\x1b"


@pytest.mark.parametrize("name", ["identify", "diagnose", "check"])
def test_no_name_of_a_file_or_a_column_reaches_the_terminal_raw(name: str, tmp_path: Path) -> None:
    path = write(tmp_path / "\x1b]0;title\x07.csv", "t\x1b[31m [s],U\x9b2J,\u202ex", *ROWS)
    written = () if name == "check" else ("-o", tmp_path / "m.json")
    report = command(name, path, *written)
    assert report.code == 2
    assert "\\x1b]0;title\\x07.csv" in report.err
    assert all(c.isprintable() or c == "\n" for c in report.out + report.err)


@pytest.mark.parametrize("terminal", [False, True])
def test_no_cell_of_a_table_reaches_the_terminal_raw(
    terminal: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: terminal)
    show_table(Table(("name",), (("\x1b[2Jowned",),)))
    text = capsys.readouterr().out
    assert "\\x1b[2Jowned" in text
    assert "\x1b[2J" not in text
