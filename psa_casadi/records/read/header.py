"""The header of a table: which cell names which column, and in which unit."""

import difflib
import re
from collections.abc import Mapping, Sequence

from psa_casadi.errors import InputError, Problems
from psa_casadi.records.read.columns import (
    COLUMNS,
    SI_UNITS,
    ColumnMap,
    Field,
    check_unit,
    ready_line,
    usual_source,
)
from psa_casadi.records.read.header_names import understood
from psa_casadi.units import parse_unit

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
        numbered = {name: usual_source(name, str(k)) for k, name in enumerate(required, 1)}
        problems.add(
            f"{where}: found '{','.join(texts)[:60]}', expected a header; write a first line such "
            f"as '{example}', or say which column is which: {ready_line(numbered)}."
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
    others, unclear = _by_other_names(strangers, fields, required, wanted, where, problems)
    _report_absent(fields, others, wanted, where, problems)
    missing = _missing(fields, others, required, wanted, where, problems)
    _report_open(unclear, missing, (fields, others), wanted, where, problems)
    return fields


def named_columns(texts: Sequence[str]) -> list[tuple[str, str | None]]:
    """Return of every cell of a header the name and the unit in brackets, None without one."""
    return [(_name_of(text.strip()), _unit_of(text.strip())) for text in texts]


def _by_other_names(
    strangers: Sequence[tuple[int, str]],
    fields: dict[str, Field],
    required: Sequence[str],
    wanted: ColumnMap,
    where: str,
    problems: Problems,
) -> tuple[list[str], dict[str, list[str]]]:
    """Add the columns that go by a laboratory's name for them.

    What has a column's own name keeps it. Return the cells that are no column, and by the name of
    a column those that may be it: two of them, or one without a unit.
    """
    known = [(index, text, understood(text)) for index, text in strangers]
    unclear: dict[str, list[str]] = {}
    for column in [n for n in COLUMNS if n not in fields and n not in wanted]:
        cells = [(i, t, n.unit) for i, t, n in known if n is not None and n.column == column]
        with_unit = [c for c in cells if c[2] is not None]
        if len(with_unit) == 1:
            index, text, unit = with_unit[0]
            check_unit(COLUMNS[column], unit, f"{where}, column '{text}'", problems)
            fields[column] = Field(index, unit or "")
        elif cells and column in required:
            unclear[column] = [text for _, text, _ in cells]
            fields[column] = Field(cells[0][0], SI_UNITS.get(column, "um"))
    return [text for _, text, name in known if name is None], unclear


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
    source = wanted.get(name)
    given = source.unit if source else None
    if source and source.scale is not None:  # of the header's unit, as a sensor's volts
        return given or ""
    unit = own or given or (SI_UNITS.get(name) if name in wanted else None)
    check_unit(COLUMNS[name], unit, where, problems)
    if own and given and not _same_unit(own, given):
        problems.add(
            f"{where}: the header gives the unit '{own}', --columns gives '{given}'; leave the one "
            f"in --columns out, or say there what 1 in the file is, such as 10{given}."
        )
    return unit or ""


def _same_unit(one: str, other: str) -> bool:
    try:
        return parse_unit(one).name == parse_unit(other).name
    except InputError:
        return True  # the unknown one was told already


def _report_absent(
    fields: Mapping[str, Field],
    others: Sequence[str],
    wanted: ColumnMap,
    where: str,
    problems: Problems,
) -> None:
    """Complain of names in `wanted` that the header does not have."""
    for name, source in wanted.items():
        if name not in fields:
            found = ", ".join(filter(None, [*fields, *map(_name_of, others)])) or "nothing"
            problems.add(
                f"{where}: '{source.array}', which --columns names for '{name}', is not in the "
                f"header (found: {found[:120]}); correct --columns."
            )


def _missing(
    fields: Mapping[str, Field],
    others: Sequence[str],
    required: Sequence[str],
    wanted: ColumnMap,
    where: str,
    problems: Problems,
) -> list[str]:
    """Complain of columns that seem to be misspelled; return the others that are missing."""
    absent = [name for name in COLUMNS if name not in fields]
    misspelled = {}
    for name in map(_name_of, others):
        for near in difflib.get_close_matches(_plain(name), absent, n=1, cutoff=0.8):
            misspelled[near] = _plain(name)
    for name, found in misspelled.items():
        problems.add(
            f"{where}: the column '{found}' is unknown; if '{name}' is meant, correct "
            f"the header to '{COLUMNS[name].example}', else give it a less similar name."
        )
    needed = [name for name in required if name not in wanted]
    return [name for name in absent if name in needed and name not in misspelled]


def _report_open(
    unclear: Mapping[str, Sequence[str]],
    missing: Sequence[str],
    header: tuple[Mapping[str, Field], Sequence[str]],
    wanted: ColumnMap,
    where: str,
    problems: Problems,
) -> None:
    """Tell of columns that are unclear or missing, with the option for all of them at the end.

    `header` holds the columns that are known and the cells that are none.
    """
    fields, others = header
    told = []
    if unclear:
        which = ", ".join(
            f"'{name}' {'has no unit' if len(own) == 1 else 'may be more than one column'}"
            f" ({', '.join(own)})"
            for name, own in unclear.items()
        )
        examples = ", ".join(f"'{COLUMNS[name].example}'" for name in unclear)
        told.append(f"{where}: {which}; write {examples} in the header")
    found = ", ".join([*fields, *filter(None, map(_name_of, others))]) or "nothing"
    told += [
        f"{where}: the column '{name}' is missing (found: {found[:120]}); add it to the header as "
        f"'{COLUMNS[name].example}'{' (or give --sample-time)' if name == 'time' else ''}"
        for name in missing
    ]
    sources = {name: usual_source(name, own[0]) for name, own in unclear.items()}
    typed = [t for t in others if _name_of(t) and not set(_name_of(t)) & set(",=:[]")]
    if len(typed) >= len(missing):
        pairs = zip(missing, typed, strict=False)
        sources |= {name: usual_source(name, _name_of(t), _unit_of(t)) for name, t in pairs}
    if sources:
        ordered = {name: sources[name] for name in COLUMNS if name in sources}
        how = "say which column it is" if missing else "say which, and in which unit"
        told[-1] += f", or {how}: {ready_line({**wanted, **ordered})}"
    for sentence in told:
        problems.add(f"{sentence}.")


def _name_of(text: str) -> str:
    match = _HEADER.fullmatch(text)
    return (match["name"] if match else text).strip()


def _unit_of(text: str) -> str | None:
    match = _HEADER.fullmatch(text)
    return match["unit"] if match else None


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return not text.strip()
    return True
