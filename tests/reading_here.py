"""Binary files read in this process, where many tests would start one of their own for each."""

import json
from typing import Any

import pytest

from psa_casadi.errors import InputError
from psa_casadi.records.read import apart


def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the rest of a test read binary files in this process."""

    def told(path: str, asked: dict[str, Any]) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(json.dumps(apart.answered({"path": path, **asked})))
        if "refused" in found:
            raise InputError(found["refused"])
        return found

    monkeypatch.setattr(apart, "_told", told)
