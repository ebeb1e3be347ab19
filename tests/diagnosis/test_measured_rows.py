"""Rows of docs/evidence.md on the measured micromanipulator are what a diagnosis reports.

Those of the sine, which is the README's picture, and of the minor loops, which the README
diagnoses; `python -m tests.studies measured` has the others, which take a minute each.
"""

import json
import re
from pathlib import Path
from typing import Any

import pytest

import psa_casadi as psa
from build_scripts.page_commands import block_in_tests, run_block

PAGE = Path(__file__).parents[2] / "docs" / "evidence.md"


def rows() -> dict[str, list[str]]:
    """Cells of the table under `psa diagnose` on, by their first one."""
    table = PAGE.read_text(encoding="utf-8").split("| `psa diagnose` on |")[1].split("\n\n")[0]
    cells = [[c.strip() for c in line.strip("|").split("|")] for line in table.split("\n")[2:]]
    return {row[0]: row[1:] for row in cells}


def percents(cell: str) -> tuple[float, float]:
    """Smallest and largest figure of a cell."""
    result = re.match(r"([0-9.]+)(?: to ([0-9.]+))? %", cell)
    assert result is not None, cell
    return float(result[1]), float(result[2] or result[1])


def within(value: float, cell: str) -> bool:
    low, high = percents(cell)
    return low - 0.01 <= value <= high + 0.01


def assert_as_in_the_row(d: dict[str, Any], label: str) -> None:
    """Assert that the JSON of a diagnosis agrees with a row of the page."""
    base, extended, statement = rows()[label]
    assert statement.startswith(f"`{d['verdict']}`")
    named = {n for c in d["causes"] for n in (c["effect"], *c["cannot_be_told_from"])}
    written = set(re.findall(r"`([a-z_]+)`", statement)) & set(psa.EFFECTS)
    assert written <= named
    if "third effect" not in statement:
        assert {c["effect"] for c in d["causes"]} <= written
    assert not named & {b["effect"] for b in d["blind_to"]}
    withdrawn = [n for n in d["notes"] if "not named, because" in n]
    assert bool(withdrawn) == (d["verdict"] == "unexplained")
    errors = [d["errors"][model]["holdout_nrmse_percent"] for model in ("base", "extended")]
    assert within(errors[0], base)
    assert within(errors[1], base if extended == "the same" else extended)


@pytest.mark.slow
def test_the_record_of_the_readme_s_picture_gives_its_row(measured_data: Path) -> None:
    record = psa.read_record(measured_data / "micromanipulator" / "sine_1hz.csv")
    content = json.loads(psa.diagnose([record]).to_json())
    assert_as_in_the_row(content, "`sine_1hz.csv`")
    assert content["budget"]["together"]["share"] > 0.95


@pytest.mark.slow
@pytest.mark.usefixtures("measured_data")
def test_the_commands_of_the_readme_give_the_row_of_their_record(tmp_path: Path) -> None:
    block = block_in_tests("README.md")
    assert any("records/minor_loops.csv" in command for command in block.commands)
    assert run_block(block, tmp_path) is None
    content = json.loads((tmp_path / "diagnosis.json").read_text(encoding="utf-8"))
    assert_as_in_the_row(content, "`minor_loops.csv`")
