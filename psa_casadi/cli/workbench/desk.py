"""The files of the page and its runs, the same for every tab."""

import re
import shutil
import threading
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from io import BufferedIOBase
from pathlib import Path
from typing import Any

from psa_casadi.cli.workbench import run as runs
from psa_casadi.cli.workbench.previews import Subject, preview
from psa_casadi.cli.workbench.run import Run, Settings, removed
from psa_casadi.common.characters import plain, visible
from psa_casadi.common.errors import InputError
from psa_casadi.records.read.table import MOST_BYTES

#: The longest name, in letters.
_LONGEST = 80
_BLOCK = 2**20
#: What a name of a file may not have, on any system, in a command line or in --columns.
_BARRED = re.compile(r"[^\w.+() -]")


@dataclass(frozen=True)
class Limits:
    """The most that is taken: bytes of one file, of all together, and files."""

    one: int = MOST_BYTES
    together: int = 2 * MOST_BYTES
    files: int = 32


def stored_name(name: str, taken: Collection[str]) -> str:
    """Return a name to store a file by: without paths and marks, and unlike those that are taken.

    The ending is kept, as it decides how a file is read.
    """
    last = re.split(r"[\\/]", plain(name))[-1]
    clean = _BARRED.sub("_", last).strip(" .").lstrip("-").strip(" .") or "record"
    stem, dot, ending = clean.rpartition(".")
    stem, ending = (stem, dot + ending) if dot else (ending, "")
    stem, ending = stem[:_LONGEST].rstrip(" ."), ending[:16]
    there = {n.casefold() for n in taken}
    names = (f"{stem}{f'_{k + 1}' if k else ''}{ending}" for k in range(len(there) + 1))
    return next(n for n in names if n.casefold() not in there)  # there is one more than are taken


def shown_name(name: str) -> str:
    """Return a file's name as the page shows it."""
    return plain(visible(name))[: 2 * _LONGEST] or "record"


def received(stream: BufferedIOBase, size: int, target: Path, admit: Callable[[int], None]) -> None:
    """Write `size` bytes of a stream to a new file; `admit` gets the count so far, and may refuse.

    Raises:
        InputError: the stream ends before, or the file cannot be written.
    """
    left = size
    try:
        with target.open("xb") as file:
            while left and (block := stream.read(min(left, _BLOCK))):
                left -= len(block)
                admit(size - left)
                file.write(block)
    except OSError as error:
        raise InputError(f"The file cannot be kept ({error.strerror or error}).") from error
    if left:
        raise InputError("The file did not arrive whole; give it again.")


class BusyError(Exception):
    """Something cannot be done while a command runs."""

    def __init__(self) -> None:
        super().__init__("A diagnosis runs; stop it first, or wait until it has ended.")


@dataclass(frozen=True)
class Item:
    """A file on the workbench: the name that it had, and where it lies by a name without marks.

    It may be held out; `preview` holds its columns and its picture, once they are known.
    """

    key: int
    name: str
    path: Path
    size: int
    held: bool = False
    preview: dict[str, Any] | None = field(default=None, compare=False)

    @property
    def is_model(self) -> bool:
        """Whether it is a MODEL.json to start from, and no record."""
        return self.path.suffix.lower() == ".json"

    def state(self) -> dict[str, Any]:
        """Return its state for the page."""
        state = {"key": self.key, "name": self.name, "stored": self.path.name, "size": self.size}
        return {**state, "held": self.held, "model": self.is_model, "seen": self.preview}


class Desk:
    """Files, settings and the run in a folder; any thread may ask. `close` ends what runs.

    The records lie in a separate folder, where nothing runs; runs leave their files next to it.
    `effects` are the names that may be left out, `modules` those of a user's effects, `subject`
    is the model that the records are of: a stack's, unless another one is named.
    """

    def __init__(
        self,
        folder: Path,
        effects: Sequence[str],
        modules: Sequence[str] = (),
        subject: Subject | None = None,
        limits: Limits | None = None,
        module: str = runs.PSA,
    ) -> None:
        self.folder, self.effects, self.limits = folder, tuple(effects), limits or Limits()
        self._records = folder / runs.RECORDS
        self._records.mkdir()
        self.subject = subject or Subject()
        for file in self.subject.files:
            shutil.copy(file, folder / file.name)
        self._options = [word for name in modules for word in ("--effects", name)]
        self._module = module
        self._lock = threading.RLock()
        self._items: dict[int, Item] = {}
        self._arrived: dict[int, int] = {}
        self._settings = Settings()
        self._run: Run | None = None
        self._export: Run | None = None
        self._version, self._next, self._number = 1, 1, 0

    # Files

    def add(self, name: str, stream: BufferedIOBase, size: int) -> None:
        """Take a file and look at it; raises InputError where it cannot be taken."""
        if self.subject.arguments and name.lower().endswith(".json"):
            raise InputError("The model is the one that the command names; give records alone.")
        with self._lock:
            self._idle()
            key, self._next = self._next, self._next + 1
            self._admit(key, name, size)
        coming = self._records / f".{key}"

        def arrive(count: int) -> None:
            with self._lock:
                self._admit(key, name, count)
                self._arrived[key] = count  # what is announced takes no room from others

        try:
            received(stream, size, coming, arrive)
            with self._lock:
                self._idle()
                self._admit(key, name, size)
                taken = [i.path.name for i in self._items.values()]
                path = self._records / stored_name(name, taken)
                coming.rename(path)
                self._items[key] = Item(key, shown_name(name), path, size)
                self._changed()
        finally:
            removed(coming)
            with self._lock:
                self._arrived.pop(key, None)
        self._look([key])

    def _admit(self, key: int, name: str, size: int) -> None:
        """Refuse a file of `size` bytes without room next to what is there and what arrives."""
        with self._lock:
            there = sum(i.size for i in self._items.values())
            there += sum(n for k, n in self._arrived.items() if k != key)
            if len(self._items) >= self.limits.files:
                raise InputError(f"There are {self.limits.files} files already; remove one first.")
            if size > self.limits.one or there + size > self.limits.together:
                raise InputError(
                    f"{shown_name(name)} is larger than may be, by itself or with the other files."
                )

    def remove(self, key: int) -> None:
        """Remove a file."""
        with self._lock:
            self._idle()
            item = self._items.pop(key, None)
            if item is not None:
                removed(item.path)
                self._settings = self._settings.without(item.path.name)
            self._changed()

    def hold(self, key: int, held: bool) -> None:
        """Keep a record for judging only, or not."""
        with self._lock:
            self._idle()
            if key in self._items:
                self._items[key] = replace(self._items[key], held=held)
                self._changed()
        self._look([key])

    def set(self, table: dict[str, Any]) -> None:
        """Change settings; the files are read again where that changes how."""
        with self._lock:
            self._idle()
            old, self._settings = self._settings, self._settings.changed(table, self.effects)
            new = self._settings
            self._changed()
        if (old.columns, old.sample_time) != (new.columns, new.sample_time):
            self._look(list(self._items))

    # Runs

    def start(self) -> None:
        """Begin the diagnosis; raises BusyError while one runs, InputError without a record."""
        with self._lock:
            self._idle()
            records = [i for i in self._items.values() if not i.is_model]
            fitted = [i.path.name for i in records if not i.held]
            if not fitted:
                raise InputError("There is no record to fit; give a file that is not held out.")
            held = [i.path.name for i in records if i.held]
            models = [i.path.name for i in self._items.values() if i.is_model]
            words = runs.diagnosis(fitted, held, models[-1] if models else None, self._settings)
            words += self.subject.arguments
            runs.clear(self.folder)
            self._export, self._number = None, self._number + 1
            self._run = Run(
                [*words, *self._options], self.folder, self._changed, self._module,
                ["--events", runs.EVENTS],
            )  # fmt: skip
            self._changed()

    def export(self) -> None:
        """Begin to write the FMU of the extended model."""
        with self._lock:
            self._idle()
            if not (self.folder / runs.MODEL).is_file():
                raise InputError("There is no extended model yet.")
            words = ["export", "fmu", "--model", runs.MODEL, "-o", runs.FMU, *self._options]
            self._export = Run(words, self.folder, self._changed, self._module)
            self._changed()

    def stop(self) -> None:
        """Let what runs end and keep what it has."""
        for item in self.running():
            item.stop()

    def close(self) -> None:
        """End what runs, at once."""
        for item in self.running():
            item.end()

    def running(self) -> list[Run]:
        """Return what runs: nothing, or one command."""
        both = (self._run, self._export)
        return [r for r in both if r is not None and r.status == "running"]

    # State

    def state(self, version: int, number: int, event_count: int) -> dict[str, Any]:
        """Return what has changed for a tab that knows a version and a count of events of a run."""
        with self._lock:
            state: dict[str, Any] = {"version": self._version}
            if self._run is not None:
                self._run.look()
                new = self._run.events[event_count if number == self._number else 0 :]
                state["run"] = {**self._run.state(), "number": self._number, "events": new}
            state["export"] = None if self._export is None else self._export.state()
            if version != self._version:
                state["items"] = [i.state() for i in self._items.values()]
                state["settings"] = vars(self._settings)
                state["result"] = runs.diagnosis_summary(self.folder)
                state["files"] = runs.files_left(self.folder)
            return state

    def result(self, name: str) -> Path | None:
        """Return the place of a file that a run has left, None where there is none of this name."""
        return self.folder / name if name in runs.files_left(self.folder) else None

    def _look(self, keys: Sequence[int]) -> None:
        """Look at files again; what was removed or changed meanwhile is left alone."""
        for key in keys:
            with self._lock:
                item, settings = self._items.get(key), self._settings
            if item is None or item.is_model:
                continue
            table = preview(
                self.folder, item.path, settings.columns or None, settings.seconds, self.subject,
                held=item.held,
            )  # fmt: skip
            with self._lock:
                if self._items.get(key) == item and settings == self._settings:
                    self._items[key] = replace(item, preview=table)
                    self._changed()

    def _idle(self) -> None:
        if self.running():
            raise BusyError

    def _changed(self) -> None:
        with self._lock:
            self._version += 1
