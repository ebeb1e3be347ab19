"""What long work costs: time, processor time and simulations of its stages, and steps in all."""

import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from threading import Lock, get_ident

from psa_casadi.common.interruption import set_within

#: What is spent outside every stage.
REST = "rest"


@dataclass
class Stage:
    """What one stage took: seconds, processor seconds of all threads, and simulations.

    `differentiated` of the `runs` were with sensitivities. A stage within another one counts for
    itself only.
    """

    name: str
    wall: float = 0.0
    processor: float = 0.0
    runs: int = 0
    differentiated: int = 0


class Timings:
    """The stages of one piece of work, in the order in which they began, then the rest.

    The thread that made it sets the stages; runs count from whatever thread works for it.
    """

    def __init__(self) -> None:
        self._spent = {REST: Stage(REST)}
        self._within = [REST]
        self._thread, self._lock = get_ident(), Lock()
        self._since = (time.perf_counter(), time.process_time())

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle what every stage has taken so far."""
        return _finished, (self.stages,)

    @property
    def stages(self) -> tuple[Stage, ...]:
        """What every stage has taken so far."""
        if get_ident() == self._thread:
            self._settle()
        named = [s for name, s in self._spent.items() if name != REST]
        return tuple(map(replace, (*named, self._spent[REST])))

    @contextmanager
    def within(self, name: str) -> Iterator[None]:
        """Count what follows for a stage; in another thread it stays the present one's."""
        if get_ident() != self._thread:
            yield
            return
        self._settle()
        self._within.append(name)
        self._spent.setdefault(name, Stage(name))
        try:
            yield
        finally:
            self._settle()
            self._within.pop()

    def count(self, *, differentiated: bool) -> None:
        """Count one simulation."""
        with self._lock:
            present = self._spent[self._within[-1]]
            present.runs += 1
            present.differentiated += differentiated

    def _settle(self) -> None:
        """Add the time since the last change to the present stage."""
        with self._lock:
            now, since = (time.perf_counter(), time.process_time()), self._since
            present, self._since = self._spent[self._within[-1]], now
            present.wall += now[0] - since[0]
            present.processor += now[1] - since[1]


def _finished(stages: tuple[Stage, ...]) -> Timings:
    """Return timings to which no thread adds."""
    timings = Timings()
    timings._spent, timings._thread = {s.name: s for s in stages}, -1
    return timings


_timings: ContextVar[Timings | None] = ContextVar("timings", default=None)


def timed() -> AbstractContextManager[Timings]:
    """Record the stages of all work within.

    Processor time is that of the whole process, whatever else runs in it.
    """
    return set_within(_timings, Timings())


@contextmanager
def stage(name: str) -> Iterator[None]:
    """Count what is done within as a stage where someone records it; also a decorator."""
    timings = _timings.get()
    if timings is None:
        yield
    else:
        with timings.within(name):
            yield


class Work:
    """Steps of simulations, times one plus their derivatives: the same everywhere.

    Some 60 ns of processor time each, and as much for the algebra of a fit.
    """

    def __init__(self) -> None:
        self.done = 0
        self._lock = Lock()

    def add(self, steps: int) -> None:
        """Count steps, from whatever thread."""
        with self._lock:
            self.done += steps


_work: ContextVar[Work | None] = ContextVar("work", default=None)


def counted() -> AbstractContextManager[Work]:
    """Count the steps of all simulations within."""
    return set_within(_work, Work())


def count_run(steps: int, *, differentiated: bool) -> None:
    """Count a simulation for the present stage, and its steps, where someone records them."""
    if timings := _timings.get():
        timings.count(differentiated=differentiated)
    if work := _work.get():
        work.add(steps)
