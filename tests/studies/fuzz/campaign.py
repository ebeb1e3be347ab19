"""A campaign: forked processes attack thousands of inputs; a crash or a hang belongs to one input.

A target draws its inputs from (seed, name, number) alone: one number is one input everywhere.
"""

import faulthandler
import multiprocessing
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf
from multiprocessing.connection import Connection
from pathlib import Path
from random import Random
from typing import NamedTuple

from psa_casadi import InputError, PsaError

#: Ways to fail. The first two are visible from outside: a signal, and no end within the limit.
CRASH, HANG = "crash", "hang"
FOREIGN, FALSE_PASS = "foreign error", "false pass"
HALF_WRITTEN, LEFT_OVER, WRONG_EXIT = "half-written", "left over", "wrong exit"
KINDS = (CRASH, FOREIGN, HANG, FALSE_PASS, HALF_WRITTEN, LEFT_OVER, WRONG_EXIT)
#: A process takes this long, then another target may have its turn [s].
_SLICE = 2.0
_FORK = multiprocessing.get_context("fork")


class Finding(NamedTuple):
    """Something that must not be: its kind and a sentence."""

    kind: str
    sentence: str


class Draw(Random):
    """A random number generator with the index of its input, to go through a table."""

    turn: int = 0


@dataclass(frozen=True)
class Target:
    """One thing that is attacked.

    `make` returns an input drawn from a generator. `attack` does something with it in an empty
    folder and yields what must not be; an error of the package is a refusal of the input,
    which is right, any other is a failure. `share` is the part of a room's time that it gets,
    `limit_s` how long one input may take, `memory` what a process may take besides what it has
    [bytes]. `prepare` is called before the first process is forked, which has what it loads.
    """

    name: str
    room: str
    suffix: str
    make: Callable[[Draw], bytes]
    attack: Callable[[bytes, Path], Iterator[Finding]]
    share: float = 1.0
    limit_s: float = 10.0
    memory: int | None = 1 << 30
    prepare: Callable[[], object] = lambda: None


@dataclass(frozen=True)
class Failure:
    """An input that led to something that must not be; `signature` is equal for one cause."""

    target: str
    kind: str
    sentence: str
    index: int
    signature: str
    detail: str = ""


@dataclass
class Distinct:
    """One cause: its first failure, the file that shows it, and how often it was met."""

    first: Failure
    file: Path | None = None
    times: int = 0


@dataclass
class Tally:
    """What a campaign counted, by target, and the distinct failures."""

    seed: int
    inputs: Counter[str] = field(default_factory=Counter)
    accepted: Counter[str] = field(default_factory=Counter)
    seconds: dict[str, float] = field(default_factory=dict)
    kinds: Counter[tuple[str, str]] = field(default_factory=Counter)
    distinct: dict[tuple[str, str, str], Distinct] = field(default_factory=dict)

    @property
    def failures(self) -> int:
        """Failures of every kind."""
        return self.kinds.total()


class _Block(NamedTuple):
    """Inputs `first` up to `last` of a target; `alone` repeats one that seemed to hang."""

    target: Target
    first: int
    last: int
    alone: bool = False


def generator(seed: int, target: str, index: int) -> Draw:
    """Return the generator of one input; it depends on nothing else."""
    drawn = Draw(f"{seed}/{target}/{index}")
    drawn.turn = index
    return drawn


def run(
    targets: Sequence[Target],
    seed: int,
    *,
    seconds: float = inf,
    inputs: Mapping[str, int] | None = None,
    first: int = 0,
    jobs: int | None = None,
    keep: Path | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Tally:
    """Attack the targets and return what was counted.

    With `inputs` of each target from `first` on, or for `seconds` for all of them; `keep` is
    the folder for failing inputs. Ctrl-C ends it early, with what was counted until then.
    """
    until, tally, running = time.monotonic() + seconds, Tally(seed), list[_Worker]()
    count = inputs or dict.fromkeys([t.name for t in targets], 1 << 40)
    waiting = deque(_Block(t, first, first + count[t.name]) for t in targets)
    shares = {t.name: t.share / sum(o.share for o in targets if o.room == t.room) for t in targets}
    for target in targets:
        target.prepare()

    def turn(block: _Block) -> float:
        """Return what a target has had of its share; its processes count from their start."""
        name = block.target.name
        started = sum(1e-3 for w in running if w.block.target.name == name)
        return -1.0 if block.alone else (tally.seconds.get(name, 0.0) + started) / shares[name]

    try:
        while True:
            late = time.monotonic() > until
            ready = [b for b in waiting if b.alone or not late]
            if ready and len(running) < (jobs or os.cpu_count() or 1):
                block = min(ready, key=turn)
                waiting.remove(block)
                running.append(_Worker(block, seed, until))
                continue
            if not running:
                return tally
            time.sleep(0.01)
            for worker in [w for w in running if w.has_ended()]:
                running.remove(worker)
                waiting.extend(_counted(tally, worker, keep, progress))
                worker.clean()
    except KeyboardInterrupt:
        return tally
    finally:
        for worker in running:
            worker.clean()


def _counted(
    tally: Tally, worker: "_Worker", keep: Path | None, progress: Callable[[str], None]
) -> Iterator[_Block]:
    """Count what a process did and yield what is left of its block."""
    block, target = worker.block, worker.block.target
    tally.inputs[target.name] += worker.done + (not worker.whole) - block.alone
    tally.accepted[target.name] += worker.accepted
    tally.seconds[target.name] = tally.seconds.get(target.name, 0.0) + worker.seconds
    rest = block._replace(first=worker.index + (not worker.whole))
    if rest.first < block.last:
        yield rest
    for failure in worker.failures:
        if failure.kind == HANG and not block.alone:  # the machine may have been busy
            yield _Block(target, failure.index, failure.index + 1, alone=True)
            continue
        tally.kinds[target.name, failure.kind] += 1
        key = (target.name, failure.kind, failure.signature)
        known = tally.distinct.setdefault(key, Distinct(failure))
        known.times += 1
        if known.times > 1:
            continue
        progress(f"{target.name}, input {failure.index}: {failure.kind}: {failure.sentence}")
        if keep is not None:
            keep.mkdir(parents=True, exist_ok=True)
            known.file = keep / f"{target.name}-{tally.seed}-{failure.index}{target.suffix}"
            drawn = generator(tally.seed, target.name, failure.index)
            known.file.write_bytes(target.make(drawn))
            progress(f"    again: python -m tests.studies fuzz --replay {known.file}")


class _Worker:
    """A process that attacks the inputs of a block, and its messages so far."""

    def __init__(self, block: _Block, seed: int, until: float) -> None:
        self.block, self.index, self.since = block, block.first, time.monotonic()
        self.done, self.accepted, self.whole, self.seconds = 0, 0, False, 0.0
        self.failures: list[Failure] = []
        memory = Path("/dev/shm")
        usable = memory.is_dir() and os.access(memory, os.W_OK)
        self.folder = Path(tempfile.mkdtemp(prefix="psa_fuzz_", dir=memory if usable else None))
        self._heard, theirs = _FORK.Pipe(duplex=False)
        self._begun = self.since
        arguments = (block, seed, until, self.folder, theirs, os.getpid())
        self._process = _FORK.Process(target=_work, args=arguments)
        self._process.start()
        theirs.close()

    def has_ended(self) -> bool:
        """Read the messages of the process; end one that hangs."""
        try:
            while self._heard.poll():
                self._hear(*self._heard.recv())
        except (EOFError, OSError):
            self._process.join()
            code = self._process.exitcode or 0
            how = signal.Signals(-code).name if code < 0 else f"the process ended with {code}"
            self._end(CRASH, how)
            return True
        hangs = time.monotonic() - self.since > self.block.target.limit_s
        if hangs and self._process.pid:
            os.kill(self._process.pid, signal.SIGUSR1)  # its Python calls go to the trace
            time.sleep(0.05)
            self._end(HANG, f"no end within {self.block.target.limit_s:g} s")
        return hangs

    def _hear(self, what: str, value: int | Failure | str | float) -> None:
        match value:
            case Failure():
                self.failures.append(value)
            case str():
                raise RuntimeError(f"the harness failed at {self.block.target.name}:\n{value}")
            case float():
                self.seconds, self.whole, self.index = value, True, self.block.first + self.done
            case int() if what == "start":
                self.index, self.since = value, time.monotonic()
            case int():
                self.done, self.accepted = self.done + 1, self.accepted + value

    def _end(self, kind: str, how: str) -> None:
        if self.whole:
            return
        self.seconds = time.monotonic() - self._begun
        trace = (self.folder / "trace").read_text(errors="replace")[:6000]
        lines = [x.strip() for x in trace.splitlines() if "psa_casadi/" in x]
        where = lines[0].split("psa_casadi/")[-1].replace('"', "") if lines else "an unknown place"
        sentence, name = f"{how}, in {where}", self.block.target.name
        self.failures.append(Failure(name, kind, sentence, self.index, sentence, trace))

    def clean(self) -> None:
        """End the process and remove its files, which are already counted."""
        self._process.kill()
        self._process.join()
        for folder, _, _ in os.walk(self.folder):
            Path(folder).chmod(0o700)
        shutil.rmtree(self.folder, ignore_errors=True)


def _work(
    block: _Block, seed: int, until: float, folder: Path, connection: Connection, parent: int
) -> None:
    """Attack the inputs; Ctrl-C is for the parent, commands that are started heed signals."""
    os.setpgid(0, 0)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for which in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(which, signal.SIG_DFL)
    with (folder / "trace").open("w") as trace:
        faulthandler.enable(trace, all_threads=False)
        faulthandler.register(signal.SIGUSR1, trace, all_threads=False)
        try:
            _attack_all(
                block, seed, min(until, time.monotonic() + _SLICE), folder, connection, parent
            )
        except BaseException:  # noqa: BLE001 - whatever it is, the parent must hear of it
            connection.send(("fails", traceback.format_exc()))
    os._exit(0)


def _attack_all(
    block: _Block, seed: int, until: float, folder: Path, connection: Connection, parent: int
) -> None:
    target, temporary, work = block.target, folder / "tmp", folder / "work"
    temporary.mkdir()
    os.environ["TMPDIR"], tempfile.tempdir = str(temporary), str(temporary)
    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nowhere, stream)
    if target.memory is not None and sys.platform.startswith("linux"):
        held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (held + target.memory,) * 2)
    for index in range(block.first, block.last):
        if (time.monotonic() > until and not block.alone) or os.getppid() != parent:
            break
        connection.send(("start", index))
        data = target.make(generator(seed, target.name, index))
        work.mkdir(exist_ok=True)
        accepted = False
        try:
            for result in target.attack(data, work):
                connection.send(("fails", _failure(target, result, index)))
            accepted = True
        except PsaError:
            pass
        except Exception as error:  # noqa: BLE001 - counted as a failure
            connection.send(("fails", _foreign(target, error, index)))
        if left := sorted(os.listdir(temporary)):
            shutil.rmtree(temporary, ignore_errors=True)
            temporary.mkdir(exist_ok=True)
            result = Finding(LEFT_OVER, f"left in TMPDIR: {', '.join(left[:3])}")
            connection.send(("fails", _failure(target, result, index)))
        connection.send(("ends", int(accepted)))
    used = [resource.getrusage(w) for w in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    connection.send(("whole", sum(u.ru_utime + u.ru_stime for u in used)))


def _failure(target: Target, finding: Finding, index: int) -> Failure:
    plain = "".join(c for c in finding.sentence.split("'")[0] if not c.isdigit())
    return Failure(target.name, finding.kind, finding.sentence[:2000], index, plain[:120])


def _foreign(target: Target, error: Exception, index: int) -> Failure:
    """Return the failure that an error is, with the innermost function of the package."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [f for f in frames if f"{os.sep}psa_casadi{os.sep}" in f.filename] or list(frames)
    where = f"{ours[-1].filename.split(f'psa_casadi{os.sep}')[-1]}:{ours[-1].name}"
    similar, whole = (
        f"{type(error).__name__} in {where}",
        "".join(traceback.format_exception(error)),
    )
    sentence = f"{similar}: {' '.join(str(error).split())[:200]}"
    printable = [t.encode("utf-8", "backslashreplace").decode() for t in (sentence, whole[-4000:])]
    return Failure(target.name, FOREIGN, printable[0], index, similar, printable[1])


def replay(path: Path, targets: Mapping[str, Target]) -> Tally:
    """Attack with the content of a saved file, whose name starts with that of the target.

    Raises InputError where there is no such file, or its name has no target.
    """
    name = next((n for n in targets if path.name.startswith(f"{n}-")), None)
    if name is None or not path.is_file():
        raise InputError(f"{path}: is no saved input; its name must begin with a target and '-'.")
    data = path.read_bytes()
    target = replace(targets[name], make=lambda _: data)
    return run([target], 0, inputs={name: 1}, jobs=1)
