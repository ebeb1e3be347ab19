"""Records from CSV files: read, checked as a whole, converted to SI units.

A header names each column with its unit in brackets, in any order:
`time [s],voltage [V],displacement [um],load_force [N],temperature [degC]`. Lines before it that
begin with # are comments. Missing samples are allowed in `displacement` (an empty cell or nan).
"""

import os
from collections.abc import Iterable, Mapping
from pathlib import Path

from psa_casadi.errors import InputError, Problems
from psa_casadi.experiment.checks import (
    Located,
    check_complete,
    check_displacement,
    check_excitation,
    check_length,
    check_time,
)
from psa_casadi.experiment.columns import Field, parse_header
from psa_casadi.experiment.csv_table import CsvText, Numbers, load_text, parse_numbers
from psa_casadi.experiment.record import Record
from psa_casadi.units import FloatArray, parse_unit, to_si

AnyPath = str | os.PathLike[str]


def read_record(
    path: AnyPath, *, need_displacement: bool = True, need_excitation: bool = False
) -> Record:
    """Return the record in one CSV file.

    `need_displacement` demands a displacement column with values, as a comparison does;
    `need_excitation` a voltage that changes, as a fit does.

    Raises:
        InputError: every mistake found in the file, one sentence each: file, line, column, what was
            found, what was expected, what to do. At most 20 are listed, the others counted.
    """
    problems = Problems()
    text = load_text(path)
    required = ("time", "voltage", *(("displacement",) if need_displacement else ()))
    fields = parse_header(text.header, required, text.where_header, problems)
    if fields:
        numbers = parse_numbers(text, fields, problems)
        _check(text.path, fields, numbers, problems, need_excitation=need_excitation)
    problems.raise_if_any()
    return _record(text, fields, numbers)


def read_records(
    paths: Iterable[AnyPath], *, need_displacement: bool = True, need_excitation: bool = False
) -> tuple[Record, ...]:
    """Return the records in several CSV files, which are experiments on the same device.

    Raises:
        InputError: the mistakes of all files together, or no file was named.
    """
    records: list[Record] = []
    problems: list[str] = []
    for path in paths:
        try:
            records.append(
                read_record(
                    path, need_displacement=need_displacement, need_excitation=need_excitation
                )
            )
        except InputError as error:
            problems.extend(error.problems)
    if not records and not problems:
        problems.append("no record was named; name at least one CSV file.")
    if problems:
        raise InputError(problems)
    return tuple(records)


def _check(
    path: str,
    fields: Mapping[str, Field],
    numbers: Numbers,
    problems: Problems,
    *,
    need_excitation: bool,
) -> None:
    check_length(path, len(numbers.lines), problems)
    for k, name in enumerate(fields):
        column = Located(path, name, numbers.values[:, k], numbers.lines, numbers.reported[:, k])
        if name == "time":
            check_time(column, problems)
        elif name == "displacement":
            check_displacement(column, problems)
        else:
            check_complete(column, problems)
        if name == "voltage" and need_excitation:
            check_excitation(column, problems)


def _record(text: CsvText, fields: Mapping[str, Field], numbers: Numbers) -> Record:
    columns = {
        name: to_si(numbers.values[:, k], field.unit)
        for k, (name, field) in enumerate(fields.items())
    }

    def optional(name: str) -> FloatArray | None:
        return columns.get(name)

    in_counts = "displacement" in fields and parse_unit(fields["displacement"].unit).counts
    return Record(
        name=Path(text.path).stem,
        time=columns["time"],
        voltage=columns["voltage"],
        displacement=optional("displacement"),
        load_force=optional("load_force"),
        current=optional("current"),
        temperature=optional("temperature"),
        sha256=text.sha256,
        source=text.path,
        displacement_unit="counts" if in_counts else "m",
    )
