"""Voltage and displacement sampled by two clocks: detected from a record alone, and undone.

Two devices that sample with different clocks, one of which renews its value every P seconds,
differ by a delay that grows or falls evenly by P while the clocks pass each other, and jumps back:

    y(t) = x(t - d(t)),    d(t) = P (saw(t) - 1/2),    y = x - d x' to first order.

P is at most the record's sampling interval. x and x' come from a fit without any model: functions
linear in their weights, of the voltage, its plays and its relaxations. What it leaves, over x', is
the delay. Only the saw tooth is undone, about its mean: a delay that is constant or drifts may be
the stack's or the sensor's, and stays. Source: the beat of two free-running quartz clocks, which
differ by 10 to 100 parts in a million.

A saw tooth in delays over time: the beat of two clocks, separated from all that is smooth.

    d(t) = c_0 + c_1 t + height ((phase + beats t / T) mod 1)

in local delays d [s], each with a weight, over a record of T seconds.
"""

from dataclasses import dataclass, replace
from math import ceil, floor

import numpy as np

from psa_casadi.common.notes import Note, note
from psa_casadi.common.units import BoolArray, FloatArray
from psa_casadi.identification.start.linear_response import first_order, orthonormal, plays
from psa_casadi.records.record import Record

#: Beats that a record may hold; phases that are tried, and how much finer than 1/T the rates.
FEWEST, MOST = 2.0, 24.0
_PHASES, _FINER = 32, 8
#: Steps on either side in which a best one is refined, and the share of its grid's step each time.
_REFINED, _NEARER = 8, (1.0, 0.125)
#: What a saw tooth must remove of the squares over the scatter that is left, and how much more
#: than the first harmonics of its period do, this many of them, which are free in six weights.
_CLEAR, _SHARPER, _HARMONICS = 150.0, 15.0, 3
#: Its height in either half of the record must be this far from 0, in its standard deviation, and
#: this close to that of the whole; a jump within the record the same.
_HALF, _ALIKE = 6.0, 0.35
_JUMP, _JUMPS = 3.0, 2
#: Intervals within half a beat of a jump that show it.
_BESIDE = 8


@dataclass(frozen=True)
class Beat:
    """A saw tooth: beats in the record, phase at its start [beats], height [s] with its sign."""

    beats: float
    phase: float
    height: float

    def saw(self, along: FloatArray) -> FloatArray:
        """Return the saw tooth, 0 to 1, at times along the record, 0 to 1."""
        values: FloatArray = (self.phase + self.beats * along) % 1.0
        return values


@dataclass(frozen=True, eq=False)
class Delays:
    """Local delays (k,) [s] at times (k,) along a record, 0 to 1, with weights (k,) [1/s^2]."""

    along: FloatArray
    delay: FloatArray
    weight: FloatArray

    def best(self, most: float) -> Beat | None:
        """Return the saw tooth that removes most of the squares, of `FEWEST` to `most` beats."""
        first, last = ceil(FEWEST * _FINER), floor(min(most, MOST) * _FINER)
        if last < first:
            return None
        beats = np.arange(first, last + 1) / _FINER
        return self.refined(self._scanned(beats, np.arange(_PHASES) / _PHASES))

    def refined(self, beat: Beat) -> Beat:
        """Return the best saw tooth next to one."""
        steps = np.arange(-_REFINED, _REFINED + 1) / _REFINED
        for part in _NEARER:
            beat = self._scanned(
                beat.beats + part * steps / _FINER, beat.phase + part * steps / _PHASES
            )
        return beat

    def shows(self, beat: Beat) -> bool:
        """Whether these delays show that saw tooth beyond doubt.

        By all of

        * what it removes: `_CLEAR` times the scatter that is left, which no noise reaches;
        * its jumps: three free harmonics of its period leave more than it does;
        * both halves of the record, and every jump that has room on both sides, two at least: there
          a straight line goes on behind the jump, which is counted positive downwards.
        """
        along, one = self.along, np.ones(self.along.size)
        line, saw = np.column_stack([one, along]), beat.saw(along)
        _, _, left = self._fitted(np.column_stack([saw, line]))
        scatter = left / max(along.size - 5, 1)
        turns = 2.0 * np.pi * beat.beats * np.outer(along, np.arange(1, _HARMONICS + 1))
        _, _, smooth = self._fitted(np.hstack([np.cos(turns), np.sin(turns), line]))
        removed = self._fitted(line)[2] - left
        if removed < _CLEAR * scatter or smooth - left < _SHARPER * scatter:
            return False
        similar = []
        for half in (along < 0.5, along >= 0.5):
            height, variance, left = self._fitted(np.column_stack([saw, one]), half)
            deviation = (left / max(half.sum() - 2, 1) * variance) ** 0.5
            similar.append(self._alike(height, deviation, beat, _HALF))
        ends = np.arange(ceil(beat.phase), floor(beat.phase + beat.beats) + 1)
        jumps = 0
        for at in (ends - beat.phase) / beat.beats:
            near = np.abs(along - at) * beat.beats < 0.5
            room = 0.25 / beat.beats < at < 1.0 - 0.25 / beat.beats
            if not room or near.sum() < _BESIDE:
                continue
            columns = np.column_stack([along < at, one, along - at])
            height, variance, left = self._fitted(columns, near)
            deviation = (max(scatter, left / (near.sum() - 3)) * variance) ** 0.5
            similar.append(self._alike(height, deviation, beat, _JUMP))
            jumps += 1
        return jumps >= _JUMPS and all(similar)

    def _scanned(self, beats: FloatArray, phases: FloatArray) -> Beat:
        root, along = np.sqrt(self.weight), self.along
        line = np.linalg.qr(np.column_stack([root, root * along]))[0]
        wanted = root * self.delay
        wanted -= line @ (line.T @ wanted)
        best = (-1.0, Beat(1.0, 0.0, 0.0))
        for rate in beats.tolist():
            saws = root[:, None] * ((phases + rate * along[:, None]) % 1.0)
            saws -= line @ (line.T @ saws)
            power = np.maximum(np.sum(saws**2, axis=0), 1e-300)
            projected = saws.T @ wanted
            k = int(np.argmax(projected**2 / power))
            removed = float(projected[k] ** 2 / power[k])
            if removed > best[0]:
                best = removed, Beat(rate, float(phases[k]) % 1.0, float(projected[k] / power[k]))
        return best[1]

    def _fitted(
        self, columns: FloatArray, part: slice | BoolArray = slice(None)
    ) -> tuple[float, float, float]:
        """Return the first column's weight, its variance per scatter, and the squares left."""
        root = np.sqrt(self.weight[part])
        q, r = np.linalg.qr(root[:, None] * columns[part])
        wanted = root * self.delay[part]
        inverse = np.linalg.pinv(r)
        left = wanted - q @ (q.T @ wanted)
        return float(inverse[0] @ q.T @ wanted), float(inverse[0] @ inverse[0]), float(left @ left)

    @staticmethod
    def _alike(height: float, deviation: float, beat: Beat, least: float) -> bool:
        near = abs(height / beat.height - 1.0) < _ALIKE
        return near and abs(height) > least * max(deviation, 1e-300)


#: Intervals whose delays are compared, readings that each has at least, the most of a record.
_INTERVALS, _EACH, _LONGEST = 256, 4, 50_000
#: Thresholds of the plays, with their powers; relaxations over the record's decades.
_PLAYS, _POWERS, _RELAXATIONS = 13, 3, 12
#: Reversals that a beat must hold, else it may be a form of the loops.
_REVERSALS = 8
#: Largest weight of an interval over the median one.
_HEAVIEST = 4.0
#: Rounds of fit and saw tooth in turn.
_ROUNDS = 4
#: Largest relative difference of time steps of one clock, with its rounding.
_EVEN = 1e-2


@dataclass(frozen=True, eq=False)
class TwoClocks:
    """What two clocks did to a record: `period` [s] and `height` [s] of the delay's saw tooth.

    `falling`: the delay falls evenly and jumps up; `moved` (n,) [m] is what each reading
    was off by about the mean delay, nan where there is none.
    """

    period: float
    height: float
    falling: bool
    moved: FloatArray

    def undone(self, record: Record) -> Record:
        """Return the record with its readings where one clock would have taken them.

        It is another record: it has no `source`, and another `sha256`.
        """
        if record.displacement is None:
            return record
        there = record.displacement - self.moved
        return replace(record, displacement=there, sha256="", source="")

    def sentence(self, record: Record) -> str:
        """Return the beat of the record in words."""
        return str(self.note(record))

    def note(self, record: Record, code: str = "two_clocks") -> Note:
        """Return the beat of the record as a note."""
        scale, unit = (1e9, "nm") if record.displacement_unit == "m" else (1.0, "counts")
        off = scale * float(np.sqrt(np.nanmean(self.moved**2)))
        way = "falls" if self.falling else "grows"
        return note(
            code, record=record.name, way=way, height=1e3 * self.height, period=self.period,
            off=off, unit=unit,
        )  # fmt: skip


def on_one_clock(record: Record) -> tuple[Record, tuple[Note, ...]]:
    """Return the record with its readings on one clock, and a note where they were on two.

    Name, `source` and `sha256` are kept: the correction repeats from the file.
    """
    result = two_clocks(record)
    if result is None:
        return record, ()
    undone = replace(result.undone(record), source=record.source, sha256=record.sha256)
    return undone, (result.note(record, "clocks_undone"),)


def two_clocks(record: Record) -> TwoClocks | None:
    """Return the saw tooth in the delay between the columns, None where none is beyond doubt.

        clocks = psa.two_clocks(record)
        if clocks is not None:
            record = clocks.undone(record)

    It must show in both halves of the record and at two jumps at least, and must be no higher than
    one sampling interval. Records with uneven time steps, or with a beat that holds fewer than
    eight reversals of the voltage, are not judged.
    """
    y, valid = record.displacement, record.mask
    most = np.count_nonzero(np.diff(np.sign(np.diff(record.voltage)[np.diff(record.voltage) != 0])))
    judged = (
        _INTERVALS * _EACH <= np.count_nonzero(valid) <= record.n <= _LONGEST
        and np.ptp(np.diff(record.time)) <= _EVEN * record.sample_time
    )
    if y is None or not judged or most / _REVERSALS < FEWEST:
        return None
    along = (record.time - record.time[0]) / record.duration
    columns = np.column_stack(_functions(record))
    basis, transform = orthonormal(columns[valid])
    functions = columns @ transform

    def rate_and_left(readings: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the rate [m/s] of a smooth fit to readings (n,) [m], and what it leaves [m]."""
        smooth = functions @ (basis.T @ readings[valid])
        rate = np.gradient(smooth, record.time).astype(np.float64)
        return rate, np.where(valid, readings - smooth, 0.0)

    rate, left = rate_and_left(y)
    intervals, _ = _delays(along, rate, left, valid)
    beat = intervals.best(most / _REVERSALS) if intervals else None
    if intervals is None or beat is None or not intervals.shows(beat):
        return None
    for _ in range(_ROUNDS):
        moved = -beat.height * (beat.saw(along) - 0.5) * rate
        rate, left = rate_and_left(y - moved)
        intervals, single = _delays(along, rate, np.where(valid, left + moved, 0.0), valid)
        beat = single.refined(beat)
    if intervals is None or not intervals.shows(beat) or abs(beat.height) > record.sample_time:
        return None
    moved = np.where(valid, -beat.height * (beat.saw(along) - 0.5) * rate, np.nan)
    return TwoClocks(record.duration / beat.beats, abs(beat.height), beat.height < 0.0, moved)


def _delays(
    along: FloatArray, rate: FloatArray, left: FloatArray, valid: BoolArray
) -> tuple[Delays | None, Delays]:
    """Return the delays of intervals, and those of single readings, weighted as their intervals.

    From rates (n,) [m/s] and what a smooth fit leaves (n,) [m]. An interval counts by what scatters
    in it; None where the stack hardly ever moves.
    """
    place = np.minimum((_INTERVALS * along).astype(np.int64), _INTERVALS - 1)
    power, count, pull = (
        np.bincount(place, values, _INTERVALS).astype(np.float64)
        for values in (rate**2 * valid, valid.astype(float), -left * rate)
    )
    delay = pull / np.maximum(power, 1e-300)
    scattered = (left + delay[place] * rate) ** 2 * valid
    variance = np.bincount(place, scattered, _INTERVALS) / np.maximum(count - 1.0, 1.0)
    known = (count > 1.0) & (power > 0.0)
    usual = float(np.median(variance[known])) if known.any() else 0.0
    weight = np.where(known, power / np.maximum(variance, max(usual, 1e-300)), 0.0)
    most = _HEAVIEST * float(np.median(weight[known])) if known.any() else 0.0
    weight = np.minimum(weight, most)
    on = weight > 1e-3 * np.mean(weight)
    middle = (np.arange(_INTERVALS) + 0.5) / _INTERVALS
    scale = (weight / np.maximum(power, 1e-300))[place]
    moving = valid & (rate != 0.0) & (scale > 0.0)
    single = -left[moving] / rate[moving], (rate**2 * scale)[moving]
    return (
        Delays(middle[on], delay[on], weight[on]) if 2 * on.sum() >= _INTERVALS else None,
        Delays(along[moving], *single),
    )


def _functions(record: Record) -> list[FloatArray]:
    """Return columns (n, ...) that make any smooth answer of a stack: what no clock's beat is."""
    n, span = record.n, float(np.ptp(record.voltage))
    v = 2.0 * (record.voltage - np.mean(record.voltage)) / max(span, 1e-300)
    along = 2.0 * (record.time - record.time[0]) / record.duration - 1.0
    h = record.duration / (n - 1)
    rate = np.gradient(v)
    rate /= max(float(np.std(rate)), 1e-300)
    play = plays(v, np.arange(1, _PLAYS + 1) / (_PLAYS + 1.0))
    taus = np.geomspace(2.0 * h, record.duration, _RELAXATIONS)
    return [
        *(along**k for k in range(4)),
        *(v**k for k in range(1, 6)),
        *(rate, rate * v, rate * along),
        *(play**k for k in range(1, _POWERS + 1)),
        *(first_order(tau, v - v[0], h) for tau in taus),
        *(np.exp(-(along + 1.0) * record.duration / (2.0 * tau)) for tau in taus[4:]),
    ]
