"""Training and held-out samples of a record: a quarter is held out, whole segments together."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import numpy.typing as npt

from psa_casadi.records.record import Record
from psa_casadi.records.stretches import stretches
from psa_casadi.records.turns import reversals

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

#: Number of blocks a record is cut into, and of how many one is held out when no record is named.
BLOCKS, HELD_OUT_EVERY = 16, 4
#: Blocks that come this close to the record's highest or lowest value, over its range, reach it.
_REACHED = 2e-3
#: A part shows a kind of stretch from this share of its samples on.
_SHOWN = 0.05


@dataclass(frozen=True)
class Level:
    """The noise level that weights a further column of the records in a fit, in its SI unit."""

    column: str
    value: float


@dataclass(frozen=True, eq=False)
class Experiment:
    """A record with the samples that count for a fit (`used`) and those held out for judging it.

    A record that is held out whole has no used ones: see `judging`. `further` are the columns
    beside the displacement that are fitted as well; the same in all experiments of a fit, whether a
    record has them or not.
    """

    record: Record
    used: BoolArray
    held_out: BoolArray
    further: tuple[Level, ...] = ()

    @property
    def held_out_whole(self) -> bool:
        """Whether no sample of the record is fitted; what comes before finds where it begins."""
        return bool(self.held_out.any() and not self.used.any())

    @property
    def known(self) -> BoolArray:
        """The samples that are not held out: the used ones, or those that find the beginning."""
        found: BoolArray = self.record.mask & ~self.held_out
        return found

    @property
    def stop(self) -> int:
        """One past the last used sample: a fit need not simulate further; 0 without any."""
        return int(np.max(np.flatnonzero(self.used), initial=-1)) + 1


def whole(record: Record) -> Experiment:
    """Return the experiment that uses every valid sample of a record and holds out none."""
    return Experiment(record, record.mask, np.zeros(record.n, dtype=bool))


def judging(record: Record) -> Experiment:
    """Return the experiment that is held out whole: no fit sees a sample of it.

    Its first tenth is not judged: it finds the record's offset, and its memory.
    """
    lead = np.arange(record.n) < max(8, record.n // 10)
    return Experiment(record, np.zeros(record.n, dtype=bool), record.mask & ~lead)


def fitted(experiments: Sequence[Experiment]) -> list[Experiment]:
    """Return the experiments that have samples to fit."""
    return [e for e in experiments if not e.held_out_whole]


def split(record: Record) -> Experiment:
    """Hold out one of every four of a record's sixteen blocks: a quarter of the record.

    It is the last one of each four, unless the voltage or its rate would then be highest or lowest
    in held-out samples alone: what only shows there (a limited current, a clipped voltage) has to
    be learnt before it can be judged. And unless another choice shows more kinds of stretch (rises,
    falls and holds, see `stretches`) in both parts. What the displacement is has no say in it.

    Blocks begin at voltage reversals, so that a segment between two reversals is never cut unless
    it is longer than a block. Taking the held-out quarter from all over the record, rather than
    from its end alone, keeps a class of voltage that occurs once (minor loops at the end of a
    record of full loops) from being judged without ever having been learnt.
    """
    turns = reversals(record.voltage)
    edges = []
    for k in range(BLOCKS + 1):
        point = round(k * record.n / BLOCKS)
        near = turns[np.abs(turns - point) <= 0.5 * record.n / BLOCKS]
        inner = 0 < k < BLOCKS and len(near) > 0
        edges.append(int(near[np.argmin(np.abs(near - point))]) if inner else point)
    index = np.searchsorted(np.array(edges[1:-1]), np.arange(record.n), side="right")
    held = np.isin(index, _held_out(record, index))
    return Experiment(record, record.mask & ~held, record.mask & held)


def _held_out(record: Record, index: npt.NDArray[np.int64]) -> tuple[int, ...]:
    """Return the blocks to hold out, one of every four; `index` (n,) is the block of each sample.

    Of all choices, the one that holds the fewest extremes of voltage and rate out, among the
    samples that have a reading; of these the one with the smallest share of samples whose kind of
    stretch is not fitted, or not held out, which counts half; of these the one nearest to the last
    of each four. The first block is always fitted: the record's start is found there.
    """
    voltage = record.voltage
    rate = np.r_[0.0, np.diff(voltage) / np.diff(record.time)]
    extremes = [_reaching(s, record.mask, index) for v in (voltage, rate) for s in (v, -v)]
    groups = [range(g, g + HELD_OUT_EVERY) for g in range(0, BLOCKS, HELD_OUT_EVERY)]
    shares, near = _shares_of_kinds(record, index)

    def missed(choice: tuple[int, ...]) -> int:
        return sum(found <= set(choice) for found in extremes if found)

    def unlike(choice: tuple[int, ...]) -> float:
        whole = np.sum(shares, axis=1)
        held = np.sum(shares[:, choice], axis=1)
        unlearnt, unjudged = near @ (whole - held) < _SHOWN * whole, near @ held < _SHOWN * whole
        return round(float(whole @ (unlearnt + 0.5 * unjudged)), 2)

    choices = (c for c in product(*groups) if 0 not in c)
    return min(choices, key=lambda c: (missed(c), unlike(c), -sum(c), c))


def _shares_of_kinds(record: Record, index: npt.NDArray[np.int64]) -> tuple[FloatArray, FloatArray]:
    """Return the share of a record's samples in each kind of stretch and block, (kinds, blocks).

    And which kinds are near each other, (kinds, kinds).
    """
    kinds, which = stretches(record, float(np.ptp(record.voltage)))
    shares = np.zeros((len(kinds), BLOCKS))
    np.add.at(shares, (which[record.mask], index[record.mask]), 1.0 / max(1, record.mask.sum()))
    return shares, np.array([[float(k.near(other)) for other in kinds] for k in kinds])


def _reaching(values: FloatArray, valid: BoolArray, index: npt.NDArray[np.int64]) -> set[int]:
    """Return the blocks in which the valid values come up to the largest of them."""
    if not valid.any():
        return set()
    top, span = float(np.max(values[valid])), float(np.ptp(values[valid]))
    return set(index[valid & (values >= top - _REACHED * span)].tolist())


def in_one_order(records: Iterable[Record]) -> list[Record]:
    """Return the records by sampling interval, length and content, however they are given."""
    return sorted(records, key=lambda r: (r.sample_time, r.n, r.sha256, r.name))


def divided(records: Sequence[Record], holdout: Sequence[Record]) -> tuple[Experiment, ...]:
    """Return the experiments of records and held-out ones; without these every record is `split`.

    The held-out ones (`judging`) come last.
    """
    if not holdout:
        return tuple(split(r) for r in records)
    return (*(whole(r) for r in records), *(judging(r) for r in holdout))
