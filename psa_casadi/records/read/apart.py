"""Binary files are read in a separate process, with limits of time and memory.

A damaged file may crash the library that reads it, fill the memory or never end. The process gets
the path and leaves the numbers in a file of a temporary folder: no record passes through a pipe.
"""

import hashlib
import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from itertools import zip_longest
from pathlib import Path

import msgspec
import numpy as np

from psa_casadi.common.children import end_with_parent, heard, started_python
from psa_casadi.common.errors import InputError, Problems
from psa_casadi.common.files import temporary_folder
from psa_casadi.records.read.choose import Request
from psa_casadi.records.read.columns import MARKS, WORDS, Field, stated_unit
from psa_casadi.records.read.formats import READERS, ending_of
from psa_casadi.records.read.samples import Head, Outcome, samples_of
from psa_casadi.records.read.table import Table, check_there, parts_of_file, read_text
from psa_casadi.records.read.text import decoded, text_tables


@dataclass(frozen=True)
class FileTask:
    """The work of the other process: numbers go to the folder `out`, or `count` rows to the head.

    `memory` [bytes] is the most that the process may take.
    """

    path: str
    request: Request
    out: str = ""
    count: int = 0
    memory: int = 0


def head_of_tables(path: str, tables: Sequence[Table], count: int, request: Request) -> Head:
    """Return the head of one of the tables of a file, of the first where none is named."""
    if not tables:
        raise InputError(f"{path}: holds no header and no data; export the record again.")
    parts = parts_of_file(tables)
    one = parts.get(request.table, tables[0])
    choice = request.chosen(one, Problems())
    guess = dict(choice.fields)
    labels = list(one.labels)
    for name, source in choice.sources.items() if not one.headless else ():
        if source.array in labels:
            guess[name] = Field(labels.index(source.array), source.unit or "")
    units = tuple(stated_unit(text) or "" for text in one.header)
    names = tuple("" if MARKS.search(label) else label for label in one.labels)
    columns = [
        [f"{c:.9g}" for c in cells[:count]]
        if isinstance(cells, np.ndarray) and cells.dtype.kind in "biuf"
        else [str(c)[:40] for c in cells[:count]]
        for cells in one.glance
    ]
    rows = tuple(zip_longest(*columns, fillvalue=""))
    return Head(names, units, rows, guess, tuple(parts) if len(parts) > 1 else ())


#: Time [s] that any file may take, and more for each MiB of it; memory [bytes], and more for each
#: byte of the file: a workbook of 100 MiB takes 1.1 GiB, and 1 GiB of numbers is copied once.
_TIME, _TIME_PER_MIB = 30.0, 3.0
_MEMORY, _MEMORY_PER_BYTE = 3 * 2**30, 12
_MODULE = "psa_casadi.records.read.apart"


def read(path: str, request: Request) -> Outcome:
    """Return what `samples_of` returns of a file, with the file's SHA-256.

    Raises:
        InputError: the file is missing, empty, too large, damaged, or needs a package that is not
            installed.
        MachineError: the other process cannot be started.
    """
    if not ending_of(path):
        tables, digest = text_of(path)
        return replace(samples_of(path, tables, request), sha256=digest)
    with temporary_folder() as folder:
        outcome = read_apart(FileTask(path, request, str(folder)))
        if outcome.units:
            outcome.values = np.load(folder / "values.npy")
        return outcome


def head_of(path: str | Path, count: int = 8, table: str = "", names: tuple[str, ...] = ()) -> Head:
    """Return the head of a file with its first `count` rows; its numbers are not checked.

    `names` are the inputs and outputs of the model that the file is a record of; none for a stack.

    Raises:
        InputError, MachineError: as `read`.
    """
    place = str(path)
    request = Request(table=table, names=names, needed=names or Request.needed)
    if not ending_of(place):
        return head_of_tables(place, text_of(place)[0], count, request)
    outcome = read_apart(FileTask(place, request, count=count))
    if outcome.head is None:
        raise InputError(outcome.problems)
    return outcome.head


def text_of(path: str) -> tuple[Sequence[Table], str]:
    """Return the tables of a file of text and its SHA-256.

    Raises:
        InputError: the file is missing, too large, damaged, or no text.
    """
    check_there(path)
    kind = WORDS["exports"].get(Path(path).suffix.lower())
    content, digest = read_text(path)
    if kind and b"\0" in content[:4096]:
        raise InputError(f"{path}: is {kind}; export the record as CSV and name that file.")
    text = decoded(content, path).replace("\r\n", "\n").replace("\r", "\n")
    return text_tables(path, text.split("\n"), "line"), digest


def read_apart(task: FileTask) -> Outcome:
    """Return what `read_here` returns, from another process; `values` stay in the folder `out`."""
    path = task.path
    check_there(path)
    _, package, _ = READERS[ending_of(path)]
    if find_spec(package) is None:
        raise InputError(
            f"{path}: reading it needs {package}, which is not installed; run"
            f" `pip install {package}`, or export the record as CSV."
        )
    size = Path(path).stat().st_size
    limit = _TIME + _TIME_PER_MIB * size / 2**20
    task = replace(task, memory=_MEMORY + _MEMORY_PER_BYTE * size)
    try:
        with started_python(
            _MODULE, json.dumps(msgspec.to_builtins(task)),
            OPENBLAS_NUM_THREADS="1", ARROW_DEFAULT_MEMORY_POOL="system",
        ) as child:  # fmt: skip
            done = heard(child, limit=limit)
    except subprocess.TimeoutExpired:
        return _unreadable(path, f"reading it takes more than {limit:.0f} s")
    if done.returncode:
        why = "the library that reads it fails, or needs more memory than such a file may"
        return _unreadable(path, why)
    return from_json(done.stdout.splitlines()[-1])


def to_json(outcome: Outcome) -> str:
    """Return an outcome as JSON, without its `values`."""
    return json.dumps(msgspec.to_builtins(outcome, enc_hook=lambda _: None))


def from_json(text: str | bytes) -> Outcome:
    """Return the outcome that `to_json` wrote; it has no `values`."""
    return msgspec.convert(json.loads(text), Outcome, dec_hook=lambda *_: np.zeros((0, 0)))


def _unreadable(path: str, why: str) -> Outcome:
    """Return the outcome of a damaged file."""
    *_, kind = READERS[ending_of(path)]
    problem = f"is no readable {kind} file ({why}); save it again, or export the record as CSV."
    return Outcome((f"{path}: {problem}",))


def read_here(task: FileTask) -> Outcome:
    """Return what is read of a file in this process, or the problems that it has."""
    path = task.path
    try:
        tables = READERS[ending_of(path)][0](path)
        if task.count:
            return Outcome(head=head_of_tables(path, tables, task.count, task.request))
        outcome = samples_of(path, tables, task.request)
    except InputError as error:
        return Outcome(error.problems)
    except MemoryError:
        return Outcome((f"{path}: needs more memory than a record may; split it.",))
    except Exception as error:  # noqa: BLE001 - a library may raise anything on a damaged file
        lines = str(error).splitlines() or [type(error).__name__]
        return _unreadable(path, lines[0][:120])
    with Path(path).open("rb") as stream:
        outcome.sha256 = hashlib.file_digest(stream, "sha256").hexdigest()
    if outcome.units:
        np.save(Path(task.out) / "values.npy", outcome.values)
    return outcome


def main() -> None:
    """Do the task on the command line; write the outcome to standard output, in JSON."""
    end_with_parent()
    task = msgspec.convert(json.loads(sys.argv[1]), FileTask)
    if sys.platform != "win32":
        import resource  # noqa: PLC0415

        hard = resource.getrlimit(resource.RLIMIT_AS)[1]
        limit = task.memory if hard == resource.RLIM_INFINITY else min(task.memory, hard)
        resource.setrlimit(resource.RLIMIT_AS, (limit, hard))
    sys.stdout.write(f"\n{to_json(read_here(task))}\n")


if __name__ == "__main__":
    main()
