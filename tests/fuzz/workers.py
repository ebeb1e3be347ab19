"""Forked processes that attack thousands of inputs each; a crash or a hang is located to one."""

import contextlib
import faulthandler
import json
import mmap
import os
import shutil
import signal
import struct
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from psa_casadi.errors import PsaError
from tests.fuzz.target import CRASH, FOREIGN, HANG, LEFT_OVER, Found, Target, generator

#: What a process tells while it works: index, start of it [s], inputs done, inputs accepted, ended.
_PROGRESS = struct.Struct("qdqqq")
#: A process takes this long, then another target may have its turn [s].
_SLICE = 2.0
_HARNESS = 97  # exit code: the harness itself failed


@dataclass(frozen=True)
class Failure:
    """An input that led to something that must not be; `alike` is equal for one cause."""

    target: str
    kind: str
    sentence: str
    index: int
    alike: str
    detail: str = ""


@dataclass(frozen=True)
class Block:
    """Inputs `first` up to `last` of a target; a process stops at the time `until` [s].

    `again` is True of a single input that seemed to hang: where the machine stood still, it now
    does not.
    """

    target: Target
    seed: int
    first: int
    last: int
    until: float
    again: bool = False


@dataclass
class Worker:
    """A process at work on a block."""

    block: Block
    pid: int
    folder: Path
    place: mmap.mmap
    cpu: float = 0.0  # processor time [s], once it has ended

    def progress(self) -> tuple[int, float, int, int, bool]:
        """Return index, time since its start [s], inputs done, accepted, and whether it ended."""
        index, since, done, accepted, ended = _PROGRESS.unpack_from(self.place)
        return index, time.monotonic() - since, done, accepted, bool(ended)

    def failures(self) -> Iterator[Failure]:
        """Yield what the process noted."""
        with (self.folder / "failures").open(encoding="utf-8") as lines:
            for line in lines:
                yield Failure(**json.loads(line))

    def trace(self) -> str:
        """Return the Python calls that were under way at a crash or a hang."""
        return (self.folder / "trace").read_text(errors="replace")[:6000]

    def clean(self) -> None:
        """Remove what the process left, which is counted already."""
        self.place.close()
        for folder, _, _ in os.walk(self.folder):
            with contextlib.suppress(OSError):
                Path(folder).chmod(0o700)
        shutil.rmtree(self.folder, ignore_errors=True)


def scratch() -> Path:
    """Return a new folder, in memory where the system has such a place."""
    memory = Path("/dev/shm")
    usable = memory.is_dir() and os.access(memory, os.W_OK)
    return Path(tempfile.mkdtemp(prefix="psa_fuzz_", dir=memory if usable else None))


def start(block: Block) -> Worker:
    """Fork a process that attacks the inputs of a block."""
    folder, place = scratch(), mmap.mmap(-1, _PROGRESS.size)
    for name in ("failures", "trace"):
        (folder / name).touch()
    _PROGRESS.pack_into(place, 0, block.first, time.monotonic(), 0, 0, 0)
    sys.stdout.flush()
    sys.stderr.flush()
    parent = os.getpid()
    pid = os.fork()
    if not pid:
        _in_the_child(block, folder, place, parent)
    return Worker(block, pid, folder, place)


def ended(worker: Worker) -> list[Failure] | None:
    """Return what a process found once it has ended or hangs, else None.

    A hanging process is ended. The failure of a crash or a hang is the last of the list.
    """
    pid, status, used = os.wait4(worker.pid, os.WNOHANG)
    index, since, _, _, whole = worker.progress()
    hangs = not pid and since > worker.block.target.limit_s
    if not pid and not hangs:
        return None
    if hangs:
        os.kill(worker.pid, signal.SIGUSR1)  # its Python calls go to the trace
        time.sleep(0.05)
        os.kill(worker.pid, signal.SIGKILL)
        _, _, used = os.wait4(worker.pid, 0)
    worker.cpu = used.ru_utime + used.ru_stime
    code = os.waitstatus_to_exitcode(status) if pid else 0
    if code == _HARNESS:
        raise RuntimeError(f"the harness failed at {worker.block.target.name}:\n{worker.trace()}")
    failures = list(worker.failures())
    if hangs or not whole:
        failures.append(_last(worker, index, code, hangs=hangs))
    return failures


def _last(worker: Worker, index: int, code: int, *, hangs: bool) -> Failure:
    name, trace = worker.block.target.name, worker.trace()
    limit = worker.block.target.limit_s
    how = f"signal {signal.Signals(-code).name}" if code < 0 else f"the process ended with {code}"
    said = f"no end within {limit:g} s" if hangs else how
    own = [x.strip() for x in trace.splitlines() if "psa_casadi/" in x]
    where = own[0].split("psa_casadi/")[-1].replace('"', "") if own else "an unknown place"
    kind = HANG if hangs else CRASH
    return Failure(name, kind, f"{said}, in {where}", index, f"{said} {where}", trace)


def _in_the_child(block: Block, folder: Path, place: mmap.mmap, parent: int) -> None:
    """Attack the inputs and end the process; nothing of the parent's runs on.

    Ctrl-C is for the parent; commands that are started here heed signals as ever.
    """
    try:
        os.setpgid(0, 0)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        for which in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(which, signal.SIG_DFL)
        with (folder / "trace").open("w") as trace:
            faulthandler.enable(trace, all_threads=False)
            faulthandler.register(signal.SIGUSR1, trace, all_threads=False)
            _attack_all(block, folder, place, parent)
            faulthandler.disable()
        code = 0
    except BaseException:  # noqa: BLE001 - whatever it is, the parent must hear of it
        (folder / "trace").write_text(traceback.format_exc())
        code = _HARNESS
    os._exit(code)


def _attack_all(block: Block, folder: Path, place: mmap.mmap, parent: int) -> None:
    own = folder / "tmp"
    own.mkdir()
    os.environ["TMPDIR"], tempfile.tempdir = str(own), str(own)
    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nowhere, stream)
    _limit_memory(block.target.memory)
    done = accepted = 0
    until = min(block.until, time.monotonic() + _SLICE)
    with (folder / "failures").open("a", encoding="utf-8", buffering=1) as failures:
        for index in range(block.first, block.last):
            now = time.monotonic()
            if (now > until and not block.again) or os.getppid() != parent:
                break
            _PROGRESS.pack_into(place, 0, index, now, done, accepted, 0)
            data = block.target.make(generator(block.seed, block.target.name, index))
            taken = False
            for failure in _failures_of(block.target, data, index, folder):
                if failure is None:
                    taken = True
                else:
                    failures.write(json.dumps(failure.__dict__) + "\n")
            done, accepted = done + 1, accepted + taken
    _PROGRESS.pack_into(place, 0, block.first + done, time.monotonic(), done, accepted, 1)


def _failures_of(target: Target, data: bytes, index: int, folder: Path) -> Iterator[Failure | None]:
    """Yield what one input did; None says that it was accepted."""
    work = folder / "work"
    work.mkdir(exist_ok=True)
    try:
        for found in target.attack(data, work):
            yield _noted(target, found, index)
        yield None
    except PsaError:
        pass
    except Exception as error:  # noqa: BLE001 - counted as a failure
        yield _foreign(target, error, index)
    left = os.listdir(folder / "tmp")
    if left:
        shutil.rmtree(folder / "tmp", ignore_errors=True)
        (folder / "tmp").mkdir(exist_ok=True)
        yield _noted(target, Found(LEFT_OVER, f"left in TMPDIR: {_few(left)}"), index)


def _few(names: list[str]) -> str:
    return ", ".join(sorted(names)[:3])


def _noted(target: Target, found: Found, index: int) -> Failure:
    plain = "".join(c for c in found.sentence.split("'")[0] if not c.isdigit())
    return Failure(target.name, found.kind, found.sentence[:2000], index, plain[:120])


def _foreign(target: Target, error: Exception, index: int) -> Failure:
    name, where = type(error).__name__, _place_of(error.__traceback__)
    text = " ".join(str(error).split()).encode("utf-8", "backslashreplace").decode()[:200]
    detail = "".join(traceback.format_exception(error))[-4000:]
    detail = detail.encode("utf-8", "backslashreplace").decode()
    sentence = f"{name} in {where}: {text}"
    return Failure(target.name, FOREIGN, sentence, index, f"{name} {where}", detail)


def _place_of(trace: TracebackType | None) -> str:
    """Return the innermost function of the package that an error came through."""
    frames: list[Any] = traceback.extract_tb(trace)
    own = [f for f in frames if f"{os.sep}psa_casadi{os.sep}" in f.filename] or frames
    file = own[-1].filename.split(f"psa_casadi{os.sep}")[-1]
    return f"{file}:{own[-1].name}"


def _limit_memory(beside: int | None) -> None:
    """Let the process take so many bytes of address space beside what it has."""
    if beside is None or not sys.platform.startswith("linux"):
        return
    import resource  # noqa: PLC0415 - not on every system

    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + beside
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
