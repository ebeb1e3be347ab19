"""The header of a table: which cell names which column, and in which unit."""

import re
from collections.abc import Mapping, Sequence

from psa_casadi.errors import InputError, Problems
from psa_casadi.records.read.candidates import Cell, cell_of, decided
from psa_casadi.records.read.columns import (
    COLUMNS,
    SI_UNITS,
    ColumnMap,
    Field,
    check_unit,
    ready_line,
    usual_source,
)
from psa_casadi.records.read.header_names import stated_unit, unit_for
from psa_casadi.records.read.open_columns import (
    Others,
    missing_columns,
    misspelled,
    plain,
    report_absent,
    report_open,
)
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
    return _parsed(texts, required, where, problems, wanted or {})[0]


def guessed_header(texts: Sequence[str], required: Sequence[str]) -> Mapping[str, Field]:
    """Return the columns that a header names, and those that it would be asked for as it has them.

    Mistakes are not told.
    """
    fields, sources = _parsed(texts, required, "", Problems(), {})
    names = [name for name, _ in named_columns(texts)]
    asked = {n: Field(names.index(s.array), s.unit or "") for n, s in sources.items()}
    return {**fields, **asked}


def _parsed(
    texts: Sequence[str],
    required: Sequence[str],
    where: str,
    problems: Problems,
    wanted: ColumnMap,
) -> tuple[Mapping[str, Field], ColumnMap]:
    """Return the columns of a header, and what is suggested for those that are open."""
    counted = bool(wanted) and all(source.array in texts for source in wanted.values())
    if all(_is_number(text) for text in texts) and not counted:
        example = ",".join(COLUMNS[name].example for name in required)
        numbered = {name: usual_source(name, str(k)) for k, name in enumerate(required, 1)}
        problems.add(
            f"{where}: found '{','.join(texts)[:60]}', expected a header; write a first line such "
            f"as '{example}', or say which column is which: {ready_line(numbered)}."
        )
        return {}, {}
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
            stated = unit_for(name, own) if match["unit"] is None and name in wanted else None
            unit = _agreed_unit(name, match["unit"] or stated, wanted, place, problems)
            fields[name] = Field(index, unit)
    named = _by_other_names(strangers, fields, required, wanted, where, problems)
    report_absent(fields, named.left, wanted, where, problems)
    missing = missing_columns(fields, named.left, required, wanted, where, problems)
    return fields, report_open(named, missing, fields, wanted, where, problems)


def named_columns(texts: Sequence[str]) -> list[tuple[str, str | None]]:
    """Return of every cell of a header its name for `--columns` and its unit, None without one."""
    cells = [text.strip() for text in texts]
    return [(_name_of(t), _unit_of(t) or stated_unit(t)) for t in cells]


def _by_other_names(
    strangers: Sequence[tuple[int, str]],
    fields: dict[str, Field],
    required: Sequence[str],
    wanted: ColumnMap,
    where: str,
    problems: Problems,
) -> Others:
    """Add the columns that go by a laboratory's name for them, or by the unit that only one has.

    What has a column's own name keeps it, and what has it misspelled is nothing else.
    """
    cells = [cell_of(text, _name_of(text)) for _, text in strangers]
    absent = [n for n in COLUMNS if n not in fields]
    spelled = [c for c in cells if c.column is not None or not misspelled(c, absent)]
    unclear: dict[str, list[Cell]] = {}
    taken: list[Cell] = []
    for column in [n for n in absent if n not in wanted]:
        is_required = column in required
        one, several = decided(column, spelled, by_unit=is_required)
        may_be = [spelled[k] for k in (several if one is None else (one,))]
        if not may_be or (one is None and not is_required):
            continue
        index, unit = strangers[cells.index(may_be[0])][0], may_be[0].unit
        if one is None:
            unclear[column] = may_be
        else:
            check_unit(COLUMNS[column], unit, f"{where}, column '{may_be[0].text}'", problems)
            taken += may_be
        fields[column] = Field(index, unit or SI_UNITS.get(column, "um"))
    return Others([c for c in cells if c not in taken], unclear)


def _column_of(own: str, text: str, wanted: ColumnMap) -> str:
    """Return the column that a cell of a header stands for, or its name itself."""
    for name, source in wanted.items():
        if plain(source.array) in (plain(own), plain(text)):
            return name
    return "" if plain(own) in wanted else plain(own)


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


def _name_of(text: str) -> str:
    match = _HEADER.fullmatch(text)
    return (match["name"] if match else text).strip()


def _unit_of(text: str) -> str | None:
    match = _HEADER.fullmatch(text)
    return match["unit"] if match else None


def _is_number(text: str) -> bool:
    try:
        float(text.replace(",", "."))
    except ValueError:
        return not text.strip()
    return True
