"""The arrays of a MATLAB file of version 7.3, which is HDF5."""

import io
import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from psa_casadi.errors import InputError
from psa_casadi.records.read.file_bytes import check_size
from psa_casadi.records.read.mat_level5 import Tree

_SIGNATURE = b"\x89HDF\r\n\x1a\n"


def is_hdf5(data: bytes) -> bool:
    """Whether an HDF5 file begins in the content, as it may behind MATLAB's own header."""
    return any(data.startswith(_SIGNATURE, at) for at in (0, 512, 1024, 2048))


def hdf5_arrays(path: str, data: bytes) -> dict[str, Tree]:
    """Return the arrays of numbers by name, groups as structures; links are not followed.

    Raises:
        InputError: h5py is not installed, the arrays are larger than a record may be, or lie in
            other files.
        Exception: whatever h5py says of a damaged file.
    """
    try:
        import h5py  # noqa: PLC0415 - an optional dependency, needed for these files only
    except ImportError:
        raise InputError(
            f"{path}: is a MATLAB file of version 7.3, and reading it needs h5py, which is not "
            f"installed; run `pip install 'psa-casadi[matlab]'`, or save it with save(..., '-v7')."
        ) from None
    with h5py.File(io.BytesIO(data), "r") as file:
        _check(path, list(_datasets(file, set())))
        return _tree(file)


def _members(group: Any) -> Iterator[tuple[str, Any]]:
    """Yield the groups, and the vectors and matrices of numbers, that lie in a group itself."""
    import h5py  # noqa: PLC0415

    for name in group:
        if name.startswith("#") or not isinstance(group.get(name, getlink=True), h5py.HardLink):
            continue
        item = group[name]
        numbers = isinstance(item, h5py.Dataset) and item.dtype.kind in "biuf"
        if isinstance(item, h5py.Group) or (numbers and 1 <= sum(n != 1 for n in item.shape) <= 2):
            yield name, item


def _datasets(group: Any, seen: set[int]) -> Iterator[Any]:
    """Yield the datasets in a group and the groups below it, each group `seen` once."""
    import h5py  # noqa: PLC0415

    place = h5py.h5o.get_info(group.id).addr
    if place in seen:
        raise ValueError(f"the group '{group.name}' is reached twice")
    seen.add(place)
    for _, item in _members(group):
        if isinstance(item, h5py.Group):
            yield from _datasets(item, seen)
        else:
            yield item


def _check(path: str, datasets: list[Any]) -> None:
    """Refuse arrays that are too large, as stated or in their pieces, or lie in other files."""
    check_size(path, sum(d.size * d.dtype.itemsize for d in datasets), "its arrays hold")
    for d in datasets:
        if d.external or d.is_virtual:
            raise InputError(
                f"{path}: the array '{d.name}' lies in another file; save the values themselves."
            )
        piece = math.prod(d.chunks or (0,)) * d.dtype.itemsize
        check_size(path, piece, f"a piece of the array '{d.name}' holds")


def _tree(group: Any) -> dict[str, Tree]:
    return {
        name: np.asarray(item[()]).T if hasattr(item, "dtype") else _tree(item)
        for name, item in _members(group)
    }
