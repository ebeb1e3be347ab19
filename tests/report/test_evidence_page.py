"""The figures of docs/evidence.md agree with each other."""

import re
from pathlib import Path

EVIDENCE = Path(__file__).parents[2] / "docs" / "evidence.md"


def test_a_row_of_stated_probabilities_counts_the_effects_it_names() -> None:
    rows = re.findall(
        r"^\| .*, (\d+) effects: mean, right \|(.*)$", EVIDENCE.read_text("utf-8"), re.M
    )
    assert len(rows) == 3
    for told, cells in rows:
        assert sum(int(n) for n in re.findall(r"of (\d+) \|", cells)) == int(told)
