"""Columns from MATLAB files, whose arrays have names but no units.

An array named `time`, `voltage_mV` or `displacement_um` is recognised; all others are named by
`--columns`. Without a unit the SI unit is meant, but never for a displacement.
"""

import hashlib
from collections.abc import Mapping, Sequence

from psa_casadi.errors import InputError, Problems
from psa_casadi.records.read.columns import COLUMNS, SI_UNITS, ColumnMap, Source, check_unit
from psa_casadi.records.read.file_bytes import read_bytes
from psa_casadi.records.read.mat_file import Numbers, load_arrays
from psa_casadi.records.read.samples import Samples, whole_samples
from psa_casadi.units import parse_unit


def read_mat(
    path: str, required: Sequence[str], wanted: ColumnMap, problems: Problems
) -> Samples | None:
    """Return the columns of a MATLAB file, or None where they cannot be put together.

    `wanted` says which array is which column. Mistakes are added to `problems`: an array that is
    missing or of another length than the time, a unit that is missing or wrong.

    Raises:
        InputError: the file cannot be read or is no MATLAB file.
    """
    data = read_bytes(path)
    arrays = load_arrays(path, data)
    columns: dict[str, tuple[str, Numbers]] = {}
    for name in COLUMNS:
        source = wanted.get(name) or _by_name(name, arrays)
        if source is not None and source.array in arrays:
            unit = _unit(path, name, source, problems)
            columns[name] = (unit, arrays[source.array])
        elif source is not None:
            problems.add(
                f"{path}: there is no array '{source.array}' of numbers, which --columns names for "
                f"'{name}' ({_listed(arrays)}); correct --columns."
            )
        elif name in required:
            example = COLUMNS[name].example.split("[")[1][:-1]
            problems.add(
                f"{path}: no array is named '{name}' ({_listed(arrays)}); say which one it is, "
                f"such as --columns {name}=ARRAY:{example}."
            )
    if not columns or _lengths_differ(path, columns, wanted, problems):
        return None
    return whole_samples(path, hashlib.sha256(data).hexdigest(), "sample", columns)


def _unit(path: str, name: str, source: Source, problems: Problems) -> str:
    """Return the unit of an array, "" where none can be known."""
    unit = source.unit or SI_UNITS.get(name)
    if unit is not None:
        check_unit(COLUMNS[name], unit, f"{path}: array '{source.array}'", problems)
        return unit
    problems.add(
        f"{path}: array '{source.array}': the {name} has no unit; give it, such as --columns "
        f"{name}={source.array}:um."
    )
    return ""


def _by_name(name: str, arrays: Mapping[str, Numbers]) -> Source | None:
    """Return the array called `name` or `name_unit`, such as `displacement_um`."""
    for array in arrays:
        plain = array.lower()
        if plain == name:
            return Source(array, None)
        if plain.startswith(f"{name}_") and _is_unit(unit := array[len(name) + 1 :]):
            return Source(array, unit)
    return None


def _is_unit(text: str) -> bool:
    try:
        return bool(parse_unit(text).name)
    except InputError:
        return False


def _listed(arrays: Mapping[str, Numbers]) -> str:
    named = [f"{name} ({array.size})" for name, array in arrays.items()]
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
