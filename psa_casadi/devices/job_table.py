"""The table of jobs, jobs.csv: device, and where they are known batch, date and files.

    device,batch,date,files
    A1,2026-03,2026-03-14,A1/slow.csv;A1/fast.csv

Files lie beside the table or in folders below it, with semicolons between. Without the column, the
records of a device are its folder or the file of its name. Rows of one device are joined.
"""

import csv
import io
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import date, datetime
from pathlib import Path

from psa_casadi.characters import plain
from psa_casadi.errors import InputError, Problems

COLUMNS = ("device", "batch", "date", "files")
_MOST_BYTES = 2**24


@dataclass(frozen=True)
class JobRow:
    """One line of the table."""

    line: int
    device: str
    batch: str
    day: date | None
    files: tuple[str, ...]


def job_rows(path: Path, problems: Problems) -> Iterator[JobRow]:
    """Yield the rows of a table of jobs; `problems` gets the mistakes of its lines.

    Raises:
        InputError: the table cannot be read or has no column `device`, or another one.
    """
    reader = csv.reader(io.StringIO(_text(path)), skipinitialspace=True)
    head = [name.strip().lower() for name in next(reader, [])]
    strange = [name for name in head if name not in COLUMNS]
    if "device" not in head or strange or len(set(head)) < len(head):
        raise InputError(
            f"{path}: the first line is '{','.join(head)[:80]}'; a table of jobs has the columns"
            f" {', '.join(COLUMNS)}, of which only the first must be there, each once."
        )
    for cells in reader:
        if not any(cell.strip() for cell in cells):
            continue
        line = reader.line_num
        if len(cells) != len(head):
            problems.add(
                f"{path} line {line}: {len(cells)} cells for {len(head)} columns; quote cells with"
                " commas, and put semicolons between files."
            )
            continue
        row = {name: plain(cell.strip()) for name, cell in zip(head, cells, strict=True)}
        day = _day(row.get("date", ""), f"{path} line {line}", problems)
        yield JobRow(line, row["device"], row.get("batch", ""), day, _files(row))


def _text(path: Path) -> str:
    try:
        with path.open("rb") as stream:
            data = stream.read(_MOST_BYTES + 1)
        if len(data) > _MOST_BYTES:
            raise InputError(f"{path}: is larger than any table of jobs; give another file.")
        return data.decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path}: cannot be read as a table of jobs ({error}); save it as CSV in UTF-8."
        ) from error


def _files(row: Mapping[str, str]) -> tuple[str, ...]:
    return tuple(name.strip() for name in row.get("files", "").split(";") if name.strip())


def _day(text: str, where: str, problems: Problems) -> date | None:
    if not text:
        return None
    try:
        return datetime.fromisoformat(text).date()
    except ValueError:
        problems.add(f"{where}: the date is '{text}'; write it as 2026-03-14.")
        return None
