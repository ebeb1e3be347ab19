"""How far a long work is, in words."""

import re
from pathlib import Path

import pytest
from rich.console import Console

from psa_casadi.cli import steps
from psa_casadi.cli.screen import working
from psa_casadi.cli.steps import DIAGNOSE, IDENTIFY, PLAIN, Course, Told

SOURCE = Path(steps.__file__).parents[1]


class Clock:
    """A clock that stands where it is set."""

    now = 0.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    found = Clock()
    monkeypatch.setattr(steps, "clock", found)
    return found


def test_a_line_tells_step_time_and_what_is_usual(clock: Clock) -> None:
    told = Told("diagnosing", DIAGNOSE)
    assert told.line() == "diagnosing, 0 s (most take up to 40 s)"
    clock.now = 7.4
    told.tell("screening effects")
    step = "diagnosing, step 3 of 6 (screening the effects)"
    assert told.line() == f"{step}, 7 s (most take up to 40 s): screening effects"
    clock.now = 130.0
    told.tell("base fit from zero")  # parts of the work come again; the step does not go back
    assert told.line() == f"{step}, 2 min (longer than most: 40 s): base fit from zero"
    assert told.line(drawn=False) == told.line()
    console = Console(width=200)
    with console.capture() as shown:
        console.print(told)
    assert shown.get().strip() == told.line()


def test_lines_that_stay_tell_once_what_is_usual(
    clock: Clock, capsys: pytest.CaptureFixture[str]
) -> None:
    with working("diagnosing", False, DIAGNOSE) as progress:
        clock.now = 3.0
        progress("screening effects")
        clock.now = 41.0
        progress("judging")
    first, early, late = capsys.readouterr().err.splitlines()
    assert first == "diagnosing (most take up to 40 s) ..."
    assert early == "  diagnosing, step 3 of 6 (screening the effects), 3 s: screening effects"
    assert "(longer than most: 40 s)" in late


def test_other_work_tells_its_time(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    with working("compiling", False) as progress:
        clock.now = 3.0
        progress("linux")
    assert capsys.readouterr().err == "compiling ...\n  compiling, 3 s: linux\n"
    with working("compiling", True, PLAIN) as progress:
        progress("linux")
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("course", "rooms"),
    [
        (IDENTIFY, ["identification/**/*.py"]),
        (DIAGNOSE, ["identification/search.py", "diagnosis/**/*.py"]),
    ],
)
def test_what_is_told_belongs_to_a_step(course: Course, rooms: list[str]) -> None:
    texts = [p.read_text("utf-8") for r in rooms for p in SOURCE.glob(r)]
    found = {m for t in texts for m in re.findall(r'progress\(f?"([^"{]{3,})', t)}
    assert len(found) > 5
    unknown = {told for told in found if not course.step_of(told)}
    assert not unknown
