"""The noise of a record without any model: from voltages played twice, and from held voltages."""

from dataclasses import dataclass, replace

import numpy as np
import scipy

from psa_casadi.common.units import BoolArray, FloatArray
from psa_casadi.records.noise import lag_products, runs_of
from psa_casadi.records.record import Record

#: Voltages are the same to within this share of their range, as the rms of this many neighbours.
SAME, NEIGHBOURS = 1e-3, 9
#: Windows of the voltage that are looked for elsewhere; repeats of each; distances that are used,
#: and of each the longest runs.
ANCHORS, NEAREST, DISTANCES, RUNS = 12, 8, 4, 64
#: A repeat moves over this share of the voltage's range; the fewest samples to use.
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
    sizes = {lag: sum(r.stop - r.settled for r in runs) for lag, runs in rows.items()}
    best = max(sizes.values(), default=0)
    good = sorted(lag for lag, size in sizes.items() if size > 0 and size >= 0.5 * best)
    return [r for lag in good[:DISTANCES] for r in rows[lag]]


def _candidates(voltage: FloatArray) -> list[int]:
    """Return the distances at which windows of the voltage occur again.

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
    return np.asarray(total[width:] - total[:-width])


def _runs(record: Record, lag: int) -> list[Repetition]:
    """Return the usable repetitions at one distance."""
    same = _same(record.voltage, lag)
    if record.load_force is not None:
        same &= _same(record.load_force, lag)
    later = record.time[lag:] - record.time[:-lag]
    same &= np.abs(later - np.median(later)) <= 0.25 * record.sample_time
    longest = sorted(runs_of(same), key=lambda run: run[0] - run[1])[:RUNS]
    runs = []
    for start, stop in sorted(longest):
        if stop - start < FEWEST:
            continue
        v = record.voltage[start:stop]
        margin = 0.05 * float(np.ptp(v))
        both = max(int(np.argmax(v >= v.max() - margin)), int(np.argmax(v <= v.min() + margin)))
        lead = max(both, (stop - start) // 4, min(lag, (stop - start) // 2))
        settled = start + lead
        moved = float(np.ptp(record.voltage[settled:stop]))
        if stop - settled >= FEWEST and moved >= MOVES * float(np.ptp(record.voltage)):
            runs.append(Repetition(lag, start, settled, min(stop, settled + ENOUGH)))
    return runs


def _same(signal: FloatArray, lag: int) -> BoolArray:
    """Return where a signal is what it is `lag` samples later, shape (n - lag,)."""
    square = np.pad((signal[lag:] - signal[:-lag]) ** 2, NEIGHBOURS // 2, mode="edge")
    limit = NEIGHBOURS * (SAME * float(np.ptp(signal))) ** 2
    # rounding of the running sum must not break what is exactly the same
    return np.asarray(_sums(square, NEIGHBOURS) <= limit + 1e-12 * float(np.sum(square)))


#: Intervals of the line that follows a slow drift.
DRIFT_INTERVALS = 32
_LAGS, _ORDER = 256, 8
#: The first half of a hold rings if its power is this many times that of the second: white noise
#: of 16 samples in each reaches it in 1 of 11 halves, of 64 in 1 of 300.
_RINGS = 2.0


@dataclass(frozen=True, eq=False)
class MeasuredNoise:
    """Noise of a displacement: standard deviation `level` [m, or counts], colour, and its base.

    `autocovariance` (lags,) [m^2] starts at lag 0. `autoregression` (p,) holds a_1 ... a_p of
    e_k = a_1 e_(k-1) + ... + w_k by Yule and Walker, p chosen by Schwarz' criterion, empty if
    white. `samples` is the number of samples it rests on: of repeats `distances` [s] apart, or of
    `holds` held voltages.
    """

    level: float
    autocovariance: FloatArray
    autoregression: FloatArray
    samples: int
    distances: tuple[float, ...] = ()
    holds: int = 0


def repeats(record: Record) -> MeasuredNoise | None:
    """Return the noise that differs between two plays of the same voltage, None without any.

    With y = s + e, s repeated: y(t + T) - y(t) has the autocovariance 2 c(k) for noise that forgets
    within T. A slow drift (a line of at most 32 intervals) and what follows from the small
    difference of the two voltages are removed. Several distances T are averaged, so that a tone
    counts with about its power. Missing samples are left out.
    """
    if record.displacement is None:
        return None
    plays = repetitions(record)
    if not plays:
        return None
    pieces = []
    for r in plays:
        first, second = slice(r.settled, r.stop), slice(r.settled + r.lag, r.stop + r.lag)
        change = record.displacement[second] - record.displacement[first]
        apart = record.voltage[second] - record.voltage[first]
        if np.count_nonzero(np.isfinite(change)) >= FEWEST:
            pieces.append(_without_drift(change, apart, r.lag))
    apart_s = {r.lag: float(record.time[r.start + r.lag] - record.time[r.start]) for r in plays}
    noise = _pooled(pieces, 0.5, len(apart_s))
    return None if noise is None else replace(noise, distances=tuple(apart_s.values()))


def holds(record: Record) -> MeasuredNoise | None:
    """Return the noise around a smooth creep a + b t + c t^2 + d ln t while the voltage is held.

    The first quarter of every hold is left to transients, and more while it still rings: as long
    as its first half holds twice the power of its second. None where holds are too short.
    """
    if record.displacement is None:
        return None
    pieces = []
    for start, stop in held(record):
        first = start + (stop - start) // 4
        part = slice(first, min(stop, first + ENOUGH))
        t, y = record.time[part] - record.time[start], record.displacement[part]
        while (d := _without_creep(t, y)) is not None:
            early, late = np.array_split(d**2, 2)
            there = np.isfinite(early).any() and np.isfinite(late).any()
            if not there or np.nanmean(early) <= _RINGS * np.nanmean(late):
                pieces.append((d, 4))
                break
            t, y = t[d.size // 2 :], y[d.size // 2 :]
    noise = _pooled(pieces, 1.0, 1)
    return None if noise is None else replace(noise, holds=len(pieces))


def _without_creep(t: FloatArray, y: FloatArray) -> FloatArray | None:
    """Return a hold (n,) without its smooth creep, None if too few of its samples are there."""
    there = np.isfinite(y)
    if np.count_nonzero(there) < SHORTEST_HOLD // 2:
        return None
    place = t / t[-1]
    x = np.column_stack([np.ones_like(t), place, place**2, np.log(place)])
    return np.asarray(y - x @ np.linalg.lstsq(x[there], y[there])[0])


def _without_drift(change: FloatArray, apart: FloatArray, lag: int) -> tuple[FloatArray, int]:
    """Return a difference of repeats without slow drift, and the number of coefficients removed.

    `apart` is the difference of the voltages; knots are a distance `lag` apart at least.
    """
    n = change.size
    intervals = int(np.clip(n // lag, 1, DRIFT_INTERVALS))
    place = np.linspace(0.0, intervals, n)
    cell = np.minimum(place.astype(np.int64), intervals - 1)
    share = place - cell
    scale = float(np.max(np.abs(apart)))
    third = apart / scale if scale > 0 else apart
    values = np.column_stack([1.0 - share, share, third]).ravel()
    columns = np.column_stack([cell, cell + 1, np.full(n, intervals + 1)]).ravel()
    x = scipy.sparse.csr_array(
        (values, columns, np.arange(0, 3 * n + 1, 3)), shape=(n, intervals + 2)
    )
    there = np.isfinite(change)
    used = x if there.all() else x[np.flatnonzero(there)]
    normal = (used.T @ used).toarray()
    coefficients = np.linalg.lstsq(normal, used.T @ change[there])[0]
    return change - x @ coefficients, intervals + 1 + (scale > 0)


def _pooled(pieces: list[tuple[FloatArray, int]], share: float, uses: int) -> MeasuredNoise | None:
    """Return the noise of remainders.

    c(k) = share * mean(d_i d_(i+k)) over all pieces, enlarged for the coefficients removed. The
    pieces use every sample `uses` times.
    """
    used = sum(int(np.count_nonzero(np.isfinite(d))) for d, _ in pieces)
    if used < FEWEST:
        return None
    lags = int(np.clip(max(d.size for d, _ in pieces) // 8, 1, _LAGS))
    products, pairs = np.zeros(lags), np.zeros(lags)
    for d, _ in pieces:
        there = np.isfinite(d)
        products += lag_products(np.where(there, d, 0.0), lags)
        pairs += lag_products(there.astype(np.float64), lags)
    lags = int(np.argmin(pairs >= 0.25 * FEWEST)) or lags
    covariance = share * products[:lags] / pairs[:lags]
    if not covariance[0] > 0:
        return MeasuredNoise(0.0, covariance, np.zeros(0), used // uses)
    r = float(np.clip(covariance[min(1, lags - 1)] / covariance[0], 0.0, 0.95)) if lags > 1 else 0.0
    lost = sum(p for _, p in pieces) * (1.0 + r) / (1.0 - r)
    covariance *= used / max(used - lost, 0.5 * used)
    samples = used // uses
    colour = autoregression(covariance, samples)
    return MeasuredNoise(float(np.sqrt(covariance[0])), covariance, colour, samples)


def autoregression_of(signal: FloatArray) -> FloatArray:
    """Return the autoregression (p,) of a signal (n,), of at most eighth order."""
    covariance = lag_products(signal - np.mean(signal), _ORDER + 1) / signal.size
    return autoregression(covariance, signal.size) if covariance[0] > 0 else np.zeros(0)


def autoregression(covariance: FloatArray, samples: int) -> FloatArray:
    """Return the coefficients of the order that Schwarz' criterion chooses (Levinson, Durbin)."""
    a, best = np.zeros(0), np.zeros(0)
    variance = float(covariance[0])
    least = samples * float(np.log(variance))
    for p in range(1, min(_ORDER, covariance.size - 1) + 1):
        k = float(covariance[p] - a @ covariance[p - 1 : 0 : -1]) / variance
        if not abs(k) < 1:
            break
        a = np.r_[a - k * a[::-1], k]
        variance *= 1.0 - k**2
        criterion = samples * float(np.log(variance)) + p * float(np.log(samples))
        if criterion < least:
            least, best = criterion, a
    return best
