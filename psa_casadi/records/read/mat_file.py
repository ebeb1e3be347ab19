"""The numeric arrays of a MATLAB file by name, from level 4 to HDF5-based ones (v7.3)."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from psa_casadi.errors import InputError
from psa_casadi.records.read.arrays import Array, Arrays, Numbers, collected, series
from psa_casadi.records.read.file_bytes import reason_of
from psa_casadi.records.read.hdf5_process import arrays_apart
from psa_casadi.records.read.header_names import name_without_unit, stated_unit
from psa_casadi.records.read.mat_hdf5 import is_hdf5
from psa_casadi.records.read.mat_level4 import level4_arrays
from psa_casadi.records.read.mat_level5 import Tree, byte_order, level5_arrays


def load_arrays(path: str, data: bytes) -> Arrays:
    """Return every numeric series in the content of a MATLAB file by name.

    A field of a structure is named `log.u`, of the second of several `log.2.u`. A vector may stand
    upright or lie. Of a matrix the series are named `m.1`, `m.2`, ...; they lie along its longer
    side. What dSPACE ControlDesk records has the time as `log.time`, the others by their names.

    Raises:
        InputError: the file is no MATLAB file, is damaged, is too large when unpacked, or is of
            version 7.3 while h5py is not installed.
    """
    try:
        tree = _tree(path, data)
    except InputError:
        raise
    except Exception as error:  # h5py may raise anything on a damaged file
        reason = reason_of(error)
        raise InputError(
            f"{path}: is no readable MATLAB file ({reason}); save it again with save(..., '-v7'), "
            f"and where it was saved with -ascii, give the text a header and the ending .csv."
        ) from error
    return collected(pair for top, value in tree.items() for pair in _series(top, value))


def _tree(path: str, data: bytes) -> Mapping[str, Tree]:
    if is_hdf5(data):
        return arrays_apart(path, data)
    return level5_arrays(path, data) if byte_order(data) else level4_arrays(data)


def _series(name: str, value: Tree) -> Iterator[tuple[str, Array]]:
    if isinstance(value, tuple):
        value = {str(k): inner for k, inner in enumerate(value, 1)}
    if isinstance(value, Mapping):
        recorded = _recorded(value)
        for field, inner in value.items() if recorded is None else ():
            yield from _series(f"{name}.{field}", inner)
        for field, array, unit in recorded or ():
            yield from series(f"{name}.{field}", array, unit)
    elif isinstance(value, np.ndarray):
        yield from series(name, value)


def _recorded(value: Mapping[str, Tree]) -> list[tuple[str, Numbers, str | None]] | None:
    """Return name, numbers and unit of what dSPACE ControlDesk records, None where it is another.

    There `X` holds the time in seconds as `Data`, and each element of `Y` a signal with its `Name`.
    Where there are several times, or signals of one name, they are counted.
    """
    times, signals = (_with_data(value.get(axis)) for axis in ("X", "Y"))
    if not times or not any(_told(signal, "Name") for signal in signals):
        return None
    texts = [_told(signal, "Name") for signal in signals]
    names = [name_without_unit(text) for text in texts]
    if "" in names or len(set(names)) < len(names):
        names = [f"Y.{k}" for k in range(1, len(names) + 1)]
    clocks = ["time"] if len(times) == 1 else [f"X.{k}" for k in range(1, len(times) + 1)]
    return [
        *((own, x["Data"], _told(x, "Unit") or "s") for own, x in zip(clocks, times, strict=True)),
        *(
            (own, y["Data"], _told(y, "Unit") or stated_unit(text))
            for own, text, y in zip(names, texts, signals, strict=True)
        ),
    ]


def _with_data(value: Tree) -> list[Mapping[str, Any]]:
    """Return the structures that hold numbers as `Data`, none where one does not."""
    several = value if isinstance(value, tuple) else (value,)
    found = [v for v in several if isinstance(v, Mapping) and isinstance(v.get("Data"), np.ndarray)]
    return found if len(found) == len(several) else []


def _told(signal: Mapping[str, Any], field: str) -> str:
    text = signal.get(field)
    return text.strip() if isinstance(text, str) else ""
