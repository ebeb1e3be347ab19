"""Gaps in time: stretches in which nobody knows what the voltage did."""

from collections.abc import Iterable
from itertools import pairwise

import numpy as np

from psa_casadi.records.record import FEWEST_SAMPLES, Record
from psa_casadi.records.suspects import HIDDEN

#: An interval is a gap from so many times the intervals beside it on.
_LONG = 10.0


def without_gaps(records: Iterable[Record]) -> tuple[list[Record], list[str]]:
    """Return the records, cut into parts where a gap hides what the voltage did; and what was cut.

    A part begins as a record does, with a state that nobody knows: what the stack remembers of a
    gap is not what a straight line of the voltage would have left.
    """
    parts, said = [], []
    for record in records:
        at = gaps(record)
        if not at:
            parts.append(record)
            continue
        ends = [0, *(k + 1 for k in at), record.n]
        parts += [record.slice(a, b) for a, b in pairwise(ends)]
        places = ", ".join(
            f"{record.time[k + 1] - record.time[k]:.4g} s from {record.time[k]:.6g} s on"
            for k in at
        )
        said.append(
            f"{record.name}: no sample for {places}, while the voltage moves: what it did there is"
            f" not known, so that the {len(at) + 1} parts count as records of their own."
        )
    return parts, said


def gaps(record: Record) -> tuple[int, ...]:
    """Return the samples after which there is a gap that hides a motion of the voltage.

    It is many times as long as the intervals before and after it, and a voltage that went on as it
    did before, or as it does after it, would have missed its other end by more than a share of its
    range. Both parts have samples enough for a record.
    """
    step, change = np.diff(record.time), np.diff(record.voltage)
    inner = np.arange(1, step.size - 1)
    around = np.maximum(step[:-2], step[2:])
    missed = [
        np.abs(change[inner] - step[inner] * change[side] / step[side])
        for side in (inner - 1, inner + 1)
    ]
    hidden = np.maximum(*missed) > HIDDEN * np.ptp(record.voltage)
    found: list[int] = []
    for k in inner[(step[inner] > _LONG * around) & hidden].tolist():
        begin = found[-1] + 1 if found else 0
        if k + 1 - begin >= FEWEST_SAMPLES and record.n - (k + 1) >= FEWEST_SAMPLES:
            found.append(k)
    return tuple(found)
