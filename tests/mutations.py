"""Content with wrong bytes, the same in every run."""

import random
import struct
from collections.abc import Callable, Iterator

from psa_casadi.errors import InputError

#: Values that stand for types, classes, sizes and ends in binary files.
_TELLING = (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 13, 14, 15, 16, 17, 18, 127, 128, 255)
_WORDS = (0, 1, 2**31 - 1, 2**31, 2**32 - 1, 2**28)


def changed(content: bytes, count: int, *, seed: int) -> Iterator[bytes]:
    """Yield `count` changed forms of a content: bytes and words replaced, removed, repeated."""
    draw = random.Random(seed)
    for _ in range(count):
        wrong = bytearray(content)
        for _ in range(draw.choice((1, 1, 1, 2, 4))):
            _change(wrong, draw)
        yield bytes(wrong)


def sentences(call: Callable[[], object]) -> tuple[str, ...]:
    """Return the sentences with which a call refuses what it is given, none where it does not."""
    try:
        call()
    except InputError as error:
        return error.problems
    return ()


def _change(wrong: bytearray, draw: random.Random) -> None:
    at = draw.randrange(len(wrong))
    kind = draw.randrange(6)
    if kind == 0:
        wrong[at] = draw.choice(_TELLING)
    elif kind == 1:
        wrong[at] = draw.randrange(256)
    elif kind == 2:
        wrong[at] ^= 1 << draw.randrange(8)
    elif kind == 3 and len(wrong) > 8:
        at = min(at & ~3, len(wrong) - 4)
        wrong[at : at + 4] = struct.pack("<I", draw.choice(_WORDS))
    elif kind == 4:
        wrong[at:at] = wrong[at : at + draw.choice((1, 8, 40))]
    elif len(wrong) > 100:
        del wrong[at : at + draw.choice((1, 4, 8, 64))]
