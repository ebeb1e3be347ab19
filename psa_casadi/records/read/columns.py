"""The columns a record may have, their units, and which array of a file is which of them."""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass

from psa_casadi.errors import InputError, Problems
from psa_casadi.units import parse_unit, units_of


@dataclass(frozen=True)
class Column:
    """One kind of column: the quantities it may hold and a header as an example."""

    name: str
    quantities: tuple[str, ...]
    example: str


#: Every column a record may have; others in a file are left alone.
COLUMNS: dict[str, Column] = {
    column.name: column
    for column in (
        Column("time", ("time",), "time [s]"),
        Column("voltage", ("voltage",), "voltage [V]"),
        Column("displacement", ("length", "sensor counts"), "displacement [um]"),
        Column("load_force", ("force",), "load_force [N]"),
        Column("current", ("current",), "current [mA]"),
        Column("temperature", ("temperature",), "temperature [degC]"),
        Column("monitor_voltage", ("voltage",), "monitor_voltage [V]"),
        Column("charge", ("charge",), "charge [uC]"),
        Column("displacement_2", ("length",), "displacement_2 [um]"),
        Column("strain", ("ratio",), "strain [ppm]"),
    )
}


@dataclass(frozen=True)
class Field:
    """Where a column stands in the file, and the unit its numbers have."""

    index: int
    unit: str


@dataclass(frozen=True)
class Source:
    """The array that holds a column, and its unit; None where the file or the column says it.

    A `scale` that is given says what 1 in the file is: 10 with the unit um is 10 um, as of a
    sensor's volts.
    """

    array: str
    unit: str | None
    scale: float | None = None

    def __str__(self) -> str:
        """Return it as `--columns` has it."""
        scale = "" if self.scale is None else f"{self.scale:g}"
        return self.array if self.unit is None else f"{self.array}:{scale}{self.unit}"


#: Which array of a file is which column: sources by the name of the column.
ColumnMap = Mapping[str, Source]

#: Where nobody names a unit, a column is taken to be in this one; a displacement never is.
SI_UNITS = {
    "time": "s", "voltage": "V", "load_force": "N", "current": "A", "temperature": "K",
    "monitor_voltage": "V", "charge": "C", "strain": "1",
}  # fmt: skip


def ready_line(sources: ColumnMap, sample_time: float | None = None, table: str = "") -> str:
    """Return the options that say which array is which column, and the sample time, for a shell."""
    named = [f"table={table}"] if table else []
    line = ",".join([*named, *(f"{name}={source}" for name, source in sources.items())])
    if os.name == "nt" or _SPECIAL.search(line):  # PowerShell takes a comma for its own
        line = f'"{line}"'
    options = [f"--columns {line}"] if line else []
    options += [f"--sample-time {sample_time:g}"] if sample_time is not None else []
    yours = ["your units"] if sources else []
    yours += ["your time between samples [s]"] if sample_time is not None else []
    scale = "; ':10um' says that 1 in the file is 10 um"
    scale = scale if any(source.scale is not None for source in sources.values()) else ""
    return f"{' '.join(options)} (with {' and '.join(yours)}{scale})" if yours else options[0]


def usual_source(name: str, array: str, unit: str | None = None) -> Source:
    """Return an array as the source of a column: in the unit that it states, else in the usual one.

    A stated unit that measures something else, as of a sensor's volts, waits for a scale.
    """
    usual = SI_UNITS.get(name, "um")
    if unit is None:
        return Source(array, usual)
    return Source(array, unit) if measures(name, unit) else Source(array, usual, 1.0)


def measures(name: str, unit: str) -> bool:
    """Whether a unit measures what a column holds, so that its numbers can be converted."""
    try:
        parsed = parse_unit(unit)
    except InputError:
        return False
    own = COLUMNS[name].quantities
    return parsed.quantity in own or (
        not parsed.quantity
        and any(parsed.dimension == parse_unit(units_of(q)[0]).dimension for q in own)
    )


_SPECIAL = re.compile(r"[^\w.,=:+/%@-]")


def mismatch(column: Column, unit: str) -> tuple[str, str]:
    """Return that a unit does not measure what the column holds, and what to do about it."""
    accepted = ", ".join(name for q in column.quantities for name in units_of(q))
    what = f"the unit '{unit}' does not measure {column.quantities[0]}"
    return what, f"correct it to one of {accepted}"


def check_unit(column: Column, unit: str | None, where: str, problems: Problems) -> None:
    """Demand a unit that measures what the column holds."""
    accepted = ", ".join(name for q in column.quantities for name in units_of(q))
    if unit is None or not unit.strip():
        problems.add(
            f"{where}: has no unit; write it in brackets, such as '{column.example}' (units: "
            f"{accepted})."
        )
        return
    try:
        parse_unit(unit, column.quantities[0])
    except InputError as error:
        problems.add(f"{where}: {error}")
        return
    if not measures(column.name, unit):
        problems.add(f"{where}: {'; '.join(mismatch(column, unit))}.")
