"""The checks that touch the binaries of an FMU run in a separate process, with limits.

Of time and memory; the process may end in any of them. It reads its task in a folder and appends
its rows to a file there, so that the finished rows stay, however it ends. Each line starts with a
word that only the two processes know: code that ends the process early, or writes where it should
not, can neither finish nor add a row.
"""

import json
import os
import pickle
import secrets
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import astuple, dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from psa_casadi.common.children import end_with_parent, heard, kill_group, started_python
from psa_casadi.common.errors import PsaError
from psa_casadi.common.files import temporary_folder
from psa_casadi.common.processes import memory_of_process
from psa_casadi.export.check import structure
from psa_casadi.export.check.agreement import Playback, Run, Truth, played_again
from psa_casadi.export.check.binaries import binary_checks
from psa_casadi.export.check.calls import CALLS, WORDS
from psa_casadi.export.check.foreign import by_standard, foreign_checks
from psa_casadi.export.check.rows import (
    BREAKDOWNS,
    LEFT_OUT,
    LEFT_OUT3,
    Check,
    CheckRow,
    Findings,
    stopped,
)
from psa_casadi.export.common.variable_table import INPUT_LINE
from psa_casadi.export.fmu.sources import fixed_step_of
from psa_casadi.export.importer.archive import Archive
from psa_casadi.export.importer.fmu import Fmu, FmuError
from psa_casadi.export.importer.masters import co_simulate, integrate

#: The row that is there only if the process ends badly outside of any check.
OUTSIDE = "process ends"
#: The message of checks that do not come to an end.
OVERTIME = (
    "did not come back within the time limit of {:g} s of the whole check (--timeout sets it)"
)
_MODULE = "psa_casadi.export.check.apart"
_TASK, _ROWS, _PRINTED = "task", "rows", "printed"
#: How often the process looks at its memory [s], and from which share of it on it is full.
_LOOK, _FULL = 0.02, 0.9
#: How much a file of the process may hold [bytes], as what it prints goes to one; how much of that
#: a message has.
_MOST_PRINTED, _LAST = 256 << 20, 300
#: What a process ends with that cannot write its rows any more.
_CLOSED = 71
_DISTURBED = "the FMU disturbed the channel of the results: "


@dataclass(frozen=True)
class Task:
    """What is to be checked: an FMU by its path (for messages) and its unpacked folder.

    `truth` is what to compare with, `playbacks` are runs to repeat. All checks may take `timeout`
    [s], the foreign code `memory` [bytes] in addition to Python; that is limited on Linux only.
    `key` marks the lines of its process. A `foreign` FMU is checked by the standard alone.
    """

    path: Path
    unpacked: Path
    truth: Truth | None
    timeout: float
    memory: int
    portable: bool = False
    playbacks: tuple[Playback, ...] = ()
    foreign: bool = False
    key: str = field(default_factory=lambda: secrets.token_hex(16))


def checks_of(task: Task) -> Iterator[Check]:
    """Yield the checks of an FMU that was unpacked, each to be made before the next one is taken.

    Without a model there is no truth, and nothing is compared with it.
    """
    loaded: list[Fmu] = []
    with Archive(task.path, task.unpacked) as archive:
        load = partial(_load, task, archive, loaded)
        if task.foreign:
            yield by_standard("binary loads", load, archive.version)
        else:
            yield from binary_checks(archive, portable=task.portable)
            yield Check("binary loads", load)
    for fmu in loaded:
        if task.foreign:
            yield from foreign_checks(fmu)
            continue
        left_out = [] if fmu.version == 3 else [*LEFT_OUT3]
        left_out += [] if INPUT_LINE.name in fmu.references else ["line of the input"]
        if fixed_step_of(fmu.directory) is not None:
            left_out += [*LEFT_OUT, *LEFT_OUT3]
        for check in _of_fmu(fmu, task, loaded):
            if check.name not in left_out:
                yield check


#: The checks of an FMU of this package by the name of their row, with the limit of a figure.
_LOADED: dict[str, tuple[Callable[[Fmu], Findings | float], float]] = {
    **{name: (check, 0.0) for name, check in CALLS.items()},
    "nominal values": (structure.wrong_nominals, 0.0),
    "event indicators": (structure.event_indicators, 0.0),
    "dependencies complete": (structure.incomplete_dependencies, 0.0),
    "directional derivatives": (structure.directional_error, 1e-5),
    "adjoint derivatives": (structure.adjoint_error, 1e-10),
    "line of the input": (structure.input_line_error, 0.05),
}
#: Those that compare with a model; both starts come of runs at tolerances of 1e-6 and less.
_COMPARED: dict[str, tuple[Callable[[Fmu, Truth], Findings | float], float]] = {
    "start of a run": (structure.wrong_start, 0.0),
    "settled start": (structure.settled_start_error, 1e-5),
    "event indicators of the model": (structure.wrong_indicators, 0.0),
    "equations": (structure.equation_error, 1e-9),
}


def _of_fmu(fmu: Fmu, task: Task, loaded: list[Fmu]) -> Iterator[Check]:
    """Yield the checks of a loaded FMU; they end where it gives no instance."""
    for kind, words in WORDS.items():
        yield Check(f"{words} instantiates", partial(_instantiates, fmu, kind, loaded))
    if not loaded:
        return
    for name, (check, limit) in _LOADED.items():
        yield Check(name, partial(check, fmu), limit)
    if truth := task.truth:
        for name, (compare, limit) in _COMPARED.items():
            if name != "settled start" or truth.settled_starts:
                yield Check(name, partial(compare, fmu, truth), limit)
        for run in truth.runs:
            yield Check(run.name, partial(_compared, fmu, truth, run), run.limit)
        if truth.problem:
            remark = f"the comparison stopped: {truth.problem}"
            yield Check("trajectories", partial(stopped, "trajectories", remark))
    for playback in task.playbacks:
        yield Check(playback.name, partial(played_again, fmu, playback))


def _compared(fmu: Fmu, truth: Truth, run: Run) -> CheckRow:
    """Return the row of a run: the largest difference over the scale, and which output has it."""
    names = truth.compared
    if run.integrated:
        values = integrate(fmu, run.times, run.inputs, names, tolerance=run.tolerance or run.limit)
    else:
        values = co_simulate(
            fmu, run.times, run.inputs, names, tolerance=run.tolerance, settled=truth.settled
        )
    scale = truth.scale if run.scale is None else run.scale
    error = np.max(np.abs(values - run.expected), axis=0) / scale
    worst = int(np.argmax(error))
    largest = float(error[worst])
    remark = f"largest in {names[worst]}, against the {run.by or truth.by}"
    return CheckRow(run.name, largest, run.limit, largest <= run.limit, remark)


def _load(task: Task, archive: Archive, loaded: list[Fmu]) -> Iterator[str]:
    """Append the FMU with its binary; what prevents that is the problem."""
    try:
        fmu = Fmu(task.path, task.unpacked)
        for interface in fmu.interfaces():
            fmu.loaded(interface)
    except BREAKDOWNS as error:
        folders = {p.parent.name for p in archive.binaries()}
        yield f"{error} (it has {', '.join(sorted(folders)) or 'none'})"
    else:
        loaded.append(fmu)


def _instantiates(fmu: Fmu, interface: int, loaded: list[Fmu]) -> Iterator[str]:
    """Make an instance; an FMU that gives none is not among the loaded ones any more."""
    try:
        fmu.open(interface).free()
    except FmuError:
        loaded.clear()
        yield "there is no instance: description and binary are not of the same export"


def rows_apart(task: Task, end: float) -> list[CheckRow]:
    """Return the rows of a task, and how its process ended unless that was well.

    `end` is when it ends at the latest, a value of `time.monotonic`.

    Raises PsaError if it did not come as far as the code of the FMU.
    """
    with temporary_folder() as folder:
        (folder / _TASK).write_bytes(pickle.dumps(task))
        temporary = dict.fromkeys(("TMPDIR", "TEMP", "TMP"), str(folder))
        with (
            (folder / _ROWS).open("w+b") as rows,
            (folder / _PRINTED).open("w+b") as printed,
            started_python(_MODULE, str(folder), directory=folder, **temporary) as child,
        ):
            problem, complained = "", b""
            try:
                done = heard(child, limit=max(0.0, end - time.monotonic()))
                code, complained = done.returncode, done.stderr
            except subprocess.TimeoutExpired:
                code, problem = 0, f"the FMU {OVERTIME.format(task.timeout)}"
            finally:
                kill_group(child)
            result = _Lines(task.key, rows.read())
            printed.seek(max(0, printed.seek(0, os.SEEK_END) - _LAST))
            complained += printed.read()
    problem = problem or result.problem or _ended(code, result, task.memory)
    if not problem:
        return result.rows
    if last := complained.decode(errors="replace").strip()[-_LAST:]:
        problem += f"; the last it printed: {last}"
    if not result.rows and not result.running:  # nothing of the FMU has run
        raise PsaError(f"The process for the code of the FMU did not start: {problem}.")
    return [*result.rows, stopped(result.running or OUTSIDE, problem)]


class _Lines:
    """The lines of a process, read; `running` is the check that ran when it ended."""

    def __init__(self, key: str, lines: bytes) -> None:
        self.rows: list[CheckRow] = []
        self.running, self.problem = "", ""
        self.complete = self.full = False
        for line in lines.decode(errors="replace").splitlines():
            word, _, text = line.partition(" ")
            if word != key or self.complete:
                self.problem = f"{_DISTURBED}something else was written between the results"
                return
            kind, *content = json.loads(text)
            if kind == "begin":
                self.running = str(content[0])
            elif kind == "row":
                self.rows.append(CheckRow(*content))
                self.running = ""
            self.full = self.full or kind == "memory"
            self.complete = kind == "end"


def _ended(code: int, result: _Lines, memory: int) -> str:
    """Return what was wrong with a process that ended by itself, "" if nothing was."""
    if code == 0 and result.complete:
        return ""
    if result.full:
        return f"the FMU reached the memory limit of {memory / 2**20:.0f} MiB (--memory sets it)"
    if code == _CLOSED:
        return f"{_DISTURBED}it was closed"
    if code < 0:
        name = signal.Signals(-code).name if -code in set(signal.Signals) else str(-code)
        return f"the FMU ended its process by the signal {name}"
    text = f"{code:#x}" if code > 255 else str(code)  # such codes are faults of Windows
    when = "when it was unloaded" if result.complete else "before the checks were done"
    return f"the FMU ended its process with exit code {text} {when}"


def main() -> None:
    """Run the checks of the task in the folder that is named, and append what they find."""
    end_with_parent()
    folder = Path(sys.argv[1])
    task: Task = pickle.loads((folder / _TASK).read_bytes())
    (folder / _TASK).unlink()  # the foreign code shall not read the key there
    rows = os.open(folder / _ROWS, os.O_WRONLY | os.O_APPEND)
    printed = os.open(folder / _PRINTED, os.O_WRONLY | os.O_APPEND)
    for stream, target in ((0, os.open(os.devnull, os.O_RDONLY)), (1, printed), (2, printed)):
        os.dup2(target, stream)

    def write(*content: object) -> None:
        try:
            os.write(rows, f"{task.key} {json.dumps(content)}\n".encode())
        except OSError:
            os._exit(_CLOSED)

    _limit(task.memory, lambda: write("memory"))
    try:
        for check in checks_of(task):
            write("begin", check.name)
            write("row", *astuple(check.row()))
    except MemoryError:
        write("memory")
        raise
    write("end")


def _limit(memory: int, act: Callable[[], None]) -> None:
    """Limit what this process takes from now on; act when its memory is nearly full.

    Linux counts private data, touched or not. Does nothing on a system that has no such limits.
    """
    if sys.platform == "win32":
        return
    import resource  # noqa: PLC0415 - there is none on Windows

    most = memory_of_process("VmData") + memory
    for kind, wanted in (
        (resource.RLIMIT_CORE, 0), (resource.RLIMIT_FSIZE, _MOST_PRINTED),
        (resource.RLIMIT_DATA, most),
    ):  # fmt: skip
        hard = resource.getrlimit(kind)[1]
        size = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
        with suppress(OSError, ValueError):
            resource.setrlimit(kind, (size, size))

    def watch() -> None:
        while memory_of_process("VmData") < most - (1.0 - _FULL) * memory:
            time.sleep(_LOOK)
        act()

    if memory_of_process("VmData"):
        threading.Thread(target=watch, daemon=True).start()


if __name__ == "__main__":
    main()
