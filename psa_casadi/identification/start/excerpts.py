"""The parts of records that show the dynamics: uniform, short, and free of long rests."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from psa_casadi.identification.start.linear_response import FloatArray, orthonormal, plays
from psa_casadi.records.noise import high_frequency_noise
from psa_casadi.records.record import Record

BoolArray = npt.NDArray[np.bool_]

#: Samples that all excerpts together may have, and that one may.
SAMPLES, MOST = 8_000, 4_000
#: Radii of the play operators that stand for the loop, over the range of the voltage.
RADII = tuple(k / 16.0 for k in range(1, 9))
#: Share of its range that a static loop must miss in a record: with a voltage that crosses its
#: range within `_FAST` samples, and with a slower one, where the shape of the loop may be missed.
_SHOWS_FAST, _SHOWS_SLOW, _FAST = 0.01, 0.03, 16.0
#: A record whose voltage takes this many times longer than that of the fastest adds no dynamics.
_SLOWER = 30.0
#: Least noise over the range, and the largest where fast motion looks like noise to its estimate.
_NOISE = (2e-3, 2e-2)
_FEWEST = 16
#: Share of the range within which a response has settled, and within which it is all but over.
_SETTLED, _OVER = 0.01, 0.05
#: Share of an excerpt that begins in motion and is given to its transient.
_LEAD = 0.2
#: A motion that begins with less than this share of its ordinary rate begins at rest.
_SLOWLY = 0.2
#: Voltages alike within this share of the range are one level.
_LEVEL = 1e-4


@dataclass(frozen=True, eq=False)
class Excerpt:
    """Uniform samples h [s] apart of one record, from (nearly) rest; all arrays (n,).

    `v` [V] and `y` [m] are deviations from the start; `valid` marks measured samples that count,
    elsewhere y is a stand-in; `sigma` [m] is the white noise, within `_NOISE`; `loop` [m] is the
    best static loop for y, 0 at the start, and `static` [m] the root mean square that it leaves.
    No time constant of a stack exceeds `longest` [s]: a hold shows when the response is over.
    """

    name: str
    h: float
    longest: float
    v: FloatArray
    y: FloatArray
    valid: BoolArray
    sigma: float
    loop: FloatArray
    static: float

    @property
    def range(self) -> float:
        """Range of the displacement [m]."""
        return float(np.ptp(self.y[self.valid]))

    @property
    def crossing(self) -> float:
        """Time in which the voltage crosses its range at its fastest [s]."""
        return self.h * float(np.ptp(self.v) / np.max(np.abs(np.diff(self.v))))


@dataclass(frozen=True, eq=False)
class _Samples:
    """Uniform samples of a record, as they stand: nan where no displacement was measured."""

    h: float
    longest: float
    v: FloatArray
    y: FloatArray

    def part(self, start: int, stop: int, every: int = 1) -> "_Samples":
        cut = slice(max(start, 0), stop, every)
        return _Samples(self.h * every, self.longest, self.v[cut], self.y[cut])


def excerpts(records: Sequence[Record]) -> list[Excerpt]:
    """Return the excerpts in which a static loop misses what is there, the clearest first."""
    found = [e for r in records for e in _of_record(r)]
    shown = [e for e in found if _shows(e)]
    shown.sort(key=lambda e: e.range / e.static)
    fastest = min((e.crossing for e in shown), default=0.0)
    kept: list[Excerpt] = []
    for e in shown:
        room = not kept or sum(k.y.size for k in kept) + e.y.size <= SAMPLES
        if room and e.crossing <= _SLOWER * fastest:
            kept.append(e)
    return kept


def _fast(e: Excerpt) -> bool:
    return e.crossing <= _FAST * e.h


def _shows(e: Excerpt) -> bool:
    """Whether a static loop misses enough of the displacement; noise excused where it is known."""
    if _fast(e):
        return e.static > _SHOWS_FAST * e.range
    return e.static**2 - e.sigma**2 > (_SHOWS_SLOW * e.range) ** 2


def _of_record(record: Record) -> list[Excerpt]:
    """Return the excerpts of one record: all of it, or its fastest part and a coarse whole."""
    if record.displacement is None or record.mask.sum() < _FEWEST or not np.ptp(record.voltage):
        return []
    whole = _without_rests(_uniform(record))
    if whole.v.size <= MOST:
        return _excerpt(record.name, whole)
    start = fastest_part(whole.v, MOST)
    found = _excerpt(f"{record.name}, fastest part", whole.part(start, start + MOST))
    coarse = whole.part(0, whole.v.size, -(-whole.v.size // MOST))
    at = np.arange(whole.v.size) * whole.h
    missed = np.interp(at, np.arange(coarse.v.size) * coarse.h, coarse.v) - whole.v
    if np.std(missed) < 0.02 * np.ptp(whole.v):
        found += _excerpt(f"{record.name}, coarse", coarse)
    return found


def _excerpt(name: str, samples: _Samples) -> list[Excerpt]:
    """Return the samples as an excerpt, or nothing where too little was measured or moved."""
    v, y = samples.v, samples.y
    valid = np.isfinite(y)
    rest = _leading_rest(v)
    lead = int(_LEAD * v.size)
    if rest == 0 and np.ptp(v[lead:]) > 0.5 * np.ptp(v):
        valid[:lead] = False
    if valid.sum() < _FEWEST or not np.ptp(v) or not np.ptp(y[valid]):
        return []
    filled = np.interp(np.arange(y.size), np.flatnonzero(np.isfinite(y)), y[np.isfinite(y)])
    moved = filled - np.mean(filled[: max(rest, 1)])
    loop, static = _static_loop(v - v[0], moved, valid)
    found = Excerpt(name, samples.h, samples.longest, v - v[0], moved, valid, 0.0, loop, static)
    noise = max(high_frequency_noise(filled[valid]), _NOISE[0] * found.range)
    return [replace(found, sigma=min(noise, _NOISE[1] * found.range) if _fast(found) else noise)]


def _static_loop(v: FloatArray, y: FloatArray, valid: BoolArray) -> tuple[FloatArray, float]:
    """Return the best static loop for y, 0 at the start, and the rms [m] that it leaves."""
    span = float(np.ptp(v))
    columns = np.column_stack([v, plays(v, [span * r for r in RADII]), np.full(v.size, span)])
    q, transform = orthonormal(columns[valid])
    weights = transform @ (q.T @ y[valid])
    fitted = columns @ weights
    return fitted - fitted[0], float(np.sqrt(np.mean((y[valid] - fitted[valid]) ** 2)))


def _uniform(record: Record) -> _Samples:
    """Return the record on uniform instants; a displacement counts within half an interval."""
    t, y = record.time, np.asarray(record.displacement, dtype=np.float64)
    steps = np.diff(t)
    if np.ptp(steps) < 0.01 * record.sample_time:
        return _Samples(record.duration / steps.size, record.duration, record.voltage, y)
    h = max(float(np.quantile(steps, 0.1)), record.duration / (20.0 * MOST))
    grid = t[0] + h * np.arange(int(record.duration / h) + 1)
    measured = t[record.mask]
    after = np.searchsorted(measured, grid).clip(1, measured.size - 1)
    distance = np.minimum(np.abs(grid - measured[after - 1]), np.abs(measured[after] - grid))
    displacement = np.interp(grid, measured, y[record.mask])
    displacement[distance > 0.5 * h] = np.nan
    return _Samples(h, record.duration, np.interp(grid, t, record.voltage), displacement)


def _without_rests(s: _Samples) -> _Samples:
    """Return the samples up to where the last response has settled, and settled ones made nan.

    A rest before the first change of voltage is cut short. Where the longest hold is more than
    twice as long as the response to within 5 %, that response limits the time constants.
    """
    y, size = s.y.copy(), float(np.nanmax(s.y) - np.nanmin(s.y))
    still = np.abs(np.diff(s.v)) <= _LEVEL * np.ptp(s.v)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still, [0]])))
    holds = [(int(a), int(b) + 1) for a, b in zip(edges[::2], edges[1::2], strict=True) if a > 0]
    over = [(last - first, _settled(s.y[first:last], _OVER * size)) for first, last in holds]
    length, response = max(over, default=(0, 0))
    longest = s.longest
    if 2 * response < length:
        longest = min((max(r for n, r in over if 2 * r < n) + 8) * s.h, longest)
    for first, last in holds:
        y[first + 2 * _settled(s.y[first:last], _SETTLED * size) + _FEWEST : last] = np.nan
    start = max(_leading_rest(s.v) - max(s.v.size // 50, 8), 0)
    whole = _Samples(s.h, longest, s.v, y)
    return whole.part(start, int(np.flatnonzero(np.isfinite(y))[-1]) + 1)


def _settled(y: FloatArray, tolerance: float) -> int:
    """Return the number of samples until a hold stays at its last level; all where that is open."""
    third = y[2 * y.size // 3 :]
    if np.isfinite(third).sum() < _FEWEST:
        return int(y.size)
    noise = high_frequency_noise(y[np.isfinite(y)])
    away = np.flatnonzero(np.abs(y - np.nanmedian(third)) > max(tolerance, 3.0 * noise))
    return int(away[-1]) + 1 if away.size else 0


def _leading_rest(v: FloatArray) -> int:
    """Return how many samples at the start have the first voltage; 0 if it was moving before.

    A single sample counts as a rest where the voltage jumps to a level or begins to move slowly.
    """
    level = _LEVEL * float(np.ptp(v))
    changed = np.flatnonzero(np.abs(v - v[0]) > level)
    rest = int(changed[0]) if changed.size else v.size
    moves = np.diff(v)
    slow = np.max(np.abs(moves[:3])) < _SLOWLY * np.sqrt(np.mean(moves**2))
    return 0 if rest == 1 and np.ptp(v[1:4]) > level and not slow else rest


def fastest_part(v: FloatArray, length: int) -> int:
    """Return the start of the part with the largest jumps of voltage from sample to sample.

    Of equal parts the last, a little before.
    """
    energy = np.concatenate([[0.0], np.cumsum(np.diff(v) ** 2)])
    inside = energy[length - 1 :] - energy[: v.size - length + 1]
    best = int(np.flatnonzero(inside >= (1.0 - 1e-9) * inside.max())[-1])
    return max(best - length // 50, 0)
