"""Where the same voltage is played twice or more, and where it is held."""

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from psa_casadi.records.noise import runs_of
from psa_casadi.records.record import Record
from psa_casadi.units import FloatArray

BoolArray = NDArray[np.bool_]

#: Voltages are the same to within this share of their range, as the rms of so many neighbours.
SAME, NEIGHBOURS = 1e-3, 9
#: Windows of the voltage that are looked for elsewhere; repeats of each; distances that are used,
#: and of each the longest runs.
ANCHORS, NEAREST, DISTANCES, RUNS = 12, 8, 4, 64
#: A repeat moves over this share of the voltage's range; so many samples are the fewest to use.
MOVES, FEWEST = 0.1, 50
#: A hold lasts as long as the record's mean rate would need for this share of the range.
LASTS, SHORTEST_HOLD = 0.05, 32
#: Samples of one run that are enough.
ENOUGH = 200_000


@dataclass(frozen=True, eq=False)
class Repetition:
    """Samples start <= k < stop whose voltage returns `lag` samples later, the lead included.

    From `settled` on, hysteresis has the same history in both.
    """

    lag: int
    start: int
    settled: int
    stop: int


def held(record: Record) -> list[tuple[int, int]]:
    """Return start and stop of every span in which the voltage stays within 1e-3 of its range.

    A slow ramp is no hold: one lasts as long as the mean rate would need for 5 % of the range.
    """
    span = float(np.ptp(record.voltage))
    limit = 2.0 * SAME * span
    edges = [0]
    low = high = float(record.voltage[0])
    for k, v in enumerate(record.voltage.tolist()):
        if v < low:
            low = v
        elif v > high:
            high = v
        if high - low > limit:
            edges.append(k)
            low = high = v
    levels = record.voltage[edges]
    rate = float(np.sum(np.abs(np.diff(levels)))) / max(record.duration, 1e-300)
    spans = zip(edges, [*edges[1:], record.n], strict=True)
    return [
        (a, b)
        for a, b in spans
        if b - a >= SHORTEST_HOLD and (record.time[b - 1] - record.time[a]) * rate >= LASTS * span
    ]


def repetitions(record: Record) -> list[Repetition]:
    """Return where the voltage (and the load) is repeated, for the few best distances.

    The lead of each, until the voltage has been at both its extremes, and the first period of a
    periodic voltage, make the history the same and lie before `settled`.
    """
    if record.n < 2 * FEWEST or not np.ptp(record.voltage) > 0:
        return []
    rows = {lag: _runs(record, lag) for lag in _candidates(record.voltage)}
    sizes = {lag: sum(r.stop - r.settled for r in found) for lag, found in rows.items()}
    best = max(sizes.values(), default=0)
    good = sorted(lag for lag, size in sizes.items() if size > 0 and size >= 0.5 * best)
    return [r for lag in good[:DISTANCES] for r in rows[lag]]


def _candidates(voltage: FloatArray) -> list[int]:
    """Return the distances at which windows of the voltage are found again.

    The mean square difference of a window and every place, by the fast Fourier transform.
    """
    n, span = voltage.size, float(np.ptp(voltage))
    v = voltage - np.mean(voltage)
    width = int(np.clip(n // 64, 24, 4096))
    size = scipy.fft.next_fast_len(n + width, real=True)
    spectrum = scipy.fft.rfft(v, size)
    power = _sums(v**2, width)
    lags: list[int] = []
    for a in np.linspace(0, n - width, ANCHORS + 2).astype(int)[:-1].tolist():
        window = v[a : a + width]
        if float(np.ptp(window)) < 0.02 * span:
            continue
        crossed = spectrum * np.conj(scipy.fft.rfft(window, size))
        product = scipy.fft.irfft(crossed, size)[: n - width + 1]
        apart = (power + float(window @ window) - 2.0 * product)[a:] / width
        away = np.flatnonzero(apart > (0.02 * span) ** 2)
        if not away.size:
            continue
        near = np.flatnonzero(apart[away[0] :] <= (SAME * span) ** 2) + away[0]
        groups = np.split(near, np.flatnonzero(np.diff(near) > 1) + 1) if near.size else []
        lags += [int(g[np.argmin(apart[g])]) for g in groups[:NEAREST]]
    kept: list[int] = []
    for lag in sorted(set(lags), key=lambda k: (-lags.count(k), k)):
        if all(abs(lag - other) > 2 for other in kept):
            kept.append(lag)
    return kept[:NEAREST]


def _sums(values: FloatArray, width: int) -> FloatArray:
    """Return the sums of `width` neighbours, shape (n - width + 1,)."""
    total = np.r_[0.0, np.cumsum(values)]
    sums: FloatArray = total[width:] - total[:-width]
    return sums


def _runs(record: Record, lag: int) -> list[Repetition]:
    """Return the usable repetitions at one distance."""
    same = _same(record.voltage, lag)
    if record.load_force is not None:
        same &= _same(record.load_force, lag)
    later = record.time[lag:] - record.time[:-lag]
    same &= np.abs(later - np.median(later)) <= 0.25 * record.sample_time
    starts, stops = runs_of(same)
    longest = np.sort(np.argsort(starts - stops, kind="stable")[:RUNS])
    found = []
    for start, stop in zip(starts[longest].tolist(), stops[longest].tolist(), strict=True):
        if stop - start < FEWEST:
            continue
        v = record.voltage[start:stop]
        margin = 0.05 * float(np.ptp(v))
        both = max(int(np.argmax(v >= v.max() - margin)), int(np.argmax(v <= v.min() + margin)))
        lead = max(both, (stop - start) // 4, min(lag, (stop - start) // 2))
        settled = start + lead
        moved = float(np.ptp(record.voltage[settled:stop]))
        if stop - settled >= FEWEST and moved >= MOVES * float(np.ptp(record.voltage)):
            found.append(Repetition(lag, start, settled, min(stop, settled + ENOUGH)))
    return found


def _same(signal: FloatArray, lag: int) -> BoolArray:
    """Return where a signal is what it is `lag` samples later, shape (n - lag,)."""
    square = np.pad((signal[lag:] - signal[:-lag]) ** 2, NEIGHBOURS // 2, mode="edge")
    limit = NEIGHBOURS * (SAME * float(np.ptp(signal))) ** 2
    # rounding of the running sum must not break what is exactly the same
    same: BoolArray = _sums(square, NEIGHBOURS) <= limit + 1e-12 * float(np.sum(square))
    return same
