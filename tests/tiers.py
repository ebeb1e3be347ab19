"""Marks of tests: the quick tier runs by default, the full one has also `slow`."""

import sys
from collections.abc import Collection, Iterable
from typing import Any

import pytest

slow = pytest.mark.slow
posix = pytest.mark.skipif(
    sys.platform == "win32", reason="signals, locks, folders and processes as in POSIX"
)


def slow_but(quick: Collection[Any], cases: Iterable[Any]) -> list[Any]:
    """Return the cases of a parametrised test: all but the quick ones are slow."""
    return [c if c in quick else _marked(c) for c in cases]


def _marked(case: Any) -> Any:
    return pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=slow)
