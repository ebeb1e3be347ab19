"""Parts of records: training and held-out samples, gaps, kinds of stretches, and excerpts."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from psa_casadi.common.notes import Note
from psa_casadi.common.units import BoolArray, FloatArray, IndexArray
from psa_casadi.records.drive import reversals
from psa_casadi.records.record import FEWEST_SAMPLES, Record
from psa_casadi.records.repeats import held
from psa_casadi.records.signals import Signals
from psa_casadi.records.suspects import HIDDEN

#: Turns by less than this share of the span are no reversals here; sizes of rises and falls are
#: distinguished at these shares of it, durations by this factor.
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

    A stretch lasts from one reversal of the voltage to the next; its size counts in shares of the
    `span` [V]. Held voltages within it are a separate kind.
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


def counts(records: Sequence[Record], chosen: Sequence[BoolArray], span: float) -> dict[Kind, int]:
    """Return how many of the `chosen` samples of the records belong to each kind."""
    table: dict[Kind, int] = {}
    for record, mask in zip(records, chosen, strict=True):
        kinds, which = stretches(record, span)
        for kind, count in zip(kinds, np.bincount(which[mask], minlength=len(kinds)), strict=True):
            table[kind] = table.get(kind, 0) + int(count)
    return {k: n for k, n in table.items() if n}


#: An interval is a gap from this many times the neighbouring intervals on.
_LONG = 10.0


_Record = TypeVar("_Record", Record, Signals)


def without_gaps(
    records: Iterable[_Record], inputs: Sequence[str] = ("voltage",)
) -> tuple[list[_Record], list[str]]:
    """Return the records, cut into parts where a gap hides what an input did; and what was cut.

    A part starts with an unknown state, as a record does: what the stack remembers of a gap is not
    what a straight line of the voltage would have left.
    """
    parts: list[_Record] = []
    sentences = []
    for record in records:
        at: tuple[int, ...] = gaps(record, inputs)
        if not at:
            parts.append(record)
            continue
        ends = [0, *(k + 1 for k in at), record.n]
        parts += [record.slice(a, b) for a, b in pairwise(ends)]
        places = ", ".join(
            f"{record.time[k + 1] - record.time[k]:.4g} s from {record.time[k]:.6g} s on"
            for k in at
        )
        what = f"the {inputs[0]}" if len(inputs) == 1 else "an input"
        sentences.append(
            f"{record.name}: no sample for {places}, while {what} moves: what it did there is"
            f" not known, so that the {len(at) + 1} parts count as separate records."
        )
    return parts, sentences


def gaps(record: Record | Signals, inputs: Sequence[str] = ("voltage",)) -> tuple[int, ...]:
    """Return the samples after which there is a gap that hides a motion of an input.

    It is many times as long as the intervals before and after it, and an input that went on as it
    did before, or as it does after it, would differ from its other end by more than a share of its
    range. Both parts have samples enough for a record.
    """
    step = np.diff(record.time)
    inner = np.arange(1, step.size - 1)
    around = np.maximum(step[:-2], step[2:])
    hidden = np.zeros(inner.size, dtype=np.bool_)
    for values in [c for n in inputs if (c := record.column(n)) is not None]:
        change = np.diff(values)
        bends = [
            np.abs(change[inner] - step[inner] * change[side] / step[side])
            for side in (inner - 1, inner + 1)
        ]
        hidden |= np.maximum(*bends) > HIDDEN * np.ptp(values)
    numbers: list[int] = []
    for k in inner[(step[inner] > _LONG * around) & hidden].tolist():
        begin = numbers[-1] + 1 if numbers else 0
        if k + 1 - begin >= FEWEST_SAMPLES and record.n - (k + 1) >= FEWEST_SAMPLES:
            numbers.append(k)
    return tuple(numbers)


#: Number of blocks a record is cut into, and of how many one is held out when no record is named.
BLOCKS, HELD_OUT_EVERY = 16, 4
#: Blocks that come this close to the record's highest or lowest value, over its range, reach it.
_REACHED = 2e-3
#: A part shows a kind of stretch from this share of its samples on.
_SHOWN = 0.05


@dataclass(frozen=True)
class Channel:
    """A column of the records that is fitted, and the outputs of the model that it shows.

    `outputs` are in the column's `unit`. With an `offset`, every record has one; with `factors`,
    every output has one, the same in all records, and the first factor is that of `scale`, a
    parameter of the sensor, where there is one. `level` is the noise level that weights it; the
    model is assumed right to the share `straight` of the readings (of their rms about the offsets;
    of the range where there are no factors): a smaller error is no sign of a defect.
    """

    column: str
    unit: str
    outputs: tuple[str, ...]
    straight: float = 1e-3
    scale: str | None = None
    offset: bool = True
    factors: bool = True
    level: float = 0.0


#: The first channel of a stack.
DISPLACEMENT = Channel("displacement", "m", ("measured_displacement",), straight=0.0, factors=False)


@dataclass(frozen=True, eq=False)
class Experiment:
    """A record with the samples that count for a fit (`used`) and those held out for judging it.

    A record that is held out whole has no used ones: see `judging`. `channels` are the columns that
    are fitted, the first one foremost; the same in all experiments of a fit, whether a record has
    them or not. `noise` is that of every channel over what is usual in all experiments, 1 where
    nothing else is known. `known_start`: the state at its start is the declared one; `remarks`:
    what was done to its samples.
    """

    record: Record
    used: BoolArray
    held_out: BoolArray
    channels: tuple[Channel, ...] = (DISPLACEMENT,)
    noise: tuple[float, ...] | None = None
    known_start: bool = False
    later_part: bool = False
    remarks: tuple[Note | str, ...] = ()

    @property
    def further(self) -> tuple[Channel, ...]:
        """The channels after the first."""
        return self.channels[1:]

    def with_further(self, further: Iterable[Channel]) -> "Experiment":
        """Return the experiment with these channels after the first."""
        return replace(self, channels=(self.channels[0], *further))

    @property
    def held_out_whole(self) -> bool:
        """Whether no sample of the record is fitted; the samples before determine its start."""
        return bool(self.held_out.any() and not self.used.any())

    @property
    def known(self) -> BoolArray:
        """The samples that are not held out: the used ones, or those that find the beginning."""
        return np.asarray(self.record.mask & ~self.held_out)

    @property
    def stop(self) -> int:
        """One past the last used sample: a fit need not simulate further; 0 without any."""
        return int(np.max(np.flatnonzero(self.used), initial=-1)) + 1

    def share(self, channel: int) -> float:
        """Return the noise of a channel over what is usual in all experiments."""
        return 1.0 if self.noise is None else self.noise[channel]

    def measured(self, channel: int) -> FloatArray:
        """Return a channel's readings (n,) in its unit, nan where there is none."""
        values = self.record.column(self.channels[channel].column)
        return np.full(self.record.n, np.nan) if values is None else values

    def errors(self, channel: int, predicted: FloatArray) -> FloatArray:
        """Return measured minus predicted readings of a channel (n,), over its share of noise."""
        return np.asarray((self.measured(channel) - predicted) / self.share(channel))

    def at(self, channel: int, samples: BoolArray | None = None) -> BoolArray:
        """Return which of the samples, by default the used ones, have a reading of a channel."""
        chosen = self.used if samples is None else samples
        return np.asarray(chosen & np.isfinite(self.measured(channel)))


def noise_share(experiments: Sequence[Experiment], channel: int) -> float:
    """Return the rms of a channel's `noise` over the samples that judge, else over the fitted."""
    counts = [int(c.sum()) for c in counted(experiments, channel)]
    squares = [e.share(channel) ** 2 for e in experiments]
    return float(np.sqrt(np.average(squares, weights=counts)))


def missed_rms(
    experiments: Sequence[Experiment], arrays: Sequence[FloatArray], channel: int
) -> float:
    """Return the rms of measured minus predicted of a channel, in its unit, over these samples."""
    rows = zip(experiments, arrays, counted(experiments, channel), strict=True)
    errors = np.concatenate([(e.measured(channel) - y[:, channel])[c] for e, y, c in rows])
    return float(np.sqrt(np.mean(errors**2)))


def counted(experiments: Sequence[Experiment], channel: int) -> list[BoolArray]:
    """Return the samples of a channel that judge, the fitted ones where none does."""
    judged = [e.at(channel, e.held_out) for e in experiments]
    some = any(j.any() for j in judged)
    return judged if some else [e.at(channel) for e in experiments]


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


def _held_out(record: Record, index: IndexArray) -> tuple[int, ...]:
    """Return the blocks to hold out, one of every four; `index` (n,) is the block of each sample.

    Of all choices, the one that holds the fewest extremes of voltage and rate out, among the
    samples that have a reading; of these the one with the smallest share of samples whose kind of
    stretch is not fitted, or not held out, which counts half; of these the one nearest to the last
    of each four. The first block is always fitted: it determines the record's start.
    """
    voltage = record.voltage
    rate = np.r_[0.0, np.diff(voltage) / np.diff(record.time)]
    extremes = []  # the blocks in which a signal comes up to its largest value
    for signal in (voltage, -voltage, rate, -rate) if record.mask.any() else ():
        known = signal[record.mask]
        reached = signal >= np.max(known) - _REACHED * np.ptp(known)
        extremes.append(set(index[record.mask & reached].tolist()))
    groups = [range(g, g + HELD_OUT_EVERY) for g in range(0, BLOCKS, HELD_OUT_EVERY)]
    kinds, which = stretches(record, float(np.ptp(voltage)))
    shares = np.zeros((len(kinds), BLOCKS))
    np.add.at(shares, (which[record.mask], index[record.mask]), 1.0 / max(1, record.mask.sum()))
    near = np.array([[float(k.near(other)) for other in kinds] for k in kinds])

    def unfitted(choice: tuple[int, ...]) -> int:
        return sum(blocks <= set(choice) for blocks in extremes)

    def unlike(choice: tuple[int, ...]) -> float:
        whole = np.sum(shares, axis=1)
        held = np.sum(shares[:, choice], axis=1)
        unlearnt, unjudged = near @ (whole - held) < _SHOWN * whole, near @ held < _SHOWN * whole
        return round(float(whole @ (unlearnt + 0.5 * unjudged)), 2)

    choices = (c for c in product(*groups) if 0 not in c)
    return min(choices, key=lambda c: (unfitted(c), unlike(c), -sum(c), c))


def in_one_order(records: Iterable[Record]) -> list[Record]:
    """Return the records ordered by sampling interval, length and content."""
    return sorted(records, key=lambda r: (r.sample_time, r.n, r.sha256, r.name))


def divided(records: Sequence[Record], holdout: Sequence[Record]) -> tuple[Experiment, ...]:
    """Return the experiments of records and held-out ones; without these every record is `split`.

    The held-out ones (`judging`) come last.
    """
    if not holdout:
        return tuple(split(r) for r in records)
    return (*(whole(r) for r in records), *(judging(r) for r in holdout))


#: Samples that are fitted of all records together. A fit takes some 0.1 ms and 2 kB for each, a
#: diagnosis 0.1 ms and 6 kB; with this many the intervals are a few parts in ten thousand, and what
#: the model lacks is larger.
MOST = 200_000
#: Parts that stand for one record, and the samples that it may have however many records there are.
PARTS, LEAST = 4, 20_000


def excerpts(records: Sequence[Record]) -> tuple[list[Record], list[str]]:
    """Return the records with parts in place of those that are too long, and sentences on these.

    All together have `MOST` samples at most, and every record its fair share of them, at least
    `LEAST`. The parts of a record are of equal length: its beginning, then in turn what shows the
    most kinds of stretch (rises, falls and holds, see `stretches`) and ends of the voltage's range
    that the parts so far do not, as far from these as it can be. A part starts with an
    unknown state, as a record does.
    """
    shares, left = [0] * len(records), MOST
    for done, k in enumerate(sorted(range(len(records)), key=lambda k: records[k].n)):
        shares[k] = min(records[k].n, max(LEAST, left // (len(records) - done)))
        left -= shares[k]  # what short ones leave is the others'
    result: list[Record] = []
    texts: list[str] = []
    for record, share in zip(records, shares, strict=True):
        if record.n <= share:
            result.append(record)
            continue
        length = share // PARTS
        starts = [k * length for k in _chosen(record, length)]
        result += [record.slice(a, a + length) for a in starts]
        places = ", ".join(f"{record.time[a]:.4g} s" for a in starts)
        lasts = record.time[length] - record.time[0]
        texts.append(
            f"{record.name}: of {record.n} samples {PARTS} parts of {length} are used, which begin"
            f" at {places}: they have each kind of rise, fall and hold that fits into them, and"
            f" resolve nothing slower than a part, {lasts:.3g} s; give a record with fewer samples"
            " a second for that."
        )
    return result, texts


def _chosen(record: Record, length: int) -> list[int]:
    """Return which of the parts of a length stand for a record, in the order of time."""
    v, span = record.voltage, float(np.ptp(record.voltage))
    kinds, which = stretches(record, span)
    shows = np.zeros((record.n // length, len(kinds) + 2), dtype=np.bool_)  # and the two ends
    last = len(shows) * length
    part = np.arange(last) // length
    shows[part, which[:last]] = True
    shows[part[v[:last] >= np.max(v) - _REACHED * span], -2] = True
    shows[part[v[:last] <= np.min(v) + _REACHED * span], -1] = True
    chosen = [0]
    while len(chosen) < PARTS:
        new = np.sum(shows & ~np.any(shows[chosen], axis=0), axis=1)
        away = np.min(np.abs(np.subtract.outer(np.arange(len(shows)), chosen)), axis=1)
        new[chosen] = -1
        chosen.append(int(np.lexsort((away, new))[-1]))
    return sorted(chosen)
