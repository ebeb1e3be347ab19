"""The jobs of a batch: a device with its records, from a folder, a table or Python.

The table of jobs, jobs.csv: device, and where they are known batch, date and files.

    device,batch,date,files
    A1,2026-03,2026-03-14,A1/slow.csv;A1/fast.csv

Files lie beside the table or in folders below it, with semicolons between. Without the column, the
records of a device are its folder or the file of its name. Rows of one device are joined.
"""

import csv
import hashlib
import io
import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import date, datetime
from pathlib import Path

from psa_casadi.characters import plain
from psa_casadi.errors import InputError, Problems
from psa_casadi.identification.start.ordinary import Hysteresis
from psa_casadi.records.read.binary import READERS
from psa_casadi.report.documents.device_file import Status, Work
from psa_casadi.version import __version__

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


#: The table of jobs that is looked for in a folder of records.
TABLE = "jobs.csv"
#: Endings of files that are records; text of other endings is named in a table.
ENDINGS = (".csv", ".txt", ".dat", ".lvm", *READERS)
#: What a device may not be called, since its results are a folder of that name.
_BARRED = re.compile(r'[\x00-\x1f\x7f<>:"/\\|?*]|^[. ]|[. ]$')
_RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)
_LONGEST = 100


@dataclass(frozen=True)
class Job:
    """One device: its name, the files of its records, and where it comes from.

    `batch` is the production batch and `day` the date of the device or of its measurement; "" and
    None where they are not known.
    """

    device: str
    files: tuple[str, ...]
    batch: str = ""
    day: date | None = None


#: What stands for the jobs: a folder of records, a table of jobs, or jobs.
Jobs = str | os.PathLike[str] | Iterable[Job]


def jobs_given(given: Jobs) -> tuple[Job, ...]:
    """Return the jobs of a folder, a table or a list, in their order.

    In a folder with `jobs.csv` that is the table; else every folder in it is a device with all
    records inside, and so is every record beside them.

    Raises:
        InputError: every mistake: no records, names that two devices have or that no folder can
            have, files that do not exist.
    """
    found = _of_path(Path(given)) if isinstance(given, str | os.PathLike) else tuple(given)
    problems = Problems()
    _check_names(found, problems)
    for job in found:
        if not job.files:
            problems.add(f"device '{job.device}' has no records; name files, or leave it out.")
        for name in job.files:
            if not Path(name).is_file():
                problems.add(f"device '{job.device}': there is no file {name}; correct its name.")
    if not found:
        problems.add("there is no device; give a folder of records, or a table of jobs.")
    problems.raise_if_any()
    return found


def _of_path(path: Path) -> tuple[Job, ...]:
    if path.is_file():
        return _of_table(path)
    if not path.is_dir():
        raise InputError(f"{path}: there is no such folder or table of jobs; correct its name.")
    if (path / TABLE).is_file():
        return _of_table(path / TABLE)
    jobs = []
    for entry in sorted(path.iterdir()):
        files = _records_in(entry) if entry.is_dir() else [entry] if _is_record(entry) else []
        if files:
            device = entry.name if entry.is_dir() else entry.stem
            jobs.append(Job(device, tuple(str(f) for f in files)))
    if not jobs:
        raise InputError(
            f"{path}: holds no records; give a folder with a folder or file for each device,"
            f" or with {TABLE}."
        )
    return tuple(jobs)


def _of_table(path: Path) -> tuple[Job, ...]:
    """Return the jobs of a table; rows of one device are joined."""
    jobs: dict[str, Job] = {}
    problems = Problems()
    for row in job_rows(path, problems):
        files = tuple(str(path.parent / name) for name in row.files) or _usual(path, row.device)
        known = jobs.get(row.device)
        if known is None:
            jobs[row.device] = Job(row.device, files, row.batch, row.day)
        elif (known.batch, known.day) != (row.batch, row.day):
            problems.add(
                f"{path} line {row.line}: device '{row.device}' has another batch or date than"
                " before; give a device one of each."
            )
        else:
            jobs[row.device] = Job(row.device, (*known.files, *files), row.batch, row.day)
    problems.raise_if_any()
    return tuple(jobs.values())


def _usual(table: Path, device: str) -> tuple[str, ...]:
    """Return the records that have a device's name beside its table: a folder, or a file."""
    folder = table.parent / device
    if folder.is_dir():
        return tuple(str(f) for f in _records_in(folder))
    if not folder.parent.is_dir() or _BARRED.search(device):
        return ()
    return tuple(
        str(f) for f in sorted(table.parent.iterdir()) if f.stem == device and _is_record(f)
    )


def _records_in(folder: Path) -> Sequence[Path]:
    return [f for f in sorted(folder.iterdir()) if _is_record(f)]


def _is_record(path: Path) -> bool:
    hidden = path.name.startswith(".") or path.name == TABLE
    return path.is_file() and not hidden and path.suffix.lower() in ENDINGS


def _check_names(jobs: Sequence[Job], problems: Problems) -> None:
    seen: set[str] = set()
    for job in jobs:
        name = job.device
        unfit = not name or _BARRED.search(name) or _RESERVED.fullmatch(name)
        if unfit or len(name) > _LONGEST:
            problems.add(
                f"device {name[:_LONGEST]!r}: no folder can have this name on every system; use up"
                f" to {_LONGEST} letters, digits, spaces, '-', '_' and dots inside."
            )
        if name.casefold() in seen:
            problems.add(
                f"device '{name}' is there twice (small and capital letters count as the same);"
                " rename one of them."
            )
        seen.add(name.casefold())


_BLOCK = 2**20


@dataclass(frozen=True)
class Options:
    """How every device is worked on; plain values, so that a process elsewhere can take them.

    `model` is the text of the MODEL.json to start from, `stiffness` in N/m, `columns` and
    `sample_time` [s] as for `read_record`, `modules` those that hold own effects.
    """

    work: Work = "identify"
    model: str | None = None
    stiffness: float | None = None
    hysteresis: Hysteresis | None = None
    columns: str | None = None
    sample_time: float | None = None
    modules: tuple[str, ...] = ()


@dataclass(frozen=True)
class DeviceTask:
    """One device with all that its work needs; `run` names the run that it belongs to."""

    job: Job
    options: Options
    run: str


@dataclass(frozen=True)
class DeviceOutcome:
    """How the work on a device ended: files by their names, or problems in sentences."""

    device: str
    status: Status
    seconds: float
    files: tuple[tuple[str, str], ...] = ()
    problems: tuple[str, ...] = ()
    records: tuple[tuple[str, str], ...] = ()


def key_of(job: Job, options: Options) -> str:
    """Return the SHA-256 of a device's files, the options, and the version of this package.

    Raises:
        OSError: a file cannot be read.
    """
    files = [(Path(name).name, _hash(Path(name))) for name in job.files]
    told = {"version": __version__, "options": asdict(options), "files": files}
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()


def _hash(path: Path) -> str:
    found = hashlib.sha256()
    with path.open("rb") as stream:
        while block := stream.read(_BLOCK):
            found.update(block)
    return found.hexdigest()
