"""Progress on a terminal: one line that goes, nothing elsewhere, and what a caller gives counts."""

import io
import sys
from collections.abc import Callable

import pytest

import psa_casadi as psa
from psa_casadi.common.progress import on_a_terminal, silent
from tests.any_model import own_plants as plants
from tests.any_model.own_models import motor


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@on_a_terminal
def work(count: int, *, progress: Callable[[str], None] = silent) -> int:
    progress(f"step {count} of many " + "x" * 500)
    return count


def test_a_line_is_drawn_on_a_terminal_and_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal, plain, steps = Terminal(), io.StringIO(), list[str]()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("COLUMNS", "40")
    assert work(3) == 3
    assert work(4, progress=steps.append) == 4
    line, last = terminal.getvalue().split("\r\x1b[K")[1:]
    assert (line, last) == ("work: step 3 of many " + "x" * 18, "")
    monkeypatch.setattr(sys, "stderr", plain)
    assert work(5) == 5
    assert plain.getvalue() == ""
    assert steps[0].startswith("step 4")


def test_a_fit_of_any_model_reports_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    record = plants.motor(1, friction=0.0)
    monkeypatch.setattr(sys, "stderr", terminal)
    psa.identify(motor(), record, starts=1)
    assert "identify: fitting from several starts" in terminal.getvalue()
