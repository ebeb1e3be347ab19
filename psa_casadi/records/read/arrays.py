"""The arrays of numbers in a file, by name, with their units where the file states them."""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psa_casadi.records.read.header_names import unit_named

Numbers = NDArray[np.generic]
#: What `--columns` would read as its own marks.
_MARKS = re.compile(r"[,:=\[\]]+")


@dataclass(frozen=True, eq=False)
class Array:
    """One series of numbers, shape (n,), and its unit; None where the file does not state it."""

    values: Numbers
    unit: str | None = None


Arrays = Mapping[str, Array]


def collected(arrays: Iterable[tuple[str, Array]]) -> dict[str, Array]:
    """Return arrays by names that `--columns` can be given; the first of a name counts."""
    found: dict[str, Array] = {}
    for name, array in arrays:
        found.setdefault(_MARKS.sub("_", name.strip()), array)
    return found


def series(name: str, numbers: NDArray[Any], unit: object = None) -> Iterator[tuple[str, Array]]:
    """Yield the series in an array of numbers: itself, its fields, or its columns counted from 1.

    Series lie along the longer side of a matrix. What is neither is left out.
    """
    if numbers.dtype.names:
        for field in numbers.dtype.names:
            yield from series(f"{name}.{field}" if name else field, numbers[field])
        return
    if numbers.dtype.kind not in "biuf":
        return
    stated = unit_named(unit) if isinstance(unit, str) else None
    numbers = np.squeeze(numbers) if numbers.size else numbers.ravel()
    if numbers.ndim == 1:
        yield name or "1", Array(numbers, stated)
    elif numbers.ndim == 2:
        upright = numbers if numbers.shape[0] >= numbers.shape[1] else numbers.T
        for k in range(upright.shape[1]):
            yield f"{name}.{k + 1}" if name else f"{k + 1}", Array(upright[:, k], stated)
