"""The numeric arrays of a MATLAB file by name, from level 4 to HDF5-based ones (v7.3)."""

from collections.abc import Iterator, Mapping

from psa_casadi.errors import InputError
from psa_casadi.records.read.arrays import Numbers, series
from psa_casadi.records.read.file_bytes import reason_of
from psa_casadi.records.read.hdf5_process import arrays_apart
from psa_casadi.records.read.mat_hdf5 import is_hdf5
from psa_casadi.records.read.mat_level4 import level4_arrays
from psa_casadi.records.read.mat_level5 import Tree, byte_order, level5_arrays


def load_arrays(path: str, data: bytes) -> Mapping[str, Numbers]:
    """Return every numeric series in the content of a MATLAB file, shape (n,) each, by name.

    A field of a structure is named `log.u`. A vector may stand upright or lie. Of a matrix the
    series are named `m.1`, `m.2`, ...; they lie along its longer side.

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
    return {name: array for top, value in tree.items() for name, array in _series(top, value)}


def _tree(path: str, data: bytes) -> Mapping[str, Tree]:
    if is_hdf5(data):
        return arrays_apart(path, data)
    return level5_arrays(path, data) if byte_order(data) else level4_arrays(data)


def _series(name: str, value: Tree) -> Iterator[tuple[str, Numbers]]:
    if isinstance(value, Mapping):
        for field, inner in value.items():
            yield from _series(f"{name}.{field}", inner)
    elif value is not None:
        yield from ((own, array.values) for own, array in series(name, value))
