"""Binary files read in this process or a fork of it, where many would start one of their own."""

import json
import os
import signal
from pathlib import Path

import msgspec
import pytest

from psa_casadi.records.read import apart


def answered_by_fork(asked: apart.Asked) -> apart.Answer:
    """Return what a fork of this process tells of a file: a library may crash or hang it."""
    answer = Path(asked.path).with_suffix(".json")
    child = os.fork()
    if not child:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, 5.0)
        answer.write_text(json.dumps(msgspec.to_builtins(apart.answered(asked))))
        os._exit(0)
    if os.waitpid(child, 0)[1]:
        return apart.Answer((f"{asked.path}: is damaged.",))
    return msgspec.convert(json.loads(answer.read_text()), apart.Answer)


def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the rest of a test read binary files in this process."""
    monkeypatch.setattr(apart, "answered_apart", apart.answered)
