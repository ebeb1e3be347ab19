"""A campaign: many inputs for many targets, side by side, counted."""

import os
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from math import inf
from pathlib import Path
from typing import Any

from tests.fuzz.target import HANG, Target, generator
from tests.fuzz.workers import Block, Failure, Worker, ended, start

#: How often the processes are looked at [s].
_LOOK = 0.01
#: The most inputs of one process, and the most of a target in all.
_BLOCK, _MANY = 4000, 1 << 40


@dataclass
class Distinct:
    """One cause: its first failure, the file that shows it, and how often it was met."""

    first: Failure
    seed: int
    file: Path | None = None
    times: int = 0


@dataclass
class Tally:
    """What a campaign counted, by target, and the distinct failures."""

    seed: int
    inputs: Counter[str] = field(default_factory=Counter)
    accepted: Counter[str] = field(default_factory=Counter)
    #: Processor time, of the processes that they start too [s].
    seconds: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))
    kinds: Counter[tuple[str, str]] = field(default_factory=Counter)
    distinct: dict[tuple[str, str, str], Distinct] = field(default_factory=dict)

    @property
    def failures(self) -> int:
        """Failures of every kind."""
        return sum(self.kinds.values())

    def note(self, failure: Failure) -> Distinct | None:
        """Count a failure; return it where it is the first of its cause."""
        self.kinds[failure.target, failure.kind] += 1
        key = (failure.target, failure.kind, failure.alike)
        new = key not in self.distinct
        known = self.distinct.setdefault(key, Distinct(failure, self.seed))
        known.times += 1
        return known if new else None


@dataclass(frozen=True)
class Amount:
    """How much is done: inputs of each target from `first` on, or seconds for all of them."""

    seconds: float = inf
    inputs: Mapping[str, int] | None = None
    first: int = 0


def run(
    targets: Sequence[Target],
    seed: int,
    amount: Amount,
    *,
    jobs: int | None = None,
    keep: Path | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Tally:
    """Attack the targets and return what was counted; `keep` is the folder for failing inputs.

    Ctrl-C ends it early, with what was counted until then.
    """
    for target in targets:
        target.prepare()
    plan = _Plan(targets, seed, amount)
    tally = Tally(seed)
    running: list[Worker] = []
    try:
        while True:
            while len(running) < (jobs or os.cpu_count() or 1) and (block := plan.next()):
                running.append(start(block))
            if not running:
                return tally
            time.sleep(_LOOK)
            for worker in list(running):
                failures = ended(worker)
                if failures is not None:
                    running.remove(worker)
                    _count(tally, plan, worker)
                    for new in _new(tally, plan, worker, failures):
                        _tell(new, worker.block, keep, progress)
                    worker.clean()
    except KeyboardInterrupt:
        return tally
    finally:
        for worker in running:
            with suppress(ProcessLookupError, ChildProcessError):  # it has ended
                os.kill(worker.pid, 9)
                os.waitpid(worker.pid, 0)
            worker.clean()


class _Plan:
    """Gives the next block: of the target with the least time so far, what was left of it first."""

    def __init__(self, targets: Sequence[Target], seed: int, amount: Amount) -> None:
        self._until = time.monotonic() + amount.seconds
        ends = {t.name: _MANY if amount.inputs is None else amount.inputs[t.name] for t in targets}
        self._rest = {
            t.name: [Block(t, seed, amount.first, amount.first + ends[t.name], self._until)]
            for t in targets
        }
        self.spent = dict.fromkeys(ends, 0.0)
        rooms = {t.room for t in targets}
        of_room = {r: sum(t.share for t in targets if t.room == r) for r in rooms}
        self._share = {t.name: t.share / of_room[t.room] for t in targets}

    def next(self) -> Block | None:
        late = time.monotonic() > self._until
        waiting = [(b, own) for own in self._rest.values() for b in own if b.again or not late]
        if not waiting:
            return None
        block, own = min(waiting, key=lambda w: (self._turn(w[0]), w[0].first))
        own.remove(block)
        if block.again:
            return block
        self.spent[block.target.name] += 1e-3  # so that the next process takes another target
        part = min(block.last, block.first + _BLOCK)
        self.put(block, part)
        return replace(block, last=part)

    def _turn(self, block: Block) -> float:
        name = block.target.name
        return -1.0 if block.again else self.spent[name] / self._share[name]

    def put(self, block: Block, first: int, **changes: Any) -> None:
        """Put back what is left of a block."""
        if first < block.last:
            self._rest[block.target.name].append(replace(block, first=first, **changes))

    def try_again(self, block: Block, index: int) -> None:
        """Let one input that seemed to hang be tried alone, even after the end of the campaign."""
        self.put(replace(block, last=index + 1), index, until=inf, again=True)


def _count(tally: Tally, plan: _Plan, worker: Worker) -> None:
    name = worker.block.target.name
    index, _, done, accepted, whole = worker.progress()
    tally.inputs[name] += done + (not whole) - worker.block.again
    tally.accepted[name] += accepted
    tally.seconds[name] += worker.cpu
    plan.spent[name] += worker.cpu
    if not worker.block.again:
        plan.put(worker.block, index + (not whole))


def _new(
    tally: Tally, plan: _Plan, worker: Worker, failures: Sequence[Failure]
) -> Iterator[Distinct]:
    """Count failures and yield those of a new cause; a hang counts when it hangs again."""
    for failure in failures:
        if failure.kind == HANG and not worker.block.again:
            plan.try_again(worker.block, failure.index)
        elif (new := tally.note(failure)) is not None:
            yield new


def _tell(new: Distinct, block: Block, keep: Path | None, progress: Callable[[str], None]) -> None:
    """Save the input of a failure, and tell how to see it again."""
    target, first = block.target, new.first
    if keep is not None:
        keep.mkdir(parents=True, exist_ok=True)
        new.file = keep / f"{target.name}-{block.seed}-{first.index}{target.suffix}"
        new.file.write_bytes(target.make(generator(block.seed, target.name, first.index)))
    progress(f"{target.name}, input {first.index}: {first.kind}: {first.sentence}")
    if new.file is not None:
        progress(f"    again: python -m tests.benchmarks fuzz --replay {new.file}")
