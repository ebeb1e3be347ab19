"""Binary files read in this process or a fork of it, where many would start one of their own."""

import os
import signal
from pathlib import Path

import pytest

from psa_casadi.records.read import apart
from psa_casadi.records.read.samples import Outcome


def answered_by_fork(requested: apart.Asked) -> apart.Answer:
    """Return what a fork of this process tells of a file: a library may crash or hang it."""
    answer = Path(requested.path).with_suffix(".json")
    child = os.fork()
    if not child:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, 5.0)
        answer.write_text(apart.text_in(apart.answered(requested)))
        os._exit(0)
    if os.waitpid(child, 0)[1]:
        return apart.Answer(Outcome((f"{requested.path}: is damaged.",)))
    return apart.answer_in(answer.read_text())


def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the rest of a test read binary files in this process."""
    monkeypatch.setattr(apart, "answered_apart", apart.answered)
