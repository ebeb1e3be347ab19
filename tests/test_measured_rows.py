"""The rows of docs/measured.md on the measured micromanipulator are what a diagnosis says of it."""

import re
from pathlib import Path

import pytest

from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.effects import EFFECTS
from psa_casadi.records import read_record

PAGE = Path(__file__).parent.parent / "docs" / "measured.md"
JUDGED = "`minor_loops.csv`, judged on `sine_1hz.csv` (`--holdout`)"
FILES = {"`sine_1hz.csv`": ("sine_1hz",), "`minor_loops.csv`": ("minor_loops",),
         "both files": ("sine_1hz", "minor_loops"), JUDGED: ("minor_loops",)}  # fmt: skip
HELD_OUT = {JUDGED: ("sine_1hz",)}


def rows() -> dict[str, list[str]]:
    """Cells of the table under `psa diagnose` on, by their first one."""
    table = PAGE.read_text(encoding="utf-8").split("| `psa diagnose` on |")[1].split("\n\n")[0]
    cells = [[c.strip() for c in line.strip("|").split("|")] for line in table.split("\n")[2:]]
    return {row[0]: row[1:] for row in cells}


def percents(cell: str) -> tuple[float, float]:
    """Smallest and largest figure of a cell."""
    found = re.match(r"([0-9.]+)(?: to ([0-9.]+))? %", cell)
    assert found is not None, cell
    return float(found[1]), float(found[2] or found[1])


def within(value: float, cell: str) -> bool:
    low, high = percents(cell)
    return low - 0.01 <= value <= high + 0.01


@pytest.mark.slow
@pytest.mark.parametrize("given", FILES)
def test_the_measured_row_is_played_again(given: str, measured_data: Path) -> None:
    base, extended, said = rows()[given]
    records, held_out = (
        [read_record(measured_data / "micromanipulator" / f"{name}.csv") for name in names]
        for names in (FILES[given], HELD_OUT.get(given, ()))
    )
    d = diagnose(records, holdout=held_out)
    assert said.startswith(f"`{d.verdict}`")
    named = {n for c in d.causes for n in (c.effect, *c.cannot_be_told_from)}
    written = set(re.findall(r"`([a-z_]+)`", said)) & set(EFFECTS)
    assert written <= named
    if "third effect" not in said:
        assert {c.effect for c in d.causes} <= written
    assert not named & {b.effect for b in d.blind_to}
    withdrawn = [n for n in d.notes if "not named, because" in n]
    assert bool(withdrawn) == (d.verdict == "unexplained")
    assert within(d.base_errors.holdout_nrmse_percent, base)
    assert within(
        d.extended_errors.holdout_nrmse_percent, base if extended == "the same" else extended
    )
