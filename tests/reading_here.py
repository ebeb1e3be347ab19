"""Binary files read in this process, where many tests would start one of their own for each."""

import json
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


def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the rest of a test read binary files in this process."""
    monkeypatch.setattr(apart, "_told", told_here)
