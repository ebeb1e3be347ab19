"""The samples of one experiment on any model: a time and columns by name."""

import csv
import hashlib
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from psa_casadi.errors import InputError, Problems
from psa_casadi.files import why_not_read
from psa_casadi.units import FloatArray

#: What an input does between two samples.
Hold = Literal["linear", "zero"]
#: So many jumps, and such a share of all moves, make a staircase.
_JUMPS, _NEARLY_ALL = 2, 0.8

_WITH_UNIT = re.compile(r"[^\[]+\[[^\]]*\]\s*")


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Signals:
    """Samples of one experiment in the units of a model; the arrays have shape (n,).

        Signals(name="sweep", time=t, columns={"voltage": u, "speed": w})

    `time` [s] increases strictly and need not be uniform. `columns` are inputs and outputs by the
    names that the model gives them; nan marks a missing sample of an output. Between samples the
    inputs are linear (`hold="linear"`) or constant (`hold="zero"`). `sha256` is that of the arrays.

    Raises:
        InputError: fewer than eight samples; a time that stands still or goes back; a column of
            another length, or one that holds infinite numbers.
    """

    name: str
    time: FloatArray
    columns: Mapping[str, FloatArray]
    hold: Hold = "linear"
    sha256: str = ""

    def __post_init__(self) -> None:
        time = _frozen(self.time)
        columns = {str(n): _frozen(v) for n, v in self.columns.items()}
        object.__setattr__(self, "time", time)
        object.__setattr__(self, "columns", columns)
        problems, where = Problems(), f"signals '{self.name}'"
        if time.ndim != 1 or time.size < 8 or not np.isfinite(time).all():
            problems.add(f"{where}: the time has shape {time.shape}; give eight or more times.")
        elif not np.all(np.diff(time) > 0):
            problems.add(f"{where}: the time does not strictly increase; sort it.")
        if self.hold not in ("linear", "zero"):
            problems.add(f"{where}: the hold '{self.hold}' does not exist; use 'linear' or 'zero'.")
        for name, values in columns.items():
            if values.shape != time.shape:
                problems.add(
                    f"{where}: '{name}' has shape {values.shape}, but time has {time.size}"
                    " samples; give one value for each instant."
                )
            elif np.isinf(values).any():
                problems.add(f"{where}: '{name}' holds infinite numbers; mark missing ones as nan.")
        problems.raise_if_any()
        if not self.sha256:
            digest = hashlib.sha256(time.tobytes())
            for name, values in sorted(columns.items()):
                digest.update(name.encode() + values.tobytes())
            object.__setattr__(self, "sha256", digest.hexdigest())

    def __repr__(self) -> str:
        """Return name, size and columns in one line."""
        names = ", ".join(self.columns)
        return f"<Signals '{self.name}': {self.n} samples in {self.duration:.4g} s of {names}>"

    @property
    def n(self) -> int:
        """Number of samples."""
        return self.time.size

    @property
    def mask(self) -> npt.NDArray[np.bool_]:
        """True for every sample, shape (n,); missing readings of an output are nan."""
        return np.ones(self.n, dtype=np.bool_)

    @cached_property
    def sample_time(self) -> float:
        """Median distance between samples [s]."""
        return float(np.median(np.diff(self.time)))

    def column(self, name: str) -> FloatArray | None:
        """Return the samples (n,) of a column by its name, None where it was not recorded."""
        return self.columns.get(name)

    @property
    def duration(self) -> float:
        """Time from the first to the last sample [s]."""
        return float(self.time[-1] - self.time[0])


def signals_given(given: Any, hold: Hold | None = None, first: int = 1) -> list[Signals]:
    """Return the experiments that a user gave: one or several of `Signals`, tables, CSV files.

    A table (a mapping of arrays, a data frame) has a column `time`, and so has a CSV file with its
    names in the first line; all in the units of the model. `hold` is what inputs do between samples
    (None: what `Signals` say, else "linear"), `first` the number of the first one without a name.
    Raises InputError.
    """
    if _is_one(given):
        given = [given]
    if not isinstance(given, Iterable):
        raise InputError(
            f"A {type(given).__name__} is no record; give Signals, a mapping with 'time', a data"
            " frame, the path of a CSV file, or several of these."
        )
    found = [_one(g, k) for k, g in enumerate(given, first)]
    if not found:
        raise InputError("There are no records; give one or more.")
    return found if hold is None else [replace(s, hold=hold) for s in found]


def stairs(signals: Signals, names: Iterable[str]) -> tuple[str, ...]:
    """Return the columns that stand still between jumps, each within one sampling interval.

    Nearly all their moves are such jumps, of which a straight line makes a ramp. An edge drawn by
    two samples close together is none.
    """
    steps = np.diff(signals.time)
    wide, found = steps > 0.5 * float(np.median(steps)), []
    for name in names:
        moves = np.diff(signals.columns[name]) != 0.0
        alone = (moves & wide)[1:-1] & ~moves[:-2] & ~moves[2:]
        jumps = int(np.count_nonzero(alone))
        if jumps >= _JUMPS and jumps >= _NEARLY_ALL * np.count_nonzero(moves):
            found.append(name)
    return tuple(found)


def _is_one(given: Any) -> bool:
    table = hasattr(given, "columns") and hasattr(given, "__getitem__")
    return table or isinstance(given, Signals | Mapping | str | os.PathLike)


def _one(given: Any, number: int) -> Signals:
    if isinstance(given, Signals):
        return given
    if isinstance(given, str | os.PathLike):
        return _read(Path(given))
    if not _is_one(given):
        raise InputError(
            f"Record {number} is a {type(given).__name__}; give Signals, a mapping with 'time', a"
            " data frame or the path of a CSV file."
        )
    names = list(given) if isinstance(given, Mapping) else [str(n) for n in given.columns]
    return _of_table({n: given[n] for n in names}, f"record_{number}")


def _of_table(table: Mapping[str, Any], name: str) -> Signals:
    if "time" not in table:
        raise InputError(
            f"{name} has the columns {sorted(table)} and none named 'time'; name the times [s] so."
            + unit_hint(table)
        )
    columns = {n: values for n, values in table.items() if n != "time"}
    return Signals(name=name, time=table["time"], columns=columns)


def unit_hint(names: Iterable[str]) -> str:
    """Return what to do where names of columns hold units, such as "speed [rad/s]"; else ""."""
    found = next((n for n in map(str, names) if _WITH_UNIT.fullmatch(n)), None)
    if found is None:
        return ""
    return (
        f" Write the names without units ('{found.split('[')[0].strip()}' for '{found}') and the"
        " values in the units of the model."
    )


def _read(path: Path) -> Signals:
    """Read a CSV file with names in its first line; an empty field is a missing sample."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = [row for row in csv.reader(file) if row and not row[0].startswith("#")]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path} cannot be read ({why_not_read(error)}); give a CSV file."
        ) from error
    if len(rows) < 2:
        raise InputError(f"{path} holds no samples; give names in the first line, then numbers.")
    names = [n.strip() for n in rows[0]]
    problems = Problems()
    values = np.full((len(rows) - 1, len(names)), np.nan)
    for k, row in enumerate(rows[1:]):
        if len(row) != len(names):
            problems.add(f"{path}: row {k + 2} has {len(row)} fields for {len(names)} names.")
            continue
        for j, field in enumerate(row):
            try:
                values[k, j] = float(field) if field.strip() else np.nan
            except ValueError:
                problems.add(f"{path}: row {k + 2}: '{field}' is no number; write it as 1.5e-3.")
    problems.raise_if_any()
    return _of_table(dict(zip(names, values.T, strict=True)), path.stem)


def _frozen(values: npt.ArrayLike) -> FloatArray:
    array = np.array(values, dtype=np.float64)
    array.flags.writeable = False
    return array
