"""HDF5 files: datasets and tables by name, with units and time as attributes state them."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from psa_casadi.errors import InputError
from psa_casadi.records.read.arrays import (
    UNITS,
    Series,
    array_tables,
    series_in,
    told_step,
    unit_stated,
)
from psa_casadi.records.read.file_bytes import check_size
from psa_casadi.records.read.table import Table


def hdf5_tables(path: str) -> list[Table]:
    """Return the tables of an HDF5 file: datasets, fields of tables, units and time by attributes.

    A dataset in a group is named `group.dataset`. The attribute `units` or `unit` says the unit; a
    sample time [s] or rate [Hz] among the attributes the time where no dataset has it.
    """
    import h5py  # noqa: PLC0415

    with h5py.File(path, "r") as file:
        held = list(checked_datasets(path, file, set()))
        found = [s for item in held for s in _of_dataset(path, item)]
        about = [file, *held, *(item.parent for item in held)]
        steps = {step for item in about for step in told_step(_attributes(item))}
    return array_tables(path, found, steps)


def _of_dataset(path: str, item: Any) -> Iterator[Series]:
    import h5py  # noqa: PLC0415

    name = item.name.strip("/").replace("/", ".")
    unit = next((u for k, u in _attributes(item).items() if k in UNITS), None)
    place, size = item.name, max(item.shape or (0,))

    def read() -> Any:
        with h5py.File(path, "r") as file:
            found = file[place]
            return found.asstr()[()].ravel().tolist() if found.dtype.kind == "O" else found[()]

    if item.shape and sum(n != 1 for n in item.shape) == 1 and item.dtype.kind in "biuf":
        yield Series(name, size, lambda: np.ravel(read()), unit_stated(unit))
    elif item.shape and item.dtype.kind in "biufV":
        check_size(path, item.size * item.dtype.itemsize, "its arrays hold")
        yield from series_in(name, read(), unit)
    elif item.shape and h5py.check_string_dtype(item.dtype):
        yield Series(name, size, read)


def checked_datasets(path: str, group: Any, seen: set[int]) -> list[Any]:
    """Return the datasets below a group. Links are not followed, and none lies in another file."""
    import h5py  # noqa: PLC0415

    address = h5py.h5o.get_info(group.id).addr
    if address in seen:
        raise ValueError(f"the group '{group.name}' is reached twice")
    seen.add(address)
    found = []
    for name in group:
        if name.startswith("#") or not isinstance(group.get(name, getlink=True), h5py.HardLink):
            continue
        item = group[name]
        if isinstance(item, h5py.Group):
            found += checked_datasets(path, item, seen)
        elif isinstance(item, h5py.Dataset) and item.shape is not None:
            if item.external or item.is_virtual:
                raise InputError(
                    f"{path}: the array '{item.name}' lies in another file; save the values"
                    " themselves."
                )
            if item.chunks:
                piece = math.prod(item.chunks) * item.dtype.itemsize
                check_size(path, piece, f"a piece of the array '{item.name}' holds")
            found.append(item)
    return found


def _attributes(item: Any) -> dict[str, Any]:
    """Return the attributes with their keys in lower case, texts as such."""
    found = {}
    for key in item.attrs:
        value = item.attrs[key]
        if isinstance(value, np.ndarray) and value.size == 1:
            value = value.reshape(-1)[0]
        found[str(key).lower()] = (
            value.decode("utf-8", "replace") if isinstance(value, bytes) else value
        )
    return found
