"""HDF5 files are read in a process of their own: its library may crash on a damaged file.

The content of the file goes to the process on standard input; the arrays come back on standard
output as NumPy's archive, under JSON lists: of MATLAB's files the names on the way to the array, of
others its name and its unit.
"""

import io
import json
import subprocess
import sys
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from psa_casadi.children import end_with_parent, heard, started_python
from psa_casadi.errors import InputError
from psa_casadi.records.read.arrays import Array, Numbers
from psa_casadi.records.read.file_bytes import reason_of
from psa_casadi.records.read.hdf5_series import hdf5_series
from psa_casadi.records.read.mat_hdf5 import hdf5_arrays, require_h5py
from psa_casadi.records.read.mat_level5 import Tree

#: Exit code of a process that tells on standard error, in JSON, what is wrong with the file.
_REFUSED = 3
#: Longest time that a file may take [s].
_LIMIT_S = 120.0
_OTHERWISE = {"MATLAB": " with save(..., '-v7')", "HDF5": ", or export the record as CSV"}


def arrays_apart(path: str, data: bytes) -> dict[str, Tree]:
    """Return what `hdf5_arrays` returns of a file's content, read in another process.

    Raises:
        InputError: what is wrong with the file; one on which the library crashes or hangs is
            damaged.
        MachineError: the other process cannot be started.
    """
    tree: dict[str, Tree] = {}
    for place, array in _apart(path, data, "MATLAB"):
        _put(tree, place, array)
    return tree


def series_apart(path: str, data: bytes) -> dict[str, Array]:
    """Return what `hdf5_series` returns of a file's content, read in another process.

    Raises:
        InputError: as `arrays_apart`.
    """
    return {name: Array(array, unit) for (name, unit), array in _apart(path, data, "HDF5")}


def _apart(path: str, data: bytes, kind: str) -> Iterator[tuple[list[Any], Numbers]]:
    require_h5py(path)
    try:
        with started_python("psa_casadi.records.read.hdf5_process", kind, path) as child:
            done = heard(child, data, limit=_LIMIT_S)
    except subprocess.TimeoutExpired:
        raise InputError(
            f"{path}: is no readable {kind} file (HDF5 comes to no end); save it again."
        ) from None
    if done.returncode == _REFUSED:
        raise InputError(json.loads(done.stderr.splitlines()[-1]))
    if done.returncode:
        raise InputError(
            f"{path}: is no readable {kind} file (the library of HDF5 fails on it); save it again"
            f"{_OTHERWISE[kind]}."
        )
    with np.load(io.BytesIO(done.stdout), allow_pickle=False) as arrays:
        for key in arrays.files:
            yield json.loads(key), arrays[key]


def _put(tree: dict[str, Tree], place: list[str], array: Tree) -> None:
    for name in place[:-1]:
        inner = tree.setdefault(name, {})
        if not isinstance(inner, dict):
            return
        tree = inner
    tree[place[-1]] = array


def _leaves(tree: Mapping[str, Tree], place: tuple[str, ...] = ()) -> Iterator[tuple[str, Tree]]:
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, (*place, name))
        else:
            yield json.dumps([*place, name]), value


def main() -> int:
    """Read a file from standard input and write its arrays to standard output."""
    end_with_parent()
    kind, path = sys.argv[1:3]
    data = sys.stdin.buffer.read()
    try:
        if kind == "MATLAB":
            found: dict[str, Any] = dict(_leaves(hdf5_arrays(path, data)))
        else:
            arrays = hdf5_series(path, data).items()
            found = {json.dumps([name, array.unit]): array.values for name, array in arrays}
    except InputError as error:
        problems = list(error.problems)
    except Exception as error:  # noqa: BLE001 - h5py may raise anything on a damaged file
        reason = reason_of(error)
        problems = [
            f"{path}: is no readable {kind} file ({reason}); save it again{_OTHERWISE[kind]}."
        ]
    else:
        np.savez(sys.stdout.buffer, **found)
        return 0
    sys.stderr.write(f"{json.dumps(problems)}\n")
    return _REFUSED


if __name__ == "__main__":
    sys.exit(main())
