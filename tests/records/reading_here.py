"""Binary files read in this process or a fork of it, where many would each start a process."""

import os
import signal
from pathlib import Path

import pytest

from psa_casadi.records.read import apart
from psa_casadi.records.read.samples import Outcome


def read_by_fork(task: apart.FileTask) -> Outcome:
    """Return what a fork of this process reads of a file: a library may crash or hang it."""
    answer = Path(task.path).with_suffix(".json")
    child = os.fork()
    if not child:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, 5.0)
        answer.write_text(apart.to_json(apart.read_here(task)))
        os._exit(0)
    if os.waitpid(child, 0)[1]:
        return Outcome((f"{task.path}: is damaged.",))
    return apart.from_json(answer.read_text())


def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the rest of a test read binary files in this process."""
    monkeypatch.setattr(apart, "read_apart", apart.read_here)
