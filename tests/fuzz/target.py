"""What is attacked: where the inputs come from, what is done with them, what must hold."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from random import Random

#: Ways to fail. The first two are seen from outside: a signal, and no end within the limit.
CRASH, HANG = "crash", "hang"
FOREIGN, FALSE_PASS = "foreign error", "false pass"
HALF_WRITTEN, LEFT_OVER, WRONG_EXIT = "half-written", "left over", "wrong exit"
KINDS = (CRASH, FOREIGN, HANG, FALSE_PASS, HALF_WRITTEN, LEFT_OVER, WRONG_EXIT)


@dataclass(frozen=True)
class Found:
    """Something that must not be: its kind and a sentence."""

    kind: str
    sentence: str


class Draw(Random):
    """A generator of random numbers that knows the turn of its input, to go through a table."""

    turn: int = 0


#: Does something with an input in an empty folder, yields what must not be. An error of the package
#: says that the input was refused, which is right; any other error is a failure.
Attack = Callable[[bytes, Path], Iterator[Found]]


@dataclass(frozen=True)
class Target:
    """One thing that is attacked.

    `make` returns an input drawn from a generator, the same for the same seed; a file with `suffix`
    keeps it. `share` is the part of a room's time that it gets, `limit_s` how long one input may
    take, `memory` what a process may take beside what it has [bytes]. `prepare` is called once
    before the first process is forked, which then has what it loads.
    """

    name: str
    room: str
    suffix: str
    make: Callable[[Draw], bytes]
    attack: Attack
    share: float = 1.0
    limit_s: float = 10.0
    memory: int | None = 1 << 30
    prepare: Callable[[], object] = lambda: None


def generator(seed: int, target: str, index: int) -> Draw:
    """Return the generator of one input; it depends on nothing else."""
    drawn = Draw(f"{seed}/{target}/{index}")
    drawn.turn = index
    return drawn
