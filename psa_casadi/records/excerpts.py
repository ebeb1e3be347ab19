"""Parts of records that are too long to be fitted whole: some of every kind of motion."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from psa_casadi.records.record import Record
from psa_casadi.records.stretches import stretches

#: Samples that are fitted of all records together. A fit takes some 0.1 ms and 2 kB for each, a
#: diagnosis 0.1 ms and 6 kB; with so many the intervals are a few parts in ten thousand, and what
#: the model lacks is larger.
MOST = 200_000
#: Parts that stand for one record, and the samples that it may have however many records there are.
PARTS, LEAST = 4, 20_000
#: What comes this close to the highest or the lowest voltage, over its range, reaches it.
_REACHED = 2e-3


def excerpts(records: Sequence[Record]) -> tuple[list[Record], list[str]]:
    """Return the records with parts in place of those that are too long, and sentences on these.

    All together have `MOST` samples at most, and every record its fair share of them, at least
    `LEAST`. The parts of a record are of equal length: its beginning, then in turn what shows the
    most kinds of stretch (rises, falls and holds, see `stretches`) and ends of the voltage's range
    that the parts so far do not, as far from these as it can be. A part begins as a record does,
    with a state that nobody knows.
    """
    shares = _shares([r.n for r in records])
    found: list[Record] = []
    said: list[str] = []
    for record, share in zip(records, shares, strict=True):
        if record.n <= share:
            found.append(record)
            continue
        length = share // PARTS
        begins = [k * length for k in _chosen(record, length)]
        found += [record.slice(a, a + length) for a in begins]
        places = ", ".join(f"{record.time[a]:.4g} s" for a in begins)
        lasts = record.time[length] - record.time[0]
        said.append(
            f"{record.name}: of {record.n} samples {PARTS} parts of {length} are used, which begin"
            f" at {places}: they have each kind of rise, fall and hold that fits into them, and"
            f" tell nothing slower than a part, {lasts:.3g} s; give a record with fewer samples a"
            " second for that."
        )
    return found, said


def _shares(counts: Sequence[int]) -> list[int]:
    """Return how many samples each record may have: what short ones leave is the others'."""
    shares, left = [0] * len(counts), MOST
    for done, k in enumerate(sorted(range(len(counts)), key=lambda k: counts[k])):
        shares[k] = min(counts[k], max(LEAST, left // (len(counts) - done)))
        left -= shares[k]
    return shares


def _chosen(record: Record, length: int) -> list[int]:
    """Return which of the parts of a length stand for a record, in the order of time."""
    shown = _kinds(record, length)
    chosen = [0]
    while len(chosen) < PARTS:
        new = np.sum(shown & ~np.any(shown[chosen], axis=0), axis=1)
        away = np.min(np.abs(np.subtract.outer(np.arange(len(shown)), chosen)), axis=1)
        new[chosen] = -1
        chosen.append(int(np.lexsort((away, new))[-1]))
    return sorted(chosen)


def _kinds(record: Record, length: int) -> npt.NDArray[np.bool_]:
    """Return which kinds of stretch each part of a record shows, and ends of the voltage's range.

    Shape (parts, kinds + 2).
    """
    v, span = record.voltage, float(np.ptp(record.voltage))
    kinds, which = stretches(record, span)
    shown = np.zeros((record.n // length, len(kinds) + 2), dtype=np.bool_)
    last = len(shown) * length
    part = np.arange(last) // length
    shown[part, which[:last]] = True
    shown[part[v[:last] >= np.max(v) - _REACHED * span], -2] = True
    shown[part[v[:last] <= np.min(v) + _REACHED * span], -1] = True
    return shown
