"""Binary files are read in a process of their own, with limits of time and memory.

A damaged file may crash the library that reads it, fill the memory or never end. The process gets
the path and leaves the numbers in a file of a temporary folder: no record passes through a pipe.
"""

import hashlib
import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from psa_casadi.children import end_with_parent, heard, started_python
from psa_casadi.errors import InputError, Problems
from psa_casadi.records.read.choose import choose
from psa_casadi.records.read.columns import Field, Source, stated_unit
from psa_casadi.records.read.file_bytes import check_there, read_text, reason_of
from psa_casadi.records.read.formats import EXPORTS, READERS, ending_of
from psa_casadi.records.read.samples import Outcome, Request, Samples, samples_of
from psa_casadi.records.read.table import Cells, Table, parts_of_file
from psa_casadi.records.read.text import decoded, text_tables
from psa_casadi.scratch import temporary_folder

#: The columns that a diagnosis needs; a cell that may be one of them is a guess worth showing.
NEEDED = ("time", "voltage", "displacement")
#: What `--columns` reads as its own marks: a column with one of them cannot be named there.
_MARKS = set(",=:[]")


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

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON can hold it."""
        return asdict(self)

    @classmethod
    def from_json(cls, told: Mapping[str, Any]) -> "Head":
        """Return what `to_json` was made of."""
        guess = {name: Field(**own) for name, own in told["guess"].items()}
        rows = tuple(tuple(row) for row in told["rows"])
        return cls(tuple(told["names"]), tuple(told["units"]), rows, guess, tuple(told["tables"]))


def head_of_tables(path: str, tables: Sequence[Table], count: int, table: str) -> Head:
    """Return the head of one of the tables of a file, of the first where none is named."""
    if not tables:
        raise InputError(f"{path}: holds no header and no data; export the record again.")
    parts = parts_of_file(tables)
    one = parts.get(table, tables[0])
    choice = choose(one, NEEDED, {}, Problems())
    guess = dict(choice.fields)
    labels = list(one.labels)
    for name, source in choice.sources.items() if not one.headless else ():
        if source.array in labels:
            guess[name] = Field(labels.index(source.array), source.unit or "")
    units = tuple(stated_unit(text) or "" for text in one.header)
    names = tuple("" if set(label) & _MARKS else label for label in one.labels)
    columns = [_texts(cells, count) for cells in one.glance]
    longest = max(map(len, columns), default=0)
    rows = tuple(tuple(c[k] if k < len(c) else "" for c in columns) for k in range(longest))
    return Head(names, units, rows, guess, tuple(parts) if len(parts) > 1 else ())


def _texts(cells: Cells, count: int) -> list[str]:
    """Return the first cells as a table shows them."""
    if isinstance(cells, np.ndarray) and cells.dtype.kind in "biuf":
        return [f"{value:.9g}" for value in cells[:count]]
    return [str(cell)[:40] for cell in cells[:count]]


#: Time [s] that any file may take, and more for each MiB of it; memory [bytes], and more for each
#: byte of the file: a workbook of 100 MiB takes 1.1 GiB, and 1 GiB of numbers is copied once.
_TIME, _TIME_PER_MIB = 30.0, 3.0
_MEMORY, _MEMORY_PER_BYTE = 3 * 2**30, 12
_MODULE = "psa_casadi.records.read.apart"


def read(path: str, request: Request) -> tuple[Outcome, str]:
    """Return what `samples_of` returns of a file, and the file's SHA-256.

    Raises:
        InputError: the file is missing, empty, too large, damaged, or needs a package that is not
            installed.
        MachineError: the other process cannot be started.
    """
    if not ending_of(path):
        tables, digest = text_of(path)
        return samples_of(path, tables, request), digest
    with temporary_folder() as folder:
        told = _told(path, {"request": asdict(request), "out": str(folder)})
        problems = Problems()
        for sentence in told["problems"]:
            problems.add(sentence)
        samples = None
        if told["units"]:
            values = np.load(folder / "values.npy")
            samples = Samples(told["units"], values, told["notes"])
        return Outcome(samples, problems, told["tables"]), told["sha256"]


def head_of(path: str | Path, count: int = 8, table: str = "") -> Head:
    """Return the head of a file with its first `count` rows; its numbers are not checked.

    Raises:
        InputError, MachineError: as `read`.
    """
    place = str(path)
    if not ending_of(place):
        return head_of_tables(place, text_of(place)[0], count, table)
    return Head.from_json(_told(place, {"head": count, "table": table}))


def text_of(path: str) -> tuple[Sequence[Table], str]:
    """Return the tables of a file of text and its SHA-256.

    Raises:
        InputError: the file is missing, too large, damaged, or no text.
    """
    check_there(path)
    kind = EXPORTS.get(Path(path).suffix.lower())
    content, digest = read_text(path)
    if kind and b"\0" in content[:4096]:
        raise InputError(f"{path}: is {kind}; export the record as CSV and name that file.")
    text = decoded(content, path).replace("\r\n", "\n").replace("\r", "\n")
    return text_tables(path, text.split("\n"), "line"), digest


def _told(path: str, asked: dict[str, Any]) -> dict[str, Any]:
    """Return what the process tells of a file."""
    check_there(path)
    _, package = READERS[ending_of(path)]
    if find_spec(package) is None:
        raise InputError(
            f"{path}: reading it needs {package}, which is not installed; run"
            f" `pip install {package}`, or export the record as CSV."
        )
    size = Path(path).stat().st_size
    limit = _TIME + _TIME_PER_MIB * size / 2**20
    asked = {"path": path, "memory": _MEMORY + _MEMORY_PER_BYTE * size, **asked}
    try:
        with started_python(
            _MODULE, json.dumps(asked), OPENBLAS_NUM_THREADS="1", ARROW_DEFAULT_MEMORY_POOL="system"
        ) as child:
            done = heard(child, limit=limit)
    except subprocess.TimeoutExpired:
        raise InputError(
            f"{path}: is no readable {_kind(path)} file (reading it takes more than {limit:.0f} s);"
            " save it again, or export the record as CSV."
        ) from None
    if done.returncode:
        raise InputError(
            f"{path}: is no readable {_kind(path)} file (the library that reads it fails, or needs"
            " more memory than such a file may); save it again, or export the record as CSV."
        )
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    if "refused" in found:
        raise InputError(found["refused"])
    return found


def _kind(path: str) -> str:
    kinds = {".mat": "MATLAB", ".h5": "HDF5", ".hdf5": "HDF5", ".hdf": "HDF5", ".npy": "NumPy",
             ".npz": "NumPy", ".pq": "Parquet", ".parquet": "Parquet", ".tdms": "TDMS"}  # fmt: skip
    ending = ending_of(path)
    excel = ending in (".xlsx", ".xlsm", ".xls", ".xlsb", ".ods")
    return "Excel" if excel else kinds.get(ending, ending.lstrip("."))


def answered(asked: dict[str, Any]) -> dict[str, Any]:
    """Return what is told of a file, read in this process."""
    path = asked["path"]
    try:
        tables = READERS[ending_of(path)][0](path)
        if "head" in asked:
            return head_of_tables(path, tables, asked["head"], asked["table"]).to_json()
        request = asked["request"]
        columns = {name: Source(**source) for name, source in request.pop("columns").items()}
        outcome = samples_of(path, tables, Request(columns=columns, **request))
    except InputError as error:
        return {"refused": list(error.problems)}
    except MemoryError:
        return {"refused": [f"{path}: needs more memory than a record may; split it."]}
    except Exception as error:  # noqa: BLE001 - a library may raise anything on a damaged file
        return {
            "refused": [
                f"{path}: is no readable {_kind(path)} file ({reason_of(error)}); save it again, or"
                " export the record as CSV."
            ]
        }
    units: dict[str, str] = {}
    notes: Sequence[str] = ()
    if outcome.samples is not None:
        units, notes = dict(outcome.samples.units), outcome.samples.notes
        np.save(Path(asked["out"]) / "values.npy", outcome.samples.values)
    with Path(path).open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    return {
        "problems": outcome.problems.sentences(), "units": units, "notes": list(notes),
        "tables": list(outcome.tables), "sha256": digest,
    }  # fmt: skip


def main() -> None:
    """Answer what is asked on the command line on standard output, in JSON."""
    end_with_parent()
    asked = json.loads(sys.argv[1])
    if sys.platform != "win32":
        import resource  # noqa: PLC0415

        hard = resource.getrlimit(resource.RLIMIT_AS)[1]
        limit = asked["memory"] if hard == resource.RLIM_INFINITY else min(asked["memory"], hard)
        resource.setrlimit(resource.RLIMIT_AS, (limit, hard))
    sys.stdout.write(f"\n{json.dumps(answered(asked))}\n")


if __name__ == "__main__":
    main()
