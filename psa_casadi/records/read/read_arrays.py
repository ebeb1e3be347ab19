"""Columns from files of named arrays: MATLAB, HDF5, TDMS and NumPy files.

An array named `time`, `voltage_mV` or `displacement_um` is recognised, and what laboratories call
them where the file or the name gives a unit, or the only one in a unit of time, voltage or length;
all others are named by `--columns`. Without a unit
the SI unit is meant for an array that has the column's own name, but never for a displacement.
"""

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence

from psa_casadi.errors import Problems
from psa_casadi.records.read.arrays import Arrays, Numbers
from psa_casadi.records.read.candidates import Cell, cell_of, decided, source_of, suggested
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
from psa_casadi.records.read.header_names import unit_for, unit_named
from psa_casadi.records.read.mat_file import load_arrays
from psa_casadi.records.read.read_npy import npy_arrays
from psa_casadi.records.read.read_tdms import tdms_arrays
from psa_casadi.records.read.samples import Samples, whole_samples

_OR_STEP = " Or give --sample-time, where there is none."
#: What reads the arrays in the content of a file, by the ending of its name.
LOADERS: dict[str, Callable[[str, bytes], Arrays]] = {
    ".mat": load_arrays,
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
        source = wanted.get(name) or array_of(name, arrays, by_unit=name in required)
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
    """Return the unit that a source, the file, the array's name or an SI column's name gives."""
    own = source.unit or stated or unit_for(name, last_part(source.array))
    return own or SI_UNITS.get(name)


def array_of(name: str, arrays: Arrays, *, by_unit: bool) -> Source | None:
    """Return the array called `name` or `name_unit`, else the only one that means it.

    That one has a unit, or the column's own name in a group; `by_unit` allows the only one whose
    unit measures what the column holds.
    """
    for array in arrays:
        plain = array.lower()
        if plain == name:
            return Source(array, None)
        unit = array[len(name) + 1 :] if plain.startswith(f"{name}_") else ""
        if unit_named(unit):
            return Source(array, unit_named(unit))
    cells = _cells(arrays)
    one, several = decided(name, cells, by_unit=by_unit)
    if one is not None:
        return Source(cells[one].label, cells[one].unit)
    own = [cells[k].label for k in several if cells[k].text.lower() == name]
    return Source(own[0], None) if len(several) == len(own) == 1 else None


def suggested_sources(arrays: Arrays, required: Sequence[str]) -> dict[str, Source]:
    """Return the arrays that are the columns, or seem to be."""
    found = {n: s for n in required if (s := array_of(n, arrays, by_unit=True)) is not None}
    known = {
        n: usual_source(n, s.array, unit_of(n, s, arrays[s.array].unit)) for n, s in found.items()
    }
    free = [c for c in _cells(arrays) if c.label not in {s.array for s in found.values()}]
    chosen = suggested([n for n in required if n not in known], free)
    return known | {n: source_of(n, free[k]) for n, k in chosen.items()}


def _cells(arrays: Arrays) -> list[Cell]:
    return [cell_of(last_part(name), name, array.unit) for name, array in arrays.items()]


def last_part(array: str) -> str:
    """Return the name of an array without that of its group."""
    return array.rpartition(".")[2]


def _line(arrays: Arrays, required: Sequence[str]) -> str:
    """Return the option to type: the arrays that seem to be meant, ARRAY where none does."""
    sources = suggested_sources(arrays, required)
    return ready_line({n: sources.get(n) or usual_source(n, "ARRAY") for n in required})


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
