"""One diagnosis or export: its command, the events of its search, its files."""

import contextlib
import json
import math
import shlex
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any, Literal

from psa_casadi.common.children import Child, close_pipes, interrupt, kill, started_python
from psa_casadi.common.errors import InputError, MachineError

Status = Literal["running", "done", "failed", "stopped"]
#: Lines of output that are kept of a command, and the longest part of one.
_LINES, _LONGEST_LINE = 400, 2000
#: Time [s] that an interrupted command has to write what it keeps.
_PATIENCE = 20.0
#: The module that is the command `psa` in a child.
PSA = "psa_casadi.cli.child"
#: The folder of the records, next to what a run leaves.
RECORDS = "records"
#: The files of a diagnosis, and of an export of its model.
MODEL, JSON, REPORT, EVENTS, FMU = (
    "extended.json", "diagnosis.json", "report.html", "events.jsonl", "extended.fmu",
)  # fmt: skip
#: Patterns of further files of a diagnosis.
_MORE = ("extended_*_for_*.json", "diagnosis_next.csv")
#: Letters of a text: enough for --columns of all files.
_LONGEST = 8000
_FORMS = ("", "bouc-wen", "spectrum", "best")


@dataclass(frozen=True)
class Settings:
    """What a person chooses for a diagnosis; texts as the options of the command have them.

    `stiffness` is in N/m, `sample_time` in s, each "" by default.
    """

    columns: str = ""
    sample_time: str = ""
    stiffness: str = ""
    hysteresis: str = ""
    leave_out: tuple[str, ...] = ()

    def changed(self, table: Mapping[str, Any], effects: Sequence[str]) -> "Settings":
        """Return the settings with these changes; raises InputError for values that cannot be."""
        texts = ("columns", "sample_time", "stiffness", "hysteresis")
        new = {name: str(table[name]).strip()[:_LONGEST] for name in texts if name in table}
        left_out = table.get("leave_out", self.leave_out)
        if not isinstance(left_out, list | tuple) or not set(left_out) <= set(effects):
            raise InputError("An effect to leave out is not known.")
        for name in ("sample_time", "stiffness"):
            text = new.get(name, "")
            with contextlib.suppress(ValueError):
                if not text or 0.0 < float(text) < math.inf:
                    continue
            raise InputError(f"{name.replace('_', ' ')} is '{text[:40]}'; give a positive number.")
        if new.get("hysteresis", "") not in _FORMS:
            raise InputError("The form of the hysteresis is not known.")
        if any(not text.isprintable() for text in new.values()):
            raise InputError("A text has characters that no command line can carry.")
        return replace(self, **new, leave_out=tuple(e for e in effects if e in left_out))

    def without(self, file: str) -> "Settings":
        """Return the settings without the part of --columns on a file that is gone."""
        kept = (p for p in self.columns.split(",") if not p.strip().startswith(f"{file}@"))
        return replace(self, columns=",".join(kept))

    @property
    def seconds(self) -> float | None:
        """Time [s] from sample to sample, for files without a time."""
        return float(self.sample_time) if self.sample_time else None

    def options(self) -> list[str]:
        """Return the options of the command."""
        table = {
            "--columns": self.columns, "--sample-time": self.sample_time,
            "--stiffness": self.stiffness, "--hysteresis": self.hysteresis,
        }  # fmt: skip
        named = [f"{option}={text}" for option, text in table.items() if text]
        return [*named, *(f"--leave-out={name}" for name in self.leave_out)]


class Run:
    """A command that runs, or has run, in the folder of its results; it ends with this process.

    `printed` and `messages` are the lines of its standard output and standard error so far;
    `seconds` is its run time, `events` are those of the search. `ended` is called once, from the
    thread that waits for it.
    """

    def __init__(
        self,
        arguments: Sequence[str],
        folder: Path,
        ended: Callable[[], None],
        module: str = PSA,
        hidden: Sequence[str] = (),
    ) -> None:
        """Start it; `hidden` arguments are not part of the command that the page shows."""
        self._module, self._arguments, self._folder = module, (*arguments, *hidden), folder
        self._ended, self._stopped, self._read = ended, False, 0
        self._child: Child | None = None
        self._begin, self._end = time.monotonic(), 0.0
        self.command = shlex.join(["psa", *arguments])
        self.status: Status = "running"
        self.events: list[dict[str, Any]] = []
        self.printed: deque[str] = deque(maxlen=_LINES)
        self.messages: deque[str] = deque(maxlen=_LINES)
        # this thread lives as long as the child: on Linux a child ends with its parent's thread
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def pid(self) -> int | None:
        """Number of its process, None before it has started."""
        return None if self._child is None else self._child.pid

    def stop(self) -> None:
        """Let it end and keep what it has; after a while it is killed."""
        self._stopped = True
        child = self._child
        if child is not None:
            interrupt(child)
            threading.Timer(_PATIENCE, kill, (child,)).start()

    def end(self) -> None:
        """Kill it and wait until it is gone."""
        self._stopped = True
        if self._child is not None:
            kill(self._child)
        self._thread.join()

    def look(self) -> None:
        """Read the events of the search since the last look."""
        path = self._folder / EVENTS
        if not path.exists():
            return
        with path.open("rb") as file:
            file.seek(self._read)
            for row in file:
                if not row.endswith(b"\n"):
                    break
                self._read += len(row)
                self.events.append(json.loads(row))

    def state(self) -> dict[str, Any]:
        """Return what the page shows of it."""
        return {
            "command": self.command,
            "status": self.status,
            "seconds": (self._end or time.monotonic()) - self._begin,
            "line": self.messages[-1] if self.messages else "",
            "printed": list(self.printed),
            "messages": list(self.messages)[-40:],
        }

    def _run(self) -> None:
        code = 1
        try:
            with started_python(self._module, *self._arguments, directory=self._folder) as child:
                self._child = child
                if self._stopped:
                    interrupt(child)
                code = self._collect_output(child)
        except MachineError as error:
            self.messages.append(str(error))
        finally:
            self._end = time.monotonic()
            self.status = "stopped" if self._stopped and code else "failed" if code else "done"
            self._ended()

    def _collect_output(self, child: Child) -> int:
        """Keep the output of a child until it ends; return its exit code."""

        def keep(stream: IO[bytes], lines: deque[str]) -> None:
            while row := stream.readline(_LONGEST_LINE):
                lines.append(row.decode("utf-8", "replace").rstrip("\r\n"))

        readers = [
            threading.Thread(target=keep, args=pair, daemon=True)
            for pair in ((child.stdout, self.printed), (child.stderr, self.messages))
        ]
        if child.stdin is not None:
            child.stdin.close()
        for reader in readers:
            reader.start()
        code = child.wait()
        for reader in readers:
            reader.join(1.0)  # one that the child has started may still hold its streams
        close_pipes(child)
        return code


def diagnosis(
    records: Sequence[str], held: Sequence[str], model: str | None, settings: Settings
) -> list[str]:
    """Return the arguments of the command that diagnoses records by their names."""
    fitted = [f"{RECORDS}/{name}" for name in records]
    kept = [word for name in held for word in ("--holdout", f"{RECORDS}/{name}")]
    start = ["--model", f"{RECORDS}/{model}"] if model else []
    outputs = ["-o", MODEL, "--json", JSON, "--report", REPORT]
    return ["diagnose", *fitted, *kept, *start, *settings.options(), *outputs]


def diagnosis_summary(folder: Path) -> dict[str, Any] | None:
    """Return the main figures of the diagnosis that lies in a folder, None where none does."""
    try:
        content = json.loads((folder / JSON).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    names = ("verdict", "causes", "errors", "gain", "budget", "remaining", "notes")
    return {name: content.get(name) for name in names}


def files_left(folder: Path) -> dict[str, int]:
    """Return the files that runs have left in a folder, with their sizes in bytes."""
    named = [folder / name for name in (REPORT, MODEL, JSON, FMU)]
    more = [path for pattern in _MORE for path in sorted(folder.glob(pattern))]
    return {path.name: path.stat().st_size for path in [*named, *more] if path.is_file()}


def clear(folder: Path) -> None:
    """Remove what an earlier run has left."""
    for name in [*files_left(folder), EVENTS]:
        removed(folder / name)


def removed(path: Path) -> None:
    """Remove a file or a folder, if it is there."""
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
