"""The table over all devices of a batch: CSV, and Parquet where pyarrow is installed."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from psa_casadi.files import atomic_path, atomic_write
from psa_casadi.population.finding import Finding
from psa_casadi.report.documents.files import DeviceFile
from psa_casadi.report.documents.findings import finding_content

CSV, PARQUET = "summary.csv", "summary.parquet"
#: Columns that hold no numbers.
_TEXTS = ("device", "batch", "date", "work", "status", "verdict", "cause", "problems")


def write_summary(
    folder: Path, rows: Iterable[tuple[DeviceFile, Finding | None]]
) -> tuple[Path, ...]:
    """Write the tables of devices; return the files.

    A parameter has the columns `NAME [UNIT]`, `NAME low` and `NAME high` (95 % interval, SI units),
    empty where the records of a device do not determine it.
    """
    table = [_row(told, found) for told, found in rows]
    columns = list(dict.fromkeys(name for row in table for name in row))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([_cell(row.get(name)) for name in columns] for row in table)
    atomic_write(folder / CSV, text.getvalue())
    if find_spec("pyarrow") is None:
        return (folder / CSV,)
    _write_parquet(folder / PARQUET, columns, table)
    return (folder / CSV, folder / PARQUET)


def _row(told: DeviceFile, found: Finding | None) -> dict[str, Any]:
    row = {
        "device": told.device,
        "batch": told.batch,
        "date": told.date,
        "work": told.work,
        "status": told.status,
        "seconds": told.seconds,
        "problems": " ".join(told.problems),
    }
    return row if found is None else {**row, **finding_content(found)}


def _cell(value: object) -> str:
    if value is None:
        return ""
    return repr(value) if isinstance(value, float) else str(value)


def _write_parquet(path: Path, columns: Sequence[str], table: Sequence[Mapping[str, Any]]) -> None:
    arrow, parquet = import_module("pyarrow"), import_module("pyarrow.parquet")
    arrays = {
        name: arrow.array(
            [row.get(name) for row in table],
            type=arrow.string() if name in _TEXTS else arrow.float64(),
        )
        for name in columns
    }
    with atomic_path(path) as temporary:
        parquet.write_table(arrow.table(arrays), temporary)
