"""Binary files are read in a process of their own, with limits of time and memory.

A damaged file may crash the library that reads it, fill the memory or never end. The process gets
the path and leaves the numbers in a file of a temporary folder: no record passes through a pipe.
"""

import hashlib
import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from itertools import zip_longest
from pathlib import Path

import msgspec
import numpy as np

from psa_casadi.children import end_with_parent, heard, started_python
from psa_casadi.errors import InputError, Problems
from psa_casadi.files import temporary_folder
from psa_casadi.records.read.columns import MARKS, WORDS, Field, stated_unit
from psa_casadi.records.read.file_bytes import check_there, read_text
from psa_casadi.records.read.formats import READERS, ending_of
from psa_casadi.records.read.samples import Outcome, Request, samples_of
from psa_casadi.records.read.table import Table, parts_of_file
from psa_casadi.records.read.text import decoded, text_tables


@dataclass(frozen=True)
class Head:
    """The columns of a table by the names that `--columns` takes, and the first rows.

    A name is "" where `--columns` cannot say it. `units` are those that the file states, "" where
    it states none; `rows` hold the cells as text. `guess` says which column of a record stands
    where, as the reader takes it or, where it asks, would take it. `tables` are those of the file.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    guess: Mapping[str, Field]
    tables: tuple[str, ...] = ()


@dataclass(frozen=True)
class Asked:
    """What is asked of a file: its numbers in the folder `out`, or `count` rows of its head."""

    path: str
    request: Request
    out: str = ""
    count: int = 0
    memory: int = 0


@dataclass(frozen=True)
class Answer:
    """What the other process tells of a file: its head, or what it holds but for the numbers."""

    outcome: Outcome
    head: Head | None = None


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
    items = [
        [f"{c:.9g}" for c in cells[:count]]
        if isinstance(cells, np.ndarray) and cells.dtype.kind in "biuf"
        else [str(c)[:40] for c in cells[:count]]
        for cells in one.glance
    ]
    rows = tuple(zip_longest(*items, fillvalue=""))
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
        outcome = answered_apart(Asked(path, request, str(folder))).outcome
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
    answer = answered_apart(Asked(place, request, count=count))
    if answer.head is None:
        raise InputError(answer.outcome.problems)
    return answer.head


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


def answered_apart(requested: Asked) -> Answer:
    """Return what `answered` does in a process of its own."""
    path = requested.path
    check_there(path)
    _, package, _ = READERS[ending_of(path)]
    if find_spec(package) is None:
        raise InputError(
            f"{path}: reading it needs {package}, which is not installed; run"
            f" `pip install {package}`, or export the record as CSV."
        )
    size = Path(path).stat().st_size
    limit = _TIME + _TIME_PER_MIB * size / 2**20
    requested = replace(requested, memory=_MEMORY + _MEMORY_PER_BYTE * size)
    try:
        with started_python(
            _MODULE, json.dumps(msgspec.to_builtins(requested)),
            OPENBLAS_NUM_THREADS="1", ARROW_DEFAULT_MEMORY_POOL="system",
        ) as child:  # fmt: skip
            done = heard(child, limit=limit)
    except subprocess.TimeoutExpired:
        return _unreadable(path, f"reading it takes more than {limit:.0f} s")
    if done.returncode:
        why = "the library that reads it fails, or needs more memory than such a file may"
        return _unreadable(path, why)
    return answer_in(done.stdout.splitlines()[-1])


def text_in(answer: Answer) -> str:
    """Return an answer in JSON, without the numbers."""
    return json.dumps(msgspec.to_builtins(answer, enc_hook=lambda _: None))


def answer_in(text: str | bytes) -> Answer:
    """Return the answer that a text in JSON is."""
    none = np.zeros((0, 0))
    return msgspec.convert(json.loads(text), Answer, dec_hook=lambda *_: none)


def _unreadable(path: str, why: str) -> Answer:
    """Return that a file is damaged."""
    *_, kind = READERS[ending_of(path)]
    return _refused(
        f"{path}: is no readable {kind} file ({why}); save it again, or export the record as CSV."
    )


def _refused(*problems: str) -> Answer:
    return Answer(Outcome(problems))


def answered(requested: Asked) -> Answer:
    """Return what is told of a file, read in this process."""
    path = requested.path
    try:
        tables = READERS[ending_of(path)][0](path)
        if requested.count:
            return Answer(
                Outcome(), head_of_tables(path, tables, requested.count, requested.request)
            )
        outcome = samples_of(path, tables, requested.request)
    except InputError as error:
        return _refused(*error.problems)
    except MemoryError:
        return _refused(f"{path}: needs more memory than a record may; split it.")
    except Exception as error:  # noqa: BLE001 - a library may raise anything on a damaged file
        statement = str(error).splitlines()
        return _unreadable(path, statement[0][:120] if statement else type(error).__name__)
    with Path(path).open("rb") as stream:
        outcome.sha256 = hashlib.file_digest(stream, "sha256").hexdigest()
    if outcome.units:
        np.save(Path(requested.out) / "values.npy", outcome.values)
    return Answer(outcome)


def main() -> None:
    """Answer what is asked on the command line on standard output, in JSON."""
    end_with_parent()
    value = msgspec.convert(json.loads(sys.argv[1]), Asked)
    if sys.platform != "win32":
        import resource  # noqa: PLC0415

        hard = resource.getrlimit(resource.RLIMIT_AS)[1]
        limit = value.memory if hard == resource.RLIM_INFINITY else min(value.memory, hard)
        resource.setrlimit(resource.RLIMIT_AS, (limit, hard))
    sys.stdout.write(f"\n{text_in(answered(value))}\n")


if __name__ == "__main__":
    main()
