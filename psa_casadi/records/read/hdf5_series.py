"""The arrays of HDF5 files by name: datasets, fields of tables, units and time from attributes.

A dataset in a group is named `group.dataset`. The attribute `units` or `unit` says the unit. A
sample time (`sample_time`, `dt` [s]) or rate (`sample_rate`, `fs` [Hz]) among the attributes of the
file, of a group or of a dataset gives the time where no dataset does.
"""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from psa_casadi.records.read.arrays import Array, collected, series
from psa_casadi.records.read.header_names import understood
from psa_casadi.records.read.mat_hdf5 import check_datasets, datasets, opened

_UNITS = ("units", "unit")
_STEPS = ("sample_time", "sampling_time", "sample_interval", "dt")
_RATES = ("sample_rate", "sampling_rate", "sampling_frequency", "fs")


def hdf5_series(path: str, data: bytes) -> dict[str, Array]:
    """Return the series of numbers by name; links are not followed.

    Raises:
        InputError: h5py is not installed, the arrays are larger than a record may be, or lie in
            other files.
        Exception: whatever h5py says of a damaged file.
    """
    with opened(path, data) as file:
        held = list(datasets(file, set(), tables=True))
        check_datasets(path, [item for _, item in held])
        found = collected(_named(held))
        if not any(_is_time(name) for name in found):
            found |= _time(file, [item for _, item in held], found)
        return found


def _named(held: list[tuple[tuple[str, ...], Any]]) -> Iterator[tuple[str, Array]]:
    for place, item in held:
        attributes = _attributes(item)
        unit = next((attributes[key] for key in _UNITS if key in attributes), None)
        yield from series(".".join(place), np.asarray(item[()]), unit)


def _time(file: Any, held: list[Any], found: Mapping[str, Array]) -> dict[str, Array]:
    """Return the time that the attributes give, where they agree and the arrays are of one size."""
    steps = set()
    for item in (file, *held, *(item.parent for item in held)):
        for key, value in _attributes(item).items():
            step = _number(value)
            if key in _STEPS and step > 0.0:
                steps.add(step)
            elif key in _RATES and step > 0.0:
                steps.add(1.0 / step)
    sizes = {array.values.size for array in found.values()}
    if len(steps) != 1 or len(sizes) != 1:
        return {}
    return {"time": Array(steps.pop() * np.arange(sizes.pop()), "s")}


def _attributes(item: Any) -> dict[str, Any]:
    """Return the attributes with their keys in lower case, texts as such."""
    found = {}
    for key in item.attrs:
        value = item.attrs[key]
        if isinstance(value, np.ndarray) and value.size == 1:
            value = value.reshape(-1)[0]
        text = value.decode("utf-8", "replace") if isinstance(value, bytes) else value
        found[str(key).lower()] = text
    return found


def _is_time(name: str) -> bool:
    meant = understood(name.rpartition(".")[2])
    return meant is not None and meant.column == "time"


def _number(value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        return math.nan
