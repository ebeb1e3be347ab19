"""The arrays of a MATLAB file of version 7.3, which is HDF5."""

import importlib.util
import io
import math
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from psa_casadi.errors import InputError
from psa_casadi.records.read.file_bytes import check_size
from psa_casadi.records.read.mat_level5 import Tree

#: Filters of HDF5 that MATLAB writes, or that leave the size as it is: shuffle, checksum.
_DEFLATE = 1
_FILTERS = {_DEFLATE, 2, 3}
_CHECKSUM = 4
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
    with opened(path, data) as file:
        check_datasets(path, [item for _, item in datasets(file, set())])
        return _tree(file)


@contextmanager
def opened(path: str, data: bytes) -> Iterator[Any]:
    """Yield the HDF5 file that a content is. Raises InputError where h5py is not installed."""
    require_h5py(path)
    import h5py  # noqa: PLC0415 - an optional dependency, needed for these files only

    with h5py.File(io.BytesIO(data), "r") as file:
        yield file


def require_h5py(path: str) -> None:
    """Raise InputError where h5py is not installed, without loading it."""
    if importlib.util.find_spec("h5py") is None:
        raise InputError(
            f"{path}: is an HDF5 file (as MATLAB's of version 7.3 are), and reading it needs h5py,"
            " which is not installed; run `pip install 'psa-casadi[matlab]'`, or save it in another"
            " format: in MATLAB with save(..., '-v7')."
        )


def members(group: Any, *, tables: bool = False) -> Iterator[tuple[str, Any]]:
    """Yield the groups, and the vectors and matrices of numbers, that lie in a group itself.

    `tables` asks for datasets with fields as well (MATLAB's are complex numbers).
    """
    import h5py  # noqa: PLC0415

    for name in group:
        if name.startswith("#") or not isinstance(group.get(name, getlink=True), h5py.HardLink):
            continue
        item = group[name]
        if isinstance(item, h5py.Group):
            yield name, item
        elif isinstance(item, h5py.Dataset) and item.shape is not None:
            kinds = "biufV" if tables else "biuf"
            if item.dtype.kind in kinds and 1 <= sum(n != 1 for n in item.shape) <= 2:
                yield name, item


def datasets(
    group: Any, seen: set[int], place: tuple[str, ...] = (), *, tables: bool = False
) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield the datasets in a group and the groups below it with their places, each group once."""
    import h5py  # noqa: PLC0415

    address = h5py.h5o.get_info(group.id).addr
    if address in seen:
        raise ValueError(f"the group '{group.name}' is reached twice")
    seen.add(address)
    for name, item in members(group, tables=tables):
        if isinstance(item, h5py.Group):
            yield from datasets(item, seen, (*place, name), tables=tables)
        else:
            yield (*place, name), item


def check_datasets(path: str, found: list[Any]) -> None:
    """Refuse arrays that are too large, as stated or in their pieces, or lie in other files."""
    check_size(path, sum(d.size * d.dtype.itemsize for d in found), "its arrays hold")
    for d in found:
        if d.external or d.is_virtual:
            raise InputError(
                f"{path}: the array '{d.name}' lies in another file; save the values themselves."
            )
        if d.chunks:
            size = math.prod(d.chunks) * d.dtype.itemsize
            check_size(path, size, f"a piece of the array '{d.name}' holds")
            _check_pieces(d, size)


def _check_pieces(dataset: Any, size: int) -> None:
    """Demand that every piece is unpacked to its size: HDF5 makes room for whatever comes."""
    plan = dataset.id.get_create_plist()
    filters = [plan.get_filter(k)[0] for k in range(plan.get_nfilters())]
    if not _FILTERS.issuperset(filters) or len(set(filters)) < len(filters):
        raise ValueError(f"the array '{dataset.name}' is packed in another way than gzip")
    places: list[tuple[int, ...]] = []
    dataset.id.chunk_iter(lambda piece: places.append(piece.chunk_offset))
    for place in places if _DEFLATE in filters else ():
        skipped, packed = dataset.id.read_direct_chunk(place)
        if skipped & (1 << filters.index(_DEFLATE)):
            continue
        if len(zlib.decompressobj().decompress(packed, size + _CHECKSUM + 1)) > size + _CHECKSUM:
            raise ValueError(f"a piece of the array '{dataset.name}' is larger than it states")


def _tree(group: Any) -> dict[str, Tree]:
    return {
        name: np.asarray(item[()]).T if hasattr(item, "dtype") else _tree(item)
        for name, item in members(group)
    }
