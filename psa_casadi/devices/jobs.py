"""The jobs of a batch: a device with its records, from a folder, a table or Python."""

import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path

from psa_casadi.devices.job_table import job_rows
from psa_casadi.errors import InputError, Problems
from psa_casadi.records.read.formats import READERS

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
