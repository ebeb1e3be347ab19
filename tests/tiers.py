"""Marks for the tiers of the tests: the quick one runs by default, the full one has also `slow`."""

from collections.abc import Collection, Iterable
from typing import Any

import pytest

slow = pytest.mark.slow


def slow_but(quick: Collection[Any], cases: Iterable[Any]) -> list[Any]:
    """Return the cases of a parametrised test: all but the quick ones are slow."""
    return [c if c in quick else _marked(c) for c in cases]


def _marked(case: Any) -> Any:
    return pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=slow)
