"""The columns a record may have, and the header that names them."""

import difflib
import re
from collections.abc import Mapping, Sequence
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
    )
}


@dataclass(frozen=True)
class Field:
    """Where a column stands in the file, and the unit its numbers have."""

    index: int
    unit: str


_HEADER = re.compile(r"(?P<name>[^\[\]]*?)\s*(?:\[(?P<unit>[^\[\]]*)\])?")


def parse_header(
    texts: Sequence[str], required: Sequence[str], where: str, problems: Problems
) -> Mapping[str, Field]:
    """Return the columns that a header line `name [unit],name [unit],...` names.

    `where` (file and line) begins every sentence added to `problems`: no header, a required column
    missing or misspelled, one that stands twice, a unit that is missing, unknown or of another
    quantity.
    """
    if all(_is_number(text) for text in texts):
        problems.add(
            f"{where}: found '{','.join(texts)[:60]}', expected a header; write a first line such "
            f"as '{','.join(COLUMNS[name].example for name in required)}'."
        )
        return {}
    fields: dict[str, Field] = {}
    strangers: list[str] = []
    for index, text in enumerate(texts):
        match = _HEADER.fullmatch(text.strip())
        name = re.sub(r"\s+", "_", match["name"].strip().lower()) if match else text
        if match is None or name not in COLUMNS:
            strangers.append(name)
        elif name in fields:
            problems.add(
                f"{where}, column {index + 1}: '{name}' stands twice in the header (first as "
                f"column {fields[name].index + 1}); rename or remove one of the two."
            )
        else:
            _check_unit(COLUMNS[name], match["unit"], f"{where}, column '{name}'", problems)
            fields[name] = Field(index, match["unit"] or "")
    _report_missing(fields, strangers, required, where, problems)
    return fields


def _check_unit(column: Column, unit: str | None, where: str, problems: Problems) -> None:
    accepted = ", ".join(name for q in column.quantities for name in units_of(q))
    if unit is None or not unit.strip():
        problems.add(
            f"{where}: has no unit; write it in brackets, such as '{column.example}' (units: "
            f"{accepted})."
        )
        return
    try:
        parsed = parse_unit(unit, column.quantities[0])
    except InputError as error:
        problems.add(f"{where}: {error}")
        return
    if parsed.quantity not in column.quantities:
        problems.add(
            f"{where}: the unit '{unit}' does not measure {column.quantities[0]}; correct it to "
            f"one of {accepted}."
        )


def _report_missing(
    fields: Mapping[str, Field],
    strangers: Sequence[str],
    required: Sequence[str],
    where: str,
    problems: Problems,
) -> None:
    absent = [name for name in COLUMNS if name not in fields]
    meant = {
        near[0]: name
        for name in strangers
        if (near := difflib.get_close_matches(name, absent, n=1, cutoff=0.8))
    }
    for name in absent:
        if name in meant:
            problems.add(
                f"{where}: the column '{meant[name]}' is unknown; if '{name}' is meant, correct "
                f"the header to '{COLUMNS[name].example}', else give it a less similar name."
            )
        elif name in required:
            found = ", ".join([*fields, *filter(None, strangers)]) or "nothing"
            problems.add(
                f"{where}: the column '{name}' is missing (found: {found[:120]}); add it to the "
                f"header as '{COLUMNS[name].example}'."
            )


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return not text.strip()
    return True
