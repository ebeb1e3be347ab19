"""The origin that every page states, its shared arrays, and the sentences of notes."""

import ast
import base64
import gzip
import hashlib
import re
from pathlib import Path

import pytest
from jinja2 import meta, nodes
from plotly.offline import get_plotlyjs

import psa_casadi
import psa_casadi as psa
from psa_casadi.common.notes import note
from psa_casadi.common.progress import typed
from psa_casadi.report.page.designs import write_design_page
from psa_casadi.report.words.catalogue import CATALOGUE, TABLES
from tests.report.html_page import Page, written
from tests.report.report_cases import diagnosis, identification


def test_every_page_states_date_version_command_and_the_records_hashes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1790000000")
    token = typed.set("psa diagnose 'my record.csv'")
    try:
        d, result = diagnosis("cause_named"), identification()
        paths = [tmp_path / f"{k}.html" for k in range(3)]
        psa.write_report(d, paths[0], still=True)
        psa.write_fit_report(result, paths[1], still=True)
        write_design_page(paths[2], title="A design", summary=["It moves."])
    finally:
        typed.reset(token)
    for path in paths:
        text = Page(path.read_text(encoding="utf-8")).text
        assert f"Written 2026-09-21 14:13 UTC by psa_casadi {psa.__version__}." in text
        assert "Command: psa diagnose 'my record.csv'" in text
    for path, experiments in zip(paths, (d.experiments, result.experiments), strict=False):
        for e in experiments:
            assert e.record.sha256 in path.read_text(encoding="utf-8")


def test_the_library_and_each_curve_are_there_once(tmp_path: Path) -> None:
    text, _ = written(diagnosis("cause_named"), tmp_path)
    held = re.findall(r'<script type="application/gzip" id="(\w+)">(.*?)</script>', text)
    assert [name for name, _ in held] == ["arrays", "library"]
    arrays, library = (gzip.decompress(base64.b64decode(data)).decode() for _, data in held)
    assert library == get_plotlyjs()  # the version of the installed plotly
    rows = arrays.split(" ")
    assert len(rows) == len(set(rows))
    long = [row for row in rows if len(row) == 1500 * 4 * 4 // 3]
    assert len(long) == 7  # time, voltage, measured, two models and their residuals
    digest = base64.b64encode(hashlib.sha256(library.encode()).digest()).decode()
    assert f"'sha256-{digest}'" in text.split("Content-Security-Policy", 1)[1].split(">", 1)[0]
    assert text.count("Displacement, and residual") == 0
    assert "at the top of the page" in text


def _notes_in_code() -> list[tuple[str, set[str]]]:
    """Return the code and the names of the values of every note in the package."""
    items = []
    for path in Path(psa_casadi.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "note":
                names = {k.arg for k in node.keywords if k.arg}
                codes = [c for c in ast.walk(node.args[0]) if isinstance(c, ast.Constant)]
                items += [(c.value, names) for c in codes if isinstance(c.value, str)]
    return items


def _requested(template: str) -> set[str]:
    """Return the names of the values that a sentence takes, with those of its parts and ending."""
    table, _, code = template.partition(".")
    tree = CATALOGUE.parse(TABLES[table][code])
    ending = [f"ending.{code}"] if table == "note" and code in TABLES["ending"] else []
    parts: list[str] = []
    for part in meta.find_referenced_templates(tree):  # None: those of the table with its name
        parts += [f"{code}.{each}" for each in TABLES[code]] if part is None else [part]
    assigned = {name.name for name in tree.find_all(nodes.Name) if name.ctx == "store"}
    of_parts = set[str]().union(*map(_requested, parts)) - assigned
    names = meta.find_undeclared_variables(tree) - {"infinity"}
    return names.union(of_parts, *map(_requested, ending))


def test_every_note_has_a_sentence_that_takes_its_values() -> None:
    statement = _notes_in_code()
    assert len(statement) > 40
    for code, names in statement:
        unused = {"smallest"} if code == "blind" else set()  # it has the values of "blind_spot"
        assert _requested(f"note.{code}") == names - unused, code


def test_every_sentence_can_be_read() -> None:
    for template in CATALOGUE.list_templates():
        CATALOGUE.get_template(template)


def test_values_have_their_units_and_names_stand_in_a_row() -> None:
    assert str(note("noise_repeats", apart=(0.02, "s"))).endswith("returns after 20 ms")
    assert str(note("little", least=0.7, more=True)) == "that is less than 70 % and much remains"
    assert str(note("little", least=0.05, more=False)) == "that is less than 5 %"
    statement = str(note("vague", names=("a", "b"), why=note("no_such_voltage")))
    assert statement.startswith("a, b: in the extended model and not named: no stack bears")
    assert str(note("same_curve", effects=("a", "b", "c"))).startswith("a and b and c bend")


def test_a_code_without_a_sentence_is_an_error() -> None:
    with pytest.raises(LookupError):
        str(note("nothing of the kind"))


EVIDENCE = Path(__file__).parents[2] / "docs" / "evidence.md"


def test_a_row_of_stated_probabilities_counts_the_effects_it_names() -> None:
    rows = re.findall(r"^\|\w+, (\d+) effects.*?(\|.*)$", EVIDENCE.read_text("utf-8"), re.M)
    assert len(rows) == 2
    for output, cells in rows:
        assert sum(int(n) for n in re.findall(r"/(\d+)\|", cells)) == int(output)
