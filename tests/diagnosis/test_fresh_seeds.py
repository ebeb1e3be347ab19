"""Causes that a search once lost on fresh seeds of the exam, in the fits that lost them."""

from pathlib import Path

import pytest

import psa_casadi as psa
from tests.studies.golden.cases import ASKS
from tests.tiers import slow


@slow
@pytest.mark.parametrize(
    ("case", "draw", "cause"),
    [
        ("exam/k06", 2, "charge_leakage"),  # an ordinary base began with the bent one's states
        ("exam/k29", 2, "hysteresis_memory"),  # its loop saturates sooner than an ordinary one
        ("exam/k04", 2, "backlash"),  # so small that no derivative promises it
    ],
)
def test_a_cause_is_found_on_another_draw(case: str, draw: int, cause: str, tmp_path: Path) -> None:
    _, path = ASKS[case](tmp_path, draw)
    assert [c.effect for c in psa.diagnose(path).causes] == [cause]
