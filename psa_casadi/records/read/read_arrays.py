"""Columns from files of named arrays: MATLAB, HDF5, TDMS and NumPy files.

An array named `time`, `voltage_mV` or `displacement_um` is recognised, and what laboratories call
them where the file or the name gives a unit; all others are named by `--columns`. Without a unit
the SI unit is meant for an array that has the column's own name, but never for a displacement.
"""

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence

from psa_casadi.errors import Problems
from psa_casadi.records.read.arrays import Array, Arrays, Numbers
from psa_casadi.records.read.columns import (
    COLUMNS,
    SI_UNITS,
    ColumnMap,
    Source,
    check_unit,
    ready_line,
    usual_source,
)
from psa_casadi.records.read.file_bytes import read_bytes
from psa_casadi.records.read.hdf5_process import series_apart
from psa_casadi.records.read.header_names import understood, unit_named
from psa_casadi.records.read.mat_file import load_arrays
from psa_casadi.records.read.read_npy import npy_arrays
from psa_casadi.records.read.read_tdms import tdms_arrays
from psa_casadi.records.read.samples import Samples, whole_samples

_OR_STEP = " Or give --sample-time, where there is none."
#: What reads the arrays in the content of a file, by the ending of its name.
LOADERS: dict[str, Callable[[str, bytes], Arrays]] = {
    ".mat": lambda path, data: {n: Array(v) for n, v in load_arrays(path, data).items()},
    ".h5": series_apart,
    ".hdf5": series_apart,
    ".hdf": series_apart,
    ".tdms": tdms_arrays,
    ".npy": npy_arrays,
    ".npz": npy_arrays,
}


def read_arrays(
    path: str, required: Sequence[str], wanted: ColumnMap, problems: Problems
) -> Samples | None:
    """Return the columns of a file of arrays, or None where they cannot be put together.

    `wanted` says which array is which column. Mistakes are added to `problems`: an array that is
    missing or of another length than the time, a unit that is missing or wrong.

    Raises:
        InputError: the file cannot be read, or is not what its ending says.
    """
    data = read_bytes(path)
    arrays = LOADERS[os.path.splitext(path)[1].lower()](path, data)
    columns: dict[str, tuple[str, Numbers]] = {}
    for name in COLUMNS:
        source = wanted.get(name) or array_of(name, arrays)
        if source is not None and source.array in arrays:
            unit = _unit(path, name, source, arrays[source.array].unit, problems)
            columns[name] = (unit, arrays[source.array].values)
        elif source is not None:
            problems.add(
                f"{path}: there is no array '{source.array}' of numbers, which --columns names for "
                f"'{name}' ({_listed(arrays)}); correct --columns."
            )
        elif name in required:
            problems.add(
                f"{path}: no array is named '{name}' ({_listed(arrays)}); say which one it is:"
                f" {_line(arrays, required)}.{_OR_STEP if name == 'time' else ''}"
            )
    if not columns or _lengths_differ(path, columns, wanted, problems):
        return None
    return whole_samples(path, hashlib.sha256(data).hexdigest(), "sample", columns)


def _unit(path: str, name: str, source: Source, stated: str | None, problems: Problems) -> str:
    """Return the unit of an array, "" where none can be known."""
    unit = unit_of(name, source, stated)
    if unit is not None:
        check_unit(COLUMNS[name], unit, f"{path}: array '{source.array}'", problems)
        return unit
    problems.add(
        f"{path}: array '{source.array}': the {name} has no unit; give it, such as --columns "
        f"{name}={source.array}:um."
    )
    return ""


def unit_of(name: str, source: Source, stated: str | None) -> str | None:
    """Return the unit that a source, the file or, of an SI column, its name gives."""
    return source.unit or stated or SI_UNITS.get(name)


def array_of(name: str, arrays: Arrays) -> Source | None:
    """Return the array called `name` or `name_unit`, else the only one that means it.

    That one has a unit, or the column's own name in a group.
    """
    for array in arrays:
        plain = array.lower()
        if plain == name:
            return Source(array, None)
        unit = array[len(name) + 1 :] if plain.startswith(f"{name}_") else ""
        if unit_named(unit):
            return Source(array, unit_named(unit))
    meant = []
    for array in arrays:
        last = array.rpartition(".")[2]
        found = understood(last)
        if found is not None and found.column == name:
            stated = found.unit or arrays[array].unit
            if stated or last.lower() == name:
                meant.append(Source(array, stated))
    return meant[0] if len(meant) == 1 else None


def _line(arrays: Arrays, required: Sequence[str]) -> str:
    """Return the option to type: the arrays that seem to be meant, else the others in order."""
    texts: dict[str, str] = {}
    for array in arrays:
        found = understood(array.rpartition(".")[2])
        if found is not None:
            texts.setdefault(found.column, array)
    left = (array for array in arrays if array not in texts.values())
    for name in required:
        if name not in texts:
            texts[name] = next(left, "ARRAY")
    return ready_line({name: usual_source(name, texts[name]) for name in required})


def _listed(arrays: Arrays) -> str:
    named = [f"{name} ({array.values.size})" for name, array in arrays.items()]
    more = f" and {len(named) - 8} more" if len(named) > 8 else ""
    return f"arrays and their lengths: {', '.join(named[:8])}{more}" if named else "it holds none"


def _lengths_differ(
    path: str,
    columns: Mapping[str, tuple[str, Numbers]],
    wanted: ColumnMap,
    problems: Problems,
) -> bool:
    first, (_, leading) = next(iter(columns.items()))
    wrong = {name: a.size for name, (_, a) in columns.items() if a.size != leading.size}
    for name, size in wrong.items():
        array = wanted[name].array if name in wanted else name
        problems.add(
            f"{path}: array '{array}' ({name}) has {size} values, '{first}' has {leading.size}; "
            f"give every column one value for each instant."
        )
    return bool(wrong)
