"""The jobs of a batch: a device with its records, from a folder, a table or Python.

The table of jobs, jobs.csv: device, and where they are known batch, date and files.

    device,batch,date,files
    A1,2026-03,2026-03-14,A1/slow.csv;A1/fast.csv

Files lie next to the table or in folders below it, with semicolons between. Without the column, the
records of a device are its folder or the file of its name. Rows of one device are joined.
"""

import csv
import io
import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import date, datetime
from hashlib import sha256
from pathlib import Path
from typing import Any, get_args

from psa_casadi.common.characters import plain
from psa_casadi.common.errors import InputError, Problems
from psa_casadi.documents.files import Status, Work
from psa_casadi.identification.start.ordinary import Hysteresis
from psa_casadi.model.compose import Model
from psa_casadi.model.user_effects import declaration_hash
from psa_casadi.records.read.formats import READERS
from psa_casadi.version import __version__

COLUMNS = ("device", "batch", "date", "files")
_MOST_BYTES = 2**24
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


#: What a user may pass as jobs: a folder of records, a table of jobs, or jobs.
Jobs = str | os.PathLike[str] | Iterable[Job]


def jobs_given(inputs: Jobs) -> tuple[Job, ...]:
    """Return the jobs of a folder, a table or a list, in their order.

    In a folder with `jobs.csv` that is the table; else every folder in it is a device with all
    records inside, and so is every record next to them.

    Raises:
        InputError: every mistake: no records, names that two devices have or that no folder can
            have, files that do not exist.
    """
    jobs = _of_path(Path(inputs)) if isinstance(inputs, str | os.PathLike) else tuple(inputs)
    problems = Problems()
    _check_names(jobs, problems)
    for job in jobs:
        if not job.files:
            problems.add(f"device '{job.device}' has no records; name files, or leave it out.")
        for name in job.files:
            if not Path(name).is_file():
                problems.add(f"device '{job.device}': there is no file {name}; correct its name.")
    if not jobs:
        problems.add("there is no device; give a folder of records, or a table of jobs.")
    problems.raise_if_any()
    return jobs


def _of_path(path: Path) -> tuple[Job, ...]:
    if path.is_file():
        return _of_table(path)
    if not path.is_dir():
        raise InputError(f"{path}: there is no such folder or table of jobs; correct its name.")
    if (path / TABLE).is_file():
        return _of_table(path / TABLE)
    entries = sorted(path.iterdir())
    jobs = tuple(Job(_named(e), files) for e in entries if (files := _records_of(e)))
    if not jobs:
        raise InputError(
            f"{path}: holds no records; give a folder with a folder or file for each device,"
            f" or with {TABLE}."
        )
    return jobs


def _of_table(path: Path) -> tuple[Job, ...]:
    """Return the jobs of a table; rows of one device are joined."""
    jobs: dict[str, Job] = {}
    problems = Problems()
    for where, row in _rows(path, problems):
        device, names = row["device"], [n.strip() for n in row.get("files", "").split(";")]
        files = tuple(str(path.parent / n) for n in names if n) or _usual(path, device)
        job = Job(device, files, row.get("batch", ""), _day(row.get("date"), where, problems))
        known = jobs.setdefault(device, job)
        if (known.batch, known.day) != (job.batch, job.day):
            problems.add(
                f"{where}: device '{device}' has another batch or date than before; give a device"
                " one of each."
            )
        elif known is not job:
            jobs[device] = replace(known, files=(*known.files, *files))
    problems.raise_if_any()
    return tuple(jobs.values())


def _rows(path: Path, problems: Problems) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield the rows of a table by their columns, each with its place.

    Raises:
        InputError: the table cannot be read or has no column `device`, or another one.
    """
    reader = csv.reader(io.StringIO(_text(path)), skipinitialspace=True)
    head = [name.strip().lower() for name in next(reader, [])]
    if "device" not in head or set(head) - set(COLUMNS) or len(set(head)) < len(head):
        raise InputError(
            f"{path}: the first line is '{','.join(head)[:80]}'; a table of jobs has the columns"
            f" {', '.join(COLUMNS)}, of which only the first must be there, each once."
        )
    for cells in reader:
        where = f"{path} line {reader.line_num}"
        if len(cells) == len(head):
            yield where, {n: plain(c.strip()) for n, c in zip(head, cells, strict=True)}
        elif any(cell.strip() for cell in cells):
            problems.add(
                f"{where}: {len(cells)} cells for {len(head)} columns; quote cells with commas,"
                " and put semicolons between files."
            )


def _text(path: Path) -> str:
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise InputError(f"{path}: is larger than any table of jobs; give another file.")
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path}: cannot be read as a table of jobs ({error}); save it as CSV in UTF-8."
        ) from error


def _day(text: str | None, where: str, problems: Problems) -> date | None:
    try:
        return datetime.fromisoformat(text).date() if text else None
    except ValueError:
        problems.add(f"{where}: the date is '{text}'; write it as 2026-03-14.")
        return None


def _usual(table: Path, device: str) -> tuple[str, ...]:
    """Return the records that have a device's name next to its table: a folder, or a file."""
    if _BARRED.search(device):
        return ()
    files = sorted(f for f in table.parent.iterdir() if f.is_file() and _named(f) == device)
    return _records_of(table.parent / device) or tuple(n for f in files for n in _records_of(f))


def _named(place: Path) -> str:
    """Return the device that a folder or a file is named after."""
    return place.name if place.is_dir() else Path(place.name.removesuffix(".gz")).stem


def _records_of(place: Path) -> tuple[str, ...]:
    """Return the records in a folder, or the file if it is one."""
    return tuple(
        str(f)
        for f in (sorted(place.iterdir()) if place.is_dir() else [place])
        if f.is_file()
        and not f.name.startswith(".")
        and f.name != TABLE
        and Path(f.name.lower().removesuffix(".gz")).suffix in ENDINGS
    )


def _check_names(jobs: Sequence[Job], problems: Problems) -> None:
    texts: set[str] = set()
    for job in jobs:
        name = job.device
        unfit = not name or _BARRED.search(name) or _RESERVED.fullmatch(name)
        if unfit or len(name) > _LONGEST:
            problems.add(
                f"device {name[:_LONGEST]!r}: no folder can have this name on every system; use up"
                f" to {_LONGEST} letters, digits, spaces, '-', '_' and dots inside."
            )
        if name.casefold() in texts:
            problems.add(
                f"device '{name}' is there twice (small and capital letters count as the same);"
                " rename one of them."
            )
        texts.add(name.casefold())


@dataclass(frozen=True)
class Options:
    """How every device is worked on; plain values, so that a process elsewhere can take them.

    `model` is the text of the MODEL.json to start from, or a model; `stiffness` in N/m, `columns`
    and `sample_time` [s] as for `read_record`, `modules` those that hold the user's effects.
    `words` are those that `identify` and `diagnose` take with a model that is no stack, such as
    `known_start`.
    """

    work: Work = "identify"
    model: str | Model | None = None
    stiffness: float | None = None
    hysteresis: Hysteresis | None = None
    columns: str | None = None
    sample_time: float | None = None
    modules: tuple[str, ...] = ()
    words: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Demand a known work. Raises InputError."""
        if self.work not in get_args(Work):
            known = " or ".join(f"'{w}'" for w in get_args(Work))
            raise InputError(f"`work` is '{self.work}'; give {known}.")


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
    files = [(Path(f).name, sha256(Path(f).read_bytes()).hexdigest()) for f in job.files]
    model = options.model
    if isinstance(model, Model):  # by its content, as a text is
        hashes = [declaration_hash(c) for c in model.components]
        model = repr((hashes, sorted(model.values.items())))
    content = asdict(replace(options, model=model))
    table = {"version": __version__, "options": content, "files": files}
    return sha256(json.dumps(table, sort_keys=True).encode()).hexdigest()
