"""Columns from CSV files.

A header names each column with its unit, in any order:
`time [s],voltage [V],displacement [um],load_force [N],temperature [degC]`. Laboratories' names for
them are understood (`Time (s)`, `voltage_V`, `pos [um]`), and units in a row below. Where only one
column is in s, V or um, it is the time, the voltage or the displacement under any name but one that
says otherwise. What stands before the header is left alone. Cells are separated by commas,
semicolons, tabs or spaces, as in the header, or as a first line `sep=;` says. A file of numbers
alone needs `wanted` with the columns counted from 1. Missing samples are allowed in `displacement`
(an empty cell or nan).
"""

from collections.abc import Sequence

from psa_casadi.errors import Problems
from psa_casadi.records.read.columns import ColumnMap
from psa_casadi.records.read.csv_table import CsvText, load_text, parse_numbers
from psa_casadi.records.read.header import parse_header
from psa_casadi.records.read.layout import cells_of
from psa_casadi.records.read.samples import Samples


def read_csv(
    path: str, required: Sequence[str], wanted: ColumnMap, problems: Problems
) -> Samples | None:
    """Return the columns of a CSV file, or None where its header names none.

    `wanted` says which name in the header is which column, where they differ. Mistakes are added to
    `problems`, each with file, line and column.

    Raises:
        InputError: the file cannot be read, or is not text.
    """
    return columns_of(load_text(path), required, wanted, problems)


def columns_of(
    text: CsvText, required: Sequence[str], wanted: ColumnMap, problems: Problems
) -> Samples | None:
    """Return the columns of a table of text, or None where its header names none."""
    if not text.header and all(source.array.isdecimal() for source in wanted.values()) and wanted:
        text = text.numbered()
    header = text.header or cells_of(text.rows[0], text.delimiter)
    fields = parse_header(header, required, text.where_header, problems, wanted)
    if not fields:
        return None
    numbers = parse_numbers(text, fields, problems)
    return Samples(
        path=text.path,
        sha256=text.sha256,
        place="line",
        units={name: field.unit for name, field in fields.items()},
        values=numbers.values,
        lines=numbers.lines,
        reported=numbers.reported,
    )
