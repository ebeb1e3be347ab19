"""Columns of numbers as a CSV file that `read_record` reads."""

import math
import os
import re
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from psa_casadi.errors import InputError, Problems
from psa_casadi.files import atomic_write
from psa_casadi.records.read.columns import COLUMNS, SI_UNITS
from psa_casadi.records.record import Record
from psa_casadi.units import parse_unit

_NAME = re.compile(r"[a-z]\w*(?:\.\w+)* \[(?P<unit>[^\[\]]+)\]", re.IGNORECASE)


def write_record(path: str | os.PathLike[str], columns: Record | Mapping[str, ArrayLike]) -> None:
    """Write a record, or columns, to a CSV file, whole or not at all.

    A record is written in SI units. The keys of columns are the header, `name [unit]` each; the
    values, shape (n,), are written in that unit as the shortest decimal number that reads back as
    the same float. nan becomes an empty cell.

    Raises:
        InputError: a key is not `name [unit]`, a unit is unknown, the columns differ in length or
            there are none, or the file cannot be written.
    """
    named = _columns_of(columns) if isinstance(columns, Record) else columns
    arrays = {name: np.asarray(values, dtype=np.float64) for name, values in named.items()}
    problems = Problems()
    if not arrays:
        problems.add(f"{path}: there are no columns to write; give at least one.")
    shape = next(iter(arrays.values())).shape if arrays else (0,)
    for name, array in arrays.items():
        _check_name(name, problems)
        if array.ndim != 1 or array.shape != shape:
            problems.add(
                f"column '{name}' has shape {array.shape}, the first has {shape}; give every "
                f"column one value for each instant."
            )
    problems.raise_if_any()
    cells = [map(_cell, array.tolist()) for array in arrays.values()]
    lines = [",".join(arrays), *map(",".join, zip(*cells, strict=True)), ""]
    atomic_write(path, "\n".join(lines))


def _columns_of(record: Record) -> dict[str, ArrayLike]:
    units = {**SI_UNITS, "displacement": record.displacement_unit, "displacement_2": "m"}
    columns = {name: getattr(record, name) for name in COLUMNS}
    return {f"{name} [{units[name]}]": v for name, v in columns.items() if v is not None}


def _check_name(name: str, problems: Problems) -> None:
    match = _NAME.fullmatch(name)
    if match is None:
        problems.add(f"the column name '{name}' is not of the form 'name [unit]'; correct it.")
        return
    try:
        parse_unit(match["unit"])
    except InputError as error:
        problems.add(f"column '{name}': {error}")


def _cell(value: float) -> str:
    return "" if math.isnan(value) else repr(value)
