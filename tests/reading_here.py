"""Binary files read in this process or a fork of it, where many would start one of their own."""

import json
import os
import signal
from pathlib import Path
from typing import Any

import pytest

from psa_casadi.errors import InputError
from psa_casadi.records.read import apart


def told_here(path: str, asked: dict[str, Any]) -> dict[str, Any]:
    """Return what the process apart tells of a file, read in this one."""
    found: dict[str, Any] = json.loads(json.dumps(apart.answered({"path": path, **asked})))
    if "refused" in found:
        raise InputError(found["refused"])
    return found


def told_by_fork(path: str, asked: dict[str, Any]) -> dict[str, Any]:
    """Return the same, read in a fork of this process, which a library may crash or hang."""
    answer = Path(path).with_suffix(".json")
    child = os.fork()
    if not child:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, 5.0)
        answer.write_text(json.dumps(apart.answered({"path": path, **asked})))
        os._exit(0)
    if os.waitpid(child, 0)[1]:
        raise InputError(f"{path}: is damaged.")
    found: dict[str, Any] = json.loads(answer.read_text())
    if "refused" in found:
        raise InputError(found["refused"])
    return found


def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the rest of a test read binary files in this process."""
    monkeypatch.setattr(apart, "_told", told_here)
