"""The columns a record may have, and the header that names them."""

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from psa_casadi.errors import InputError, Problems
from psa_casadi.records.read.header_names import understood
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
    """The array that holds a column, and its unit; None where the file or the column says it."""

    array: str
    unit: str | None


#: Which array of a file is which column: sources by the name of the column.
ColumnMap = Mapping[str, Source]

#: Where nobody names a unit, a column is taken to be in this one; a displacement never is.
SI_UNITS = {
    "time": "s", "voltage": "V", "load_force": "N", "current": "A", "temperature": "K",
    "monitor_voltage": "V", "charge": "C", "strain": "1",
}  # fmt: skip

_HEADER = re.compile(r"(?P<name>[^\[\]]*?)\s*(?:\[(?P<unit>[^\[\]]*)\])?")


def parse_header(
    texts: Sequence[str],
    required: Sequence[str],
    where: str,
    problems: Problems,
    wanted: ColumnMap | None = None,
) -> Mapping[str, Field]:
    """Return the columns that a header line `name [unit],name [unit],...` names.

    `wanted` says which name stands for which column where the header does not use the columns'
    own names. `where` (file and line) begins every sentence added to `problems`: no header, a
    column missing, misspelled or there twice, a unit that is missing or wrong.
    """
    wanted = wanted or {}
    counted = bool(wanted) and all(source.array in texts for source in wanted.values())
    if all(_is_number(text) for text in texts) and not counted:
        example = ",".join(COLUMNS[name].example for name in required)
        numbered = {name: str(k) for k, name in enumerate(required, 1)}
        problems.add(
            f"{where}: found '{','.join(texts)[:60]}', expected a header; write a first line such "
            f"as '{example}', or say which column is which: {ready_line(numbered)}"
        )
        return {}
    fields: dict[str, Field] = {}
    strangers: list[tuple[int, str]] = []
    for index, text in enumerate(texts):
        match = _HEADER.fullmatch(text.strip())
        own = match["name"].strip() if match else text
        name = _column_of(own, text, wanted)
        open_unit = match is not None and match["unit"] is None and name not in wanted
        if match is None or name not in COLUMNS or (open_unit and name in required):
            strangers.append((index, text.strip()))
        elif name in fields:
            problems.add(
                f"{where}, column {index + 1}: '{name}' stands twice in the header (first as "
                f"column {fields[name].index + 1}); rename or remove one of the two."
            )
        else:
            place = f"{where}, column '{own if name in wanted else name}'"
            unit = _agreed_unit(name, match["unit"], wanted, place, problems)
            fields[name] = Field(index, unit)
    strangers = _by_other_names(strangers, fields, required, wanted, where, problems)
    names = [m["name"] if (m := _HEADER.fullmatch(text)) else text for _, text in strangers]
    _report_absent(fields, names, wanted, where, problems)
    _report_missing(fields, names, [r for r in required if r not in wanted], where, problems)
    return fields


def _by_other_names(
    strangers: Sequence[tuple[int, str]],
    fields: dict[str, Field],
    required: Sequence[str],
    wanted: ColumnMap,
    where: str,
    problems: Problems,
) -> list[tuple[int, str]]:
    """Add the columns that go by a laboratory's name for them; return the cells that do not.

    What has a column's own name keeps it. Two cells for one column, or one without a unit, are told
    with the line to type, once for all of them.
    """
    known = [(index, text, understood(text)) for index, text in strangers]
    open_ones = [n for n in COLUMNS if n not in fields and n not in wanted]
    unclear: dict[str, list[str]] = {}
    for column in open_ones:
        cells = [(i, t, n.unit) for i, t, n in known if n is not None and n.column == column]
        with_unit = [c for c in cells if c[2] is not None]
        if len(with_unit) == 1:
            index, text, unit = with_unit[0]
            check_unit(COLUMNS[column], unit, f"{where}, column '{text}'", problems)
            fields[column] = Field(index, unit or "")
        elif cells and column in required:
            unclear[column] = [text for _, text, _ in cells]
            fields[column] = Field(cells[0][0], SI_UNITS.get(column, "um"))
    left = [(index, text) for index, text, name in known if name is None]
    if unclear:
        told = (
            f"'{name}' {'has no unit' if len(own) == 1 else 'may be more than one column'}"
            f" ({', '.join(own)})"
            for name, own in unclear.items()
        )
        texts = {name: own[0] for name, own in unclear.items()}
        others = (text for _, text in left if text)
        texts |= {name: next(others, "") for name in required if name not in (*fields, *wanted)}
        line = ready_line({name: texts[name] for name in required if texts.get(name)}, wanted)
        examples = ", ".join(f"'{COLUMNS[name].example}'" for name in unclear)
        problems.add(
            f"{where}: {', '.join(told)}; write {examples} in the header, or say which, and in"
            f" which unit: {line}"
        )
    return left


def ready_line(cells: Mapping[str, str], wanted: ColumnMap | None = None) -> str:
    """Return the option that says which cell of the header is which column; units as usual.

    It holds what `wanted` says already.
    """
    parts = [
        f"{name}={own.array}" + ("" if own.unit is None else f":{own.unit}")
        for name, own in (wanted or {}).items()
    ]
    parts += [f"{name}={own}:{SI_UNITS.get(name, 'um')}" for name, own in cells.items()]
    return f"--columns {','.join(parts)} (with your units)."


def _plain(name: str) -> str:
    return re.sub(r"\s+", "_", name.strip().lower())


def _column_of(own: str, text: str, wanted: ColumnMap) -> str:
    """Return the column that a cell of a header stands for, or its name itself."""
    for name, source in wanted.items():
        if _plain(source.array) in (_plain(own), _plain(text)):
            return name
    return "" if _plain(own) in wanted else _plain(own)


def _agreed_unit(
    name: str, own: str | None, wanted: ColumnMap, where: str, problems: Problems
) -> str:
    """Return the unit that the header or `wanted` gives; the two must not disagree."""
    given = wanted[name].unit if name in wanted else None
    unit = own or given or (SI_UNITS.get(name) if name in wanted else None)
    check_unit(COLUMNS[name], unit, where, problems)
    if own and given and not _same_unit(own, given):
        problems.add(
            f"{where}: the header gives the unit '{own}', --columns gives '{given}'; leave the one "
            f"in --columns out, or correct it."
        )
    return unit or ""


def _same_unit(one: str, other: str) -> bool:
    try:
        return parse_unit(one).name == parse_unit(other).name
    except InputError:
        return True  # the unknown one was told already


def _report_absent(
    fields: Mapping[str, Field],
    strangers: Sequence[str],
    wanted: ColumnMap,
    where: str,
    problems: Problems,
) -> None:
    """Complain of names in `wanted` that the header does not have."""
    for name, source in wanted.items():
        if name not in fields:
            found = ", ".join(filter(None, [*fields, *strangers])) or "nothing"
            problems.add(
                f"{where}: '{source.array}', which --columns names for '{name}', is not in the "
                f"header (found: {found[:120]}); correct --columns."
            )


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
        parsed = parse_unit(unit, column.quantities[0])
    except InputError as error:
        problems.add(f"{where}: {error}")
        return
    compound = not parsed.quantity and any(
        parsed.dimension == parse_unit(units_of(q)[0]).dimension for q in column.quantities
    )
    if parsed.quantity not in column.quantities and not compound:
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
        near[0]: _plain(name)
        for name in strangers
        if (near := difflib.get_close_matches(_plain(name), absent, n=1, cutoff=0.8))
    }
    missing = [name for name in absent if name in required and name not in meant]
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
                f"header as '{COLUMNS[name].example}'{_or_type(name, missing, strangers)}."
            )


def _or_type(name: str, missing: Sequence[str], strangers: Sequence[str]) -> str:
    """Return, behind the last missing column, the option that says which cells are meant."""
    others = [s.strip() for s in strangers if s.strip() and not set(s) & set(",=:[]")]
    if name != missing[-1] or len(others) < len(missing):
        return " (or give --sample-time)" if name == "time" else ""
    line = ready_line(dict(zip(missing, others, strict=False))).removesuffix(".")
    return f", or say which column it is: {line}"


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return not text.strip()
    return True
