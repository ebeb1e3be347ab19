"""Tables from files of named arrays: MATLAB, HDF5, TDMS, Parquet, NumPy, measurement programs.

An array named `time` or `voltage` is in the SI unit where the file states none; a displacement
never is. Groups whose arrays are records of their own are tables of their own.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psa_casadi.errors import Problems
from psa_casadi.records.read.columns import MARKS, SI_UNITS, stated_unit, understood, unit_named
from psa_casadi.records.read.file_bytes import check_size
from psa_casadi.records.read.table import Cells, Columns, Table, unit_of_times

#: The attributes and properties that state a unit, in lower case.
UNITS = ("units", "unit", "unit_string")
_BRACKETED = re.compile(r"(?P<name>.+?)\s*\[(?P<unit>[^\[\]]+)\]")


@dataclass(frozen=True, eq=False)
class Series:
    """One array of a file, by its name: `size` values, read on demand, in the unit it states."""

    name: str
    size: int
    values: Callable[[], Cells]
    unit: str | None = None


def unit_stated(unit: object) -> str | None:
    """Return the unit that a file states beside an array, None where it is none."""
    return unit_named(unit, common=False) if isinstance(unit, str) else None


def series_in(name: str, numbers: NDArray[Any], unit: object = None) -> Iterator[Series]:
    """Yield the series in an array: itself, its fields, or its columns counted from 1.

    Series lie along the longer side of a matrix. What is neither is left out.
    """
    if numbers.dtype.names:
        for field in numbers.dtype.names:
            yield from series_in(f"{name}.{field}" if name else field, numbers[field], unit)
        return
    if numbers.dtype.kind not in "biufmM":
        return
    stated = unit_stated(unit)
    numbers = np.atleast_1d(np.squeeze(numbers)) if numbers.size else numbers.ravel()
    if numbers.ndim == 1:
        yield Series(name or "1", numbers.size, lambda: numbers, stated)
    elif numbers.ndim == 2:
        upright = numbers if numbers.shape[0] >= numbers.shape[1] else numbers.T
        for k in range(upright.shape[1]):
            column = upright[:, k]
            own = f"{name}.{k + 1}" if name else f"{k + 1}"
            yield Series(own, column.size, lambda c=column: c, stated)  # type: ignore[misc]


def array_tables(
    path: str, found: Iterable[Series], steps: Iterable[float] = (), place: str = "sample"
) -> list[Table]:
    """Return the tables that series make: all of them, then those of each group with several.

    A group is also what the columns of one number of several matrices are; what is in none, such as
    a time, belongs to each.

    The first of a name counts. `steps` [s] are the times between samples that the file states; they
    count where they agree.
    """
    series: dict[str, Series] = {}
    for one in found:
        match = _BRACKETED.fullmatch(one.name.strip())
        name = MARKS.sub("_", match["name"] if match else one.name.strip())
        unit = one.unit or (match["unit"].strip() if match else None)
        series.setdefault(name, replace(one, name=name, unit=unit))
    scalars = {n.rpartition(".")[2]: s.values() for n, s in series.items() if s.size == 1}
    stated = {*steps, *told_step(scalars)}
    step = stated.pop() if len(stated) == 1 else None
    texts = {name: _text(one) for name, one in series.items()}
    whole = _table(path, "", list(series.values()), texts, step, place)
    groups: dict[str, list[Series]] = {}
    for name, one in series.items():
        group, _, last = name.rpartition(".")
        groups.setdefault(last if last.isdecimal() else group, []).append(one)
    shared = groups.get("", [])
    several = {n: [*shared, *own] for n, own in groups.items() if n and len(own) > 1}
    parts = [_table(path, name, own, texts, step, place) for name, own in several.items()]
    return [whole, *(parts if len(parts) > 1 else [])]


def _table(
    path: str, name: str, series: Sequence[Series], texts: Mapping[str, str], step: float | None,
    place: str,
) -> Table:  # fmt: skip
    """Return the table of some series; `texts` are their names with units."""

    def load(asked: Sequence[int], most: int | None, _: Problems) -> Columns:
        check_size(path, 8 * sum(series[k].size for k in asked if most is None), "its columns hold")
        cells = [series[k].values()[: most or series[k].size] for k in asked]
        longest = max(map(len, cells), default=0)
        return Columns(cells, np.arange(1, longest + 1))

    numbered = all(one.name.isdecimal() for one in series) and bool(series)
    kind = "column" if place == "row" else "array"
    labels = [one.name for one in series]
    return Table(
        path=path, name=name, header=[texts[label] for label in labels], labels=labels,
        where=f"{path}: {kind} names", place=place, load=load, step=step,
        sizes=[one.size for one in series],
        headless=", ".join(labels) if numbered else "",
    )  # fmt: skip


def _text(series: Series) -> str:
    """Return the name of a series with its unit: the stated one, or that of a name of its own."""
    last = series.name.rpartition(".")[2]
    own = last if re.match(r"\w*[^\W\d]", last) else series.name
    unit = series.unit
    if unit is None and not stated_unit(own):
        name = understood(own)
        values = series.values()[:9] if name and name.column == "time" and series.size > 1 else []
        if isinstance(values, np.ndarray) and len(values):
            is_instant = values.dtype.kind in "mM"
            unit = "s" if is_instant else unit_of_times(values.astype(np.float64))
        unit = unit or SI_UNITS.get(own.lower())
    return f"{series.name} [{unit}]" if unit else series.name


def told_step(attributes: Mapping[str, Any]) -> Iterator[float]:
    """Yield the times between samples [s] that attributes state, as a time or as a rate [Hz]."""
    for key, value in attributes.items():
        name = re.sub(r"[\W_]+", "", str(key).lower())
        try:
            number = float(np.asarray(value).reshape(-1)[0])
        except (TypeError, ValueError, IndexError):
            continue
        if not 0.0 < number < 1e12:
            continue
        if name in ("sampletime", "samplingtime", "sampleinterval", "samplinginterval", "dt",
                    "timestep", "increment", "xincrement", "wfincrement", "ts"):  # fmt: skip
            yield number
        elif name in ("samplerate", "samplingrate", "samplingfrequency", "samplefrequency", "fs",
                      "rate", "samplefreq"):  # fmt: skip
            yield 1.0 / number
