"""Kinds of stretches of a voltage: rises and falls by size and duration, and holds."""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from psa_casadi.records.record import Record
from psa_casadi.records.repeats import held
from psa_casadi.records.turns import reversals

#: Turns by less than this share of the span are no reversals here; sizes of rises and falls are
#: told apart at these shares of it, durations by this factor.
_TURNS, _SIZES, _FACTOR = 0.01, (0.1, 0.5), 4.0
_SIZE_WORDS = ("small", "medium", "large")


class Kind(NamedTuple):
    """A kind of stretch: `way` 1 up, -1 down, 0 held; size 0 to 2; log_4 of the duration in s."""

    way: int
    size: int
    band: int

    def near(self, other: "Kind") -> bool:
        """Whether kinds go the same way and lie side by side in size and duration."""
        close = abs(self.size - other.size) <= 1 and abs(self.band - other.band) <= 1
        return self.way == other.way and close

    @property
    def words(self) -> str:
        """The kind in words, such as "large rises of 0.1 to 0.4 s"."""
        if self.way == 0:
            return "held voltages"
        low, high = _FACTOR**self.band, _FACTOR ** (self.band + 1)
        way = "rises" if self.way > 0 else "falls"
        return f"{_SIZE_WORDS[self.size]} {way} of {low:.2g} to {high:.2g} s"


def stretches(record: Record, span: float) -> tuple[tuple[Kind, ...], npt.NDArray[np.intp]]:
    """Return the kinds of stretches of a record, and which of them each sample (n,) belongs to.

    A stretch lasts from one reversal of the voltage to the next; its size is told in shares of the
    `span` [V]. What is held within it is a kind of its own.
    """
    if not span > 0:
        return (Kind(0, 0, 0),), np.zeros(record.n, dtype=np.intp)
    v, t = record.voltage, record.time
    ends = [0, *reversals(v, _TURNS * span).tolist(), record.n - 1]
    each: list[Kind] = []
    which = np.zeros(record.n, dtype=np.intp)
    for start, stop in pairwise(ends):
        change, lasts = float(v[stop] - v[start]), float(t[stop] - t[start])
        size = int(np.searchsorted(_SIZES, abs(change) / span))
        band = int(np.floor(np.log(max(lasts, record.sample_time)) / np.log(_FACTOR)))
        which[start : stop + 1] = len(each)
        each.append(Kind(1 if change > 0 else -1, size, band))
    for start, stop in held(record):
        which[start:stop] = len(each)
    each.append(Kind(0, 0, 0))
    kinds = tuple(sorted({each[k] for k in np.unique(which)}))
    place = np.array([kinds.index(k) if k in kinds else 0 for k in each], dtype=np.intp)
    return kinds, place[which]


def loop_sizes(records: Sequence[Record], span: float) -> int:
    """Return how many sizes the ways between two reversals have, a tenth of the `span` [V] apart.

    The ways to the first reversal and from the last one are no part of a loop.
    """
    ways = [np.abs(np.diff(r.voltage[reversals(r.voltage, _TURNS * span)])) for r in records]
    sizes = np.sort(np.concatenate(ways)) / span
    return int(np.sum(np.diff(sizes) > _SIZES[0])) + 1 if sizes.size else 0


def counts(
    records: Sequence[Record], chosen: Sequence[npt.NDArray[np.bool_]], span: float
) -> dict[Kind, int]:
    """Return how many of the `chosen` samples of the records belong to each kind."""
    found: dict[Kind, int] = {}
    for record, mask in zip(records, chosen, strict=True):
        kinds, which = stretches(record, span)
        for kind, count in zip(kinds, np.bincount(which[mask], minlength=len(kinds)), strict=True):
            found[kind] = found.get(kind, 0) + int(count)
    return {k: n for k, n in found.items() if n}
