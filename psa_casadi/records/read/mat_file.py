"""The numeric arrays of a MATLAB file by name, from level 5 files to HDF5-based ones (v7.3)."""

import io
import warnings
import zlib
from collections.abc import Iterator, Mapping
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from psa_casadi.errors import InputError
from psa_casadi.units import FloatArray

_HDF5 = b"\x89HDF\r\n\x1a\n"
_BROKEN = (
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    OSError,
    EOFError,
    OverflowError,
    MemoryError,
    RuntimeError,
    NotImplementedError,
    MatReadError,
    zlib.error,
)


def load_arrays(path: str, data: bytes) -> Mapping[str, FloatArray]:
    """Return every numeric series in the content of a MATLAB file, shape (n,) each, by name.

    A field of a structure is named `log.u`. A vector may stand upright or lie. Of a matrix the
    series are named `m.1`, `m.2`, ...; they lie along its longer side.

    Raises:
        InputError: the file is no MATLAB file, is damaged, or is of version 7.3 while h5py is not
            installed.
    """
    try:
        tree = _from_hdf5(path, data) if _HDF5 in data[:4096] else _from_level_5(data)
    except InputError:
        raise
    except _BROKEN as error:
        reason = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
        raise InputError(
            f"{path}: is no readable MATLAB file ({reason}); save it again with save(..., '-v7'), "
            f"and where it was saved with -ascii, give the text a header and the ending .csv."
        ) from error
    return {name: array for top, value in tree.items() for name, array in _series(top, value)}


def _from_level_5(data: bytes) -> Mapping[str, Any]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of objects that are no arrays, which are left out
        found = loadmat(cast(Any, io.BytesIO(data)), simplify_cells=True)
    return {name: value for name, value in found.items() if not name.startswith("__")}


def _from_hdf5(path: str, data: bytes) -> Mapping[str, Any]:
    try:
        import h5py  # noqa: PLC0415 - an optional dependency, needed for these files only
    except ImportError:
        raise InputError(
            f"{path}: is a MATLAB file of version 7.3, and reading it needs h5py, which is not "
            f"installed; run `pip install 'psa-casadi[matlab]'`, or save it with save(..., '-v7')."
        ) from None

    def tree(group: Any) -> dict[str, Any]:
        return {
            name: tree(item) if isinstance(item, h5py.Group) else np.asarray(item[()]).T
            for name, item in group.items()
            if not name.startswith("#")
        }

    with h5py.File(io.BytesIO(data), "r") as file:
        return tree(file)


def _series(name: str, value: object) -> Iterator[tuple[str, FloatArray]]:
    if isinstance(value, dict):
        for field, inner in value.items():
            yield from _series(f"{name}.{field}", inner)
    elif isinstance(value, np.ndarray) and value.dtype.kind in "biuf" and 1 <= value.ndim <= 2:
        yield from _columns(name, value)


def _columns(name: str, array: NDArray[Any]) -> Iterator[tuple[str, FloatArray]]:
    numbers = array.astype(np.float64)
    if numbers.ndim == 1 or 1 in numbers.shape:
        yield name, numbers.ravel()
        return
    upright = numbers if numbers.shape[0] >= numbers.shape[1] else numbers.T
    for k in range(upright.shape[1]):
        yield f"{name}.{k + 1}", upright[:, k]
