"""Samples that a sensor, not the stack, has made: outliers, drop-outs, stuck or saturated ones.

They are recognised from the record alone and masked; nothing is put in their place. What a stack
can do (ring after a step, follow a jump of the voltage, turn sharply) is not suspect.

Spikes: a sample of a sampled motion is nearly a fixed linear function of its neighbours and of the
inputs around it; its coefficients are fitted to the record. A spike of size a at sample m adds a to
the residual there and -a times the coefficients at its neighbours. In each group of large residuals
the spikes are added one by one until they explain it (orthogonal matching pursuit). Residuals
behind jumps of an input are compared with those behind other jumps.

Source: Pati, Rezaiifar and Krishnaprasad, "Orthogonal matching pursuit", Asilomar 1993.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import scipy

from psa_casadi.common.notes import Note, note
from psa_casadi.common.units import BoolArray, FloatArray
from psa_casadi.records.noise import (
    BLOCK,
    high_frequency_noise,
    last_place_of,
    local_scale,
    quantum_of,
    runs_of,
)
from psa_casadi.records.record import Record

#: Neighbours on each side of which a sample is a function, and instants of the inputs around it.
_REACH, _INPUTS = 4, 1
#: Rounds in which the function is fitted without what it does not explain; rows for each
#: coefficient, and standard deviations that are left out of the fit.
_ROUNDS, _ROWS, _UNUSUAL = 8, 20, 4.0
#: Times the usual move of an input that make a jump, samples after it that may belong to it, and
#: times the usual residual of a jump that a spike among them must exceed.
_JUMP, _AFTER, _OF_JUMPS = 10.0, 16, 8.0
#: What spikes may leave of the residual around them, over the largest: a kink leaves more.
_LEFT = 0.1


def spikes_in(
    y: FloatArray, inputs: FloatArray, limit: float, smallest: float, longest: int
) -> BoolArray:
    """Return which samples of an output (n,), nan where there is none, are spikes.

    `inputs` (n, nu) are known throughout. A spike has at most `longest` samples. Its residual
    exceeds `limit` standard deviations of those around it, and `smallest`, in the output's unit.
    """
    mask = np.zeros(y.size, dtype=np.bool_)
    if np.isfinite(y).sum() < _ROWS:
        return mask
    moving = inputs[:, np.ptp(inputs, axis=0) > 0.0]
    sides = [j for j in range(-_REACH, _REACH + 1) if j]
    near = [y, *(moving[:, k] for k in range(moving.shape[1]))]
    near = [(s - np.nanmean(s)) / (np.nanstd(s) or 1.0) for s in near]
    columns = [np.roll(near[0], -j) for j in sides]
    columns += [np.roll(u, -j) for u in near[1:] for j in range(-_INPUTS, _INPUTS + 1)]
    regressors = np.column_stack([*columns, np.ones(y.size)])
    good = np.isfinite(regressors).all(axis=1) & np.isfinite(y)
    good[:_REACH] = good[-_REACH:] = False
    used, unit = good, float(np.nanstd(y)) or 1.0
    moves = np.abs(np.diff(moving, axis=0, prepend=moving[:1]))
    sudden = np.any(moves > _JUMP * np.median(moves, axis=0), axis=1)
    jumps = scipy.ndimage.maximum_filter1d(
        np.asarray(sudden, dtype=np.bool_), _REACH + _AFTER + 1, origin=(_AFTER - _REACH) // 2
    )
    for _ in range(_ROUNDS):
        if used.sum() < _ROWS * regressors.shape[1]:
            return mask
        weights = np.linalg.lstsq(regressors[used], near[0][used], rcond=1e-10)[0]
        left = np.where(good, near[0] - np.where(good[:, None], regressors, 0.0) @ weights, 0.0)
        size = np.abs(left)
        usual = np.full(y.size, 1.4826 * float(np.median(size[good])))
        if (good & jumps).any():
            usual[jumps] = max(usual[0], 1.4826 * float(np.median(size[good & jumps])))
        peak = (size > _UNUSUAL * usual) & (size >= _grown(size))
        before, used = used, good & ~_grown(peak)
        if np.array_equal(before, used):
            break
    places = np.flatnonzero(used)
    scale = np.interp(np.arange(y.size), places, local_scale(size[used]))
    allowed = np.maximum(limit * scale, smallest / unit)
    if peaks := [float(np.max(size[start:stop])) for start, stop in runs_of(jumps)]:
        allowed[jumps] = np.maximum(allowed[jumps], _OF_JUMPS * np.median(peaks))
    pattern = np.ones(2 * _REACH + 1)
    pattern[[_REACH - j for j in sides]] = -weights[: len(sides)]
    for start, stop in runs_of(_grown(good & (size > allowed))):
        place = _pursued(left[start:stop], pattern, allowed[start:stop], limit, longest)
        mask[start + np.array(place, dtype=np.intp)] = True
    for start, stop in runs_of(mask):
        if stop - start > longest:
            mask[start:stop] = False
    return mask


def _grown(values: Any) -> Any:
    """Return the largest of each value (n,) and its neighbours within `_REACH`."""
    return scipy.ndimage.maximum_filter1d(values, 2 * _REACH + 1)


def _pursued(
    left: FloatArray, pattern: FloatArray, allowed: FloatArray, limit: float, longest: int
) -> list[int]:
    """Return the places of the fewest spikes that explain a residual (m,); none where none do.

    They are added one by one; else it is one spike of several samples that leaves only noise.
    """
    n = left.size
    each = np.array([np.convolve(np.eye(n)[k], pattern, mode="same") for k in range(n)]).T
    sizes = np.linalg.norm(each, axis=0)

    def tried(places: list[int], share: float) -> tuple[bool, FloatArray]:
        weights = np.linalg.lstsq(each[:, places], left, rcond=None)[0]
        rest = left - each[:, places] @ weights
        most = np.maximum(_UNUSUAL * allowed / limit, share * float(np.max(np.abs(weights))))
        large = bool(np.all(np.abs(weights) > allowed[places]))
        return large and bool(np.all(np.abs(rest) <= most)), rest

    places, rest = list[int](), left
    while len(places) <= n // _REACH:
        places.append(int(np.argmax(np.abs(each.T @ rest) / sizes)))
        is_all, rest = tried(places, _LEFT)
        if is_all:
            return places
    runs = [[*range(k, k + m)] for m in range(2, longest + 1) for k in range(n - m + 1)]
    return next((run for run in runs if tried(run, 0.0)[0]), [])


#: Signals (n,) by their names.
Columns = Mapping[str, FloatArray]

#: Samples that no spike exceeds, and standard deviations of its surroundings that make an outlier.
SPIKE, LIMIT = 3, 8.0
#: Samples before and after a run of equal ones in which the voltage may move the stack.
BEFORE, AFTER = 4, 24
#: Equal samples in a row that may be a sensor at rest, and the least motion meanwhile, over the
#: range.
EQUAL, MOTION = 8, 0.05
#: Share of fast changes of the voltage without a new reading from which on the stack is late.
LATE = 0.3
#: Runs of equal readings that chance may make where the voltage is fast, and that are none then.
CHANCE = 0.05
#: Share of readings that noise may repeat by chance, that a failing sensor repeats at most, and the
#: probability below which more of them are no chance.
BY_NOISE, RARELY, NO_CHANCE = 2e-3, 0.05, 1e-4
#: Least noise over the record's range, and least ratio of the fourth to the third differences: that
#: of white noise is 1.87, that of a motion below a fifth of the sampling rate at most 1.2.
NOISY, ROUGH = 1e-5, 1.3
#: Parts of a record's values, by size, in each of which its digits are determined.
BANDS = 4


def equal_runs(
    y: FloatArray, voltage: FloatArray, quantum: float | None
) -> tuple[BoolArray, BoolArray]:
    """Return where one value is repeated as by a stuck sensor, and where as in a drop-out."""
    span, reach = float(np.ptp(y)), float(np.ptp(voltage))
    stuck, dropped = (np.zeros(y.size, dtype=np.bool_) for _ in range(2))
    edges = np.flatnonzero(~_repeated(y)) + 1
    starts, stops = np.r_[0, edges], np.r_[edges, y.size]
    lengths = stops - starts
    usual = float(np.percentile(lengths, 95))
    slope = span / reach if reach > 0 else 0.0
    swing = slope * np.abs(np.diff(voltage, prepend=voltage[0]))
    floor = max(20.0 * (quantum or 0.0), MOTION * span)
    for start, stop in zip(starts, stops, strict=True):
        if stop - start <= SPIKE:
            continue
        before = float(y[start] - y[start - 1]) if start > 0 else 0.0
        after = float(y[stop - 1] - y[stop]) if stop < y.size else 0.0
        sign = np.sign(before) or 1.0
        into, out = sign * before, sign * after  # both positive where it is off to one side
        expected = slope * float(np.ptp(voltage[start:stop]))
        near = swing[max(0, start - AFTER) : stop + BEFORE]
        off, sudden = max(floor, 3.0 * float(np.max(near))), 0.5 * MOTION * span
        returns = abs(into - out) < 0.5 * min(into, out) + 1.5 * expected
        rests = stop - start >= max(EQUAL, 4.0 * usual) and expected > floor
        if (min(into, out) > off and returns) or (rests and abs(into) > sudden):
            dropped[start:stop] = True
        elif rests and (abs(out) > sudden or (usual <= 1.0 and quantum is None)):
            stuck[start + 1 : stop] = True
    return stuck, dropped


def repeated_while_moving(y: FloatArray, voltage: FloatArray, quantum: float | None) -> BoolArray:
    """Return where a reading is repeated, however shortly, while the voltage moves the stack.

    The motion that the voltage's change makes must stand out from the noise, and at the end of the
    run the reading must make up for at least half of it at once; and runs of that length, from the
    share of readings that are repeated, must not be expected where the voltage is fast. Where that
    is how the record answers fast changes in general, the stack is late and no sensor stuck.
    """
    mask = np.zeros(y.size, dtype=np.bool_)
    centred = voltage - np.mean(voltage)
    power = float(centred @ centred)
    slope = float(centred @ y) / power if power > 0 else 0.0
    least = LIMIT * max(high_frequency_noise(y), 0.5 * (quantum or 0.0))
    same = _repeated(y)
    fast = np.abs(slope * np.diff(voltage)) > least
    by_chance = float(np.mean(same)) ** np.arange(same.size + 1) * float(np.count_nonzero(fast))
    for start, stop in runs_of(same):
        # y[start] ... y[stop] are equal, y[stop + 1] is the first new one
        if stop + 1 >= y.size or by_chance[stop - start] > CHANCE:
            continue
        misfit = slope * (voltage[stop] - voltage[start])
        made_up = (y[stop + 1] - y[stop]) * np.sign(misfit)
        expected = abs(slope * (voltage[stop + 1] - voltage[start]))
        if abs(misfit) > least and made_up > max(least, 0.5 * expected):
            mask[start + 1 : stop + 1] = True
    late = fast.any() and float(np.mean(same[fast])) > LATE
    return np.zeros_like(mask) if late else mask


def repeated_in_noise(y: FloatArray, voltage: FloatArray, quantum: float | None) -> BoolArray:
    """Return where a reading is the last one to the last digit, which noise hardly ever makes.

    Two readings with noise of standard deviation s agree to a digit d with a chance of
    d / (2 sqrt(pi) s). However slow or late the stack is, a sensor that repeats clearly more than
    that while the voltage changes does not measure; one that repeats often is read more slowly than
    it is sampled.
    """
    mask = np.zeros(y.size, dtype=np.bool_)
    noise, same = high_frequency_noise(y), _repeated(y)
    same &= np.diff(voltage) != 0.0
    bands = np.array_split(np.unique(np.abs(y)), BANDS)
    digit = max((float(np.min(np.diff(b))) for b in bands if b.size > 1), default=0.0)
    chance = max(quantum or 0.0, digit) / (2.0 * np.sqrt(np.pi) * max(noise, 1e-300))
    if not _is_noisy(y) or not same.any():
        return mask
    unlikely = scipy.special.pdtrc(int(same.sum()) - 1, chance * same.size) < NO_CHANCE
    if chance < BY_NOISE and unlikely and np.mean(same) < RARELY:
        mask[1:] = same
    return mask


def _is_noisy(y: FloatArray) -> bool:
    """Whether a signal's fast part is noise, not the bends of a smooth motion."""
    third, fourth = (float(np.median(np.abs(np.diff(y, k)))) if y.size > k else 0.0 for k in (3, 4))
    return high_frequency_noise(y) > NOISY * float(np.ptp(y)) and fourth > ROUGH * third > 0.0


def _repeated(y: FloatArray) -> BoolArray:
    """Return which samples but the first repeat the one before, (n - 1,)."""
    return np.asarray(np.abs(np.diff(y)) <= 1e-12 * float(np.ptp(y)), dtype=np.bool_)


#: Readings at an end of the range that are few enough for a turn, and samples of a run that counts.
FEWEST, LONGEST = 8, 3
#: The motion that a run hides must exceed this share of the range, and so often the noise.
HIDDEN = 0.02
#: How many times what the voltage does a reading may move to an end and be no jump there.
REACHED = 4.0


@dataclass(frozen=True, eq=False)
class FlatEnd:
    """An end of a sensor's range that readings stay at: its `value`, and where they do, (n,)."""

    value: float
    where: BoolArray
    upper: bool


def flat_ends(y: FloatArray, voltage: FloatArray) -> tuple[FlatEnd, ...]:
    """Return the ends of a signal's range (n,) where the sensor was saturated.

    There the signal has one value, to the last digit, while the voltage moves the stack by what
    other readings show: more than a turn does within the noise. It comes there as the stack moves;
    what jumps there is a drop-out. If the digits of a signal hide its noise, it has no flat end,
    because a drive that is saturated looks the same there.
    """
    span = float(np.ptp(y))
    at = {upper: np.abs(y - (y.max() if upper else y.min())) <= 1e-12 * span for upper in (0, 1)}
    inside = ~(at[0] | at[1])
    slope = _slope(y, voltage, inside)
    noise = high_frequency_noise(y[inside]) if inside.sum() >= FEWEST else 0.0
    if noise <= last_place_of(y):  # digits that are as coarse make a drive's flat top as flat
        return ()
    least = max(HIDDEN * span, LIMIT * noise)
    ends = []
    for upper, where in at.items():
        if where.sum() < FEWEST:
            continue
        runs = runs_of(where)
        moved = slope * np.array([np.ptp(voltage[a:b]) * (b - a >= LONGEST) for a, b in runs])
        into = np.array([_jump(y, a) - REACHED * slope * _jump(voltage, a) for a, _ in runs])
        jumped = sum(b - a for (a, b), j in zip(runs, into, strict=True) if j > LIMIT * noise)
        if np.max(moved) > least and 2 * jumped < where.sum():
            ends.append(FlatEnd(float(y[where][0]), where, bool(upper)))
    return tuple(ends)


def _jump(signal: FloatArray, at: int) -> float:
    """Return the size of the step to a sample, 0 to the first one."""
    return abs(float(signal[at] - signal[at - 1])) if at > 0 else 0.0


def _slope(y: FloatArray, voltage: FloatArray, inside: BoolArray) -> float:
    """Return the size of the regression slope of the readings that are at neither end.

    Every run of them is centred by itself: between two of them the stack was at its end and has
    come back on another branch.
    """
    if inside.sum() < FEWEST:
        inside = np.ones(y.size, dtype=np.bool_)
    power = product = 0.0
    for start, stop in runs_of(inside):
        v, x = (s[start:stop] - np.mean(s[start:stop]) for s in (voltage, y))
        power += float(v @ v)
        product += float(v @ x)
    return abs(product) / power if power > 0.0 else 0.0


Kind = Literal["outlier", "drop-out", "stuck", "saturated"]

#: A sample is an outlier beyond `LIMIT` standard deviations of its surroundings, and beyond this
#: share of the record's range, however quiet the sensor.
SMALLEST = 1e-3


@dataclass(frozen=True, eq=False)
class Suspects:
    """Samples of an output that should not count: `mask` (n,) is True for them.

    `counts` holds the number of samples by kind; `quantum` the sensor's step, in the output's
    `unit`, None where it shows none. `ends` are the values at which the sensor was saturated.
    `names` are what notes call the output, the input that moves it, and what that moves.
    """

    mask: BoolArray
    counts: dict[Kind, int]
    quantum: float | None
    unit: str
    ends: tuple[FlatEnd, ...] = ()
    names: tuple[str, str, str] = ("the displacement", "the voltage", "the stack")

    def notes(self, where: str) -> tuple[Note, ...]:
        """Return one note for each kind of suspect samples in the column `where`."""
        counts = {kind: n for kind, n in self.counts.items() if n and kind != "saturated"}
        notes = [note("masked", where=where, count=n, kind=kind) for kind, n in counts.items()]
        notes += self.saturation(where)
        if self.quantum is not None:
            step = (self.quantum, self.unit)
            notes.append(note("quantised", where=where, output=self.names[0], step=step))
        return tuple(notes)

    def saturation(self, where: str) -> tuple[Note, ...]:
        """Return at which values the sensor was saturated, one note for each."""
        _, drive, moved = self.names
        return tuple(
            note(
                "flat_end", where=where, count=int(end.where.sum()), value=(end.value, self.unit),
                share=float(end.where.mean()), upper=end.upper, drive=drive, moved=moved,
            )
            for end in self.ends
        )  # fmt: skip


def suspects(record: Record) -> Suspects:
    """Return the samples of a stack's displacement that the sensor, not the stack, has made.

    A record without displacement has none. Work and memory grow with the number of samples.
    """
    unmeasured = np.full(record.n, np.nan)
    y = unmeasured if record.displacement is None else record.displacement
    inputs = {n: record.columns[n] for n in ("voltage", "load_force") if n in record.columns}
    return _suspects(y, record.voltage, inputs, record.displacement_unit)


def suspects_of(name: str, output: FloatArray, unit: str, inputs: Columns) -> Suspects:
    """Return the samples of an output (n,), nan where there is none, that its sensor has made.

    `inputs` (n,) by name; the one that the output correlates with most moves it. Outliers are the
    spikes of `spikes_in`. Equal readings are a sensor's only where its noise makes others differ;
    and where more than half of the samples would be suspect, none is.
    """
    there = np.isfinite(output)
    correlations = {n: _correlation(u[there], output[there]) for n, u in inputs.items()}
    drive = max(correlations, key=lambda n: correlations[n], default="")
    moving = inputs.get(drive, np.zeros(output.size))
    equal = bool(there.any()) and _is_noisy(output[there])
    marked = _suspects(output, moving, inputs, unit, equal=equal)
    if 2 * marked.mask.sum() > there.sum():
        marked = Suspects(np.zeros(output.size, dtype=np.bool_), {}, None, unit)
    return replace(marked, names=(name, drive, name))


def _correlation(u: FloatArray, y: FloatArray) -> float:
    """Return the size of the correlation of two signals (n,), 0 if one is constant."""
    if not u.size or not np.ptp(u) > 0.0 or not np.ptp(y) > 0.0:
        return 0.0
    return abs(float(np.corrcoef(u, y)[0, 1]))


def _suspects(
    output: FloatArray, drive: FloatArray, inputs: Columns, unit: str, *, equal: bool = True
) -> Suspects:
    """Return the outliers of an output, and where readings are `equal` as of a failing sensor."""
    mask = np.zeros(output.size, dtype=np.bool_)
    counts: dict[Kind, int] = {"outlier": 0, "drop-out": 0, "stuck": 0, "saturated": 0}
    valid = np.flatnonzero(np.isfinite(output))
    if valid.size < 2 * BLOCK or float(np.ptp(output[valid])) <= 0:
        return Suspects(mask, counts, None, unit)
    y, moving = output[valid], drive[valid]
    quantum = quantum_of(y)
    ends: tuple[FlatEnd, ...] = ()
    stuck, dropped, flat = (np.zeros(valid.size, dtype=np.bool_) for _ in range(3))
    if equal:
        stuck, dropped = equal_runs(y, moving, quantum)
        again = repeated_while_moving(y, moving, quantum) | repeated_in_noise(y, moving, quantum)
        stuck |= again & ~dropped
        ends = flat_ends(y, moving) if quantum is None else ()
        flat = np.any([flat, *(e.where for e in ends)], axis=0)
        stuck, dropped = stuck & ~flat, dropped & ~flat
    rest = valid[~(stuck | dropped | flat)]
    known = np.full(output.size, np.nan)
    known[rest] = output[rest]
    span = float(np.ptp(output[rest])) if rest.size else 0.0
    columns = np.column_stack([np.empty((output.size, 0)), *inputs.values()])
    smallest = max(SMALLEST * span, 0.5 * LIMIT * (quantum or 0.0))
    outlying = spikes_in(known, columns, LIMIT, smallest, SPIKE)[valid]
    kinds = (outlying, dropped, stuck, flat)
    for kind, flags in zip(counts, kinds, strict=True):
        counts[kind] = int(flags.sum())
        mask[valid[flags]] = True
    return Suspects(mask, counts, quantum, unit, ends)


def cleaned(record: Record, of: Suspects | None = None) -> Record:
    """Return the record with its suspect samples masked (nan); name and `sha256` are kept."""
    mask = (of or suspects(record)).mask
    if record.displacement is None or not mask.any():
        return record
    return replace(record, displacement=np.where(mask, np.nan, record.displacement))
