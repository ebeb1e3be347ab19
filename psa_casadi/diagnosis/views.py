"""A residual against one coordinate: time, voltage, rate, history, drive."""

from dataclasses import dataclass, replace

import numpy as np
import scipy

from psa_casadi.common.units import FloatArray, IndexArray
from psa_casadi.records.drive import reversals
from psa_casadi.records.noise import correlation_inflation, fast_noise
from psa_casadi.records.record import Record
from psa_casadi.records.repeats import held

#: Most bins of a view, bins of a decade on a logarithmic axis, fewest samples of a bin.
BINS, PER_DECADE, FEWEST = 24, 5, 8
#: Blocks that are fitted and judged in turn: for what changes slowly, and for the drive's state.
FINE, COARSE = 128, 32
#: Samples that quantiles are taken from.
_DRAWN = 20_000
#: Number of standard errors beyond which a bin's mean is mentioned.
_CLEAR = 3.0


@dataclass(frozen=True, eq=False)
class View:
    """Residual against one coordinate; arrays (bins,), `x` in the unit `x_unit`.

    `mean` is the mean residual [m, or counts] of a bin and `spread` its standard error, correlation
    included. `share` is what the view explains of the residual's power above the noise, judged on
    blocks of samples that the means were not taken from; 0 unless `significant`.
    """

    name: str
    x_unit: str
    x: FloatArray
    mean: FloatArray
    spread: FloatArray
    share: float = 0.0
    significant: bool = False

    @property
    def extremes(self) -> tuple[int, ...]:
        """The bins of the largest and least mean that stand clear of errors, the larger first."""
        clear = np.flatnonzero(np.abs(self.mean) > _CLEAR * self.spread)
        if not clear.size:
            return ()
        ends = {int(clear[f(self.mean[clear])]) for f in (np.argmax, np.argmin)}
        return tuple(sorted(ends, key=lambda k: -abs(self.mean[k])))


@dataclass(frozen=True, eq=False)
class Ground:
    """What all views share: `index` (m,) of the samples that count of the record's n, and there.

    `residual` (m,) is without its mean, `excess` [m^2] its power above the noise, at least a tenth
    of all.
    """

    n: int
    index: IndexArray
    residual: FloatArray
    excess: float


@dataclass(frozen=True, eq=False)
class Axis:
    """A coordinate of the samples `x` (n,), nan where it has no value, in the unit `x_unit`.

    `sign` (n,) is multiplied to the residual, 0 where it does not count.
    """

    name: str
    x_unit: str
    x: FloatArray
    log: bool = False
    blocks: int = COARSE
    sign: FloatArray | None = None


def ground_of(residual: FloatArray, level: float) -> Ground:
    """Return the samples of a residual (n,) that count; `level` [m] is that of the noise."""
    index = np.flatnonzero(np.isfinite(residual))
    values = residual[index] - np.mean(residual[index]) if index.size else residual[index]
    power = float(np.mean(values**2)) if index.size else 0.0
    return Ground(residual.size, index, values, max(power - level**2, 0.1 * power))


def view(ground: Ground, axis: Axis) -> View:
    """Return the view of a residual along one axis, empty where there are too few samples.

    Work grows with the number of samples.
    """
    none = np.zeros(0)
    nothing = View(axis.name, axis.x_unit, none, none, none)
    x, r = axis.x[ground.index], ground.residual
    there = np.isfinite(x)
    if axis.sign is not None:
        r = r * axis.sign[ground.index]
        there &= axis.sign[ground.index] != 0
    if np.count_nonzero(there) < 8 * FEWEST:
        return nothing
    x, r, where = x[there], r[there], ground.index[there]
    x = np.log10(x) if axis.log else _rounded(x)
    edges = _edges(x, axis.log)
    if not edges.size:
        return nothing
    bins = np.searchsorted(edges, x, side="right")
    blocks = 2 * max(2, min(axis.blocks, r.size // 24) // 2)
    block = where * blocks // ground.n
    count = _table(bins, block, None, edges.size + 1, blocks)
    kept = count.sum(1) >= FEWEST
    if np.count_nonzero(kept) < 2:
        return nothing
    count, total = count[kept], _table(bins, block, r, edges.size + 1, blocks)[kept]
    place = np.bincount(bins, weights=x, minlength=kept.size)[kept] / count.sum(1)
    square = np.bincount(bins, weights=r**2, minlength=kept.size)[kept]
    mean = total.sum(1) / count.sum(1)
    variance = np.maximum(square / count.sum(1) - mean**2, 0.0)
    inflation = _inflation(count, total, mean, variance, r)
    gain, significant = _explained(count, total, max(inflation, 1.0) * float(np.mean(variance)))
    explained = gain / ground.residual.size
    result = replace(
        nothing,
        x=10.0**place if axis.log else place,
        mean=mean,
        spread=np.sqrt(inflation * variance / count.sum(1)),
    )
    if not significant:
        return result
    share = float(min(1.0, explained / max(ground.excess, explained)))
    return replace(result, share=share, significant=True)


def _table(
    bins: IndexArray, block: IndexArray, weights: FloatArray | None, rows: int, columns: int
) -> FloatArray:
    """Return the number or the weights of the samples of every bin and block."""
    code = bins * columns + block
    table = np.bincount(code, weights=weights, minlength=rows * columns)
    return table.reshape(rows, columns).astype(np.float64)


def _rounded(x: FloatArray) -> FloatArray:
    """Return the coordinate without rounding errors, which would make bins of one value."""
    step = 1e-6 * float(np.ptp(x))
    return np.round(x / step) * step if step > 0 else x


def _edges(x: FloatArray, log: bool) -> FloatArray:
    """Return inner edges of the bins: equal shares of the samples, or of the decades."""
    low, high = float(x.min()), float(x.max())
    most = min(BINS, x.size // (2 * FEWEST))
    if log:
        size = int(np.clip(PER_DECADE * (high - low), 1, most))
        return np.linspace(low, high, size + 1)[1:-1]
    if x.size > _DRAWN:
        x = x[np.random.default_rng(0).integers(0, x.size, _DRAWN)]
    inner = np.unique(np.quantile(x, np.arange(1, most) / most, method="lower"))
    edges: FloatArray = inner[inner > low]
    # two values of which the greater is rare have no edge among the quantiles
    return edges if edges.size or high <= low else np.array([high])


def _inflation(
    count: FloatArray, total: FloatArray, mean: FloatArray, variance: FloatArray, r: FloatArray
) -> float:
    """Return by how much correlation enlarges the variance of means, from sums over blocks.

    Sums of white noise over n_bj samples of bin b and block j differ from n_bj times the bin's mean
    by a variance that adds up to s_b^2 n_b (1 - sum_j (n_bj/n_b)^2).
    """
    result = float(np.sum((total - count * mean[:, None]) ** 2))
    size = count.sum(1)
    white = float(np.sum(variance * size * (1.0 - np.sum((count / size[:, None]) ** 2, axis=1))))
    if white <= 1e-3 * float(np.sum(variance * size)):
        return correlation_inflation(r)
    return result / white


def _explained(count: FloatArray, total: FloatArray, noise: float) -> tuple[float, bool]:
    """Return the sum of squares that the means of one half of the blocks explain in the other.

    The halves follow Thue and Morse, so that no period of the drive falls in with them. Under noise
    the gain has mean -2 B s^2 and deviation 4 sqrt(B) s^2 for B bins and the variance s^2 of
    independent samples; it is significant some five deviations above, if most blocks agree.
    """
    blocks = count.shape[1]
    half = np.array([k.bit_count() % 2 for k in range(blocks)], dtype=np.bool_)
    gain = np.zeros(blocks)
    for part in (half, ~half):
        size = count[:, ~part].sum(1)
        mean = np.where(size >= FEWEST, total[:, ~part].sum(1) / np.maximum(size, 1.0), 0.0)
        gain[part] = 2.0 * mean @ total[:, part] - mean**2 @ count[:, part]
    gain = gain[count.sum(0) > 0]
    explained = float(np.sum(gain))
    agree = float(np.mean(gain)) > 1.5 * float(np.std(gain)) / np.sqrt(max(gain.size, 1))
    # the variance itself is uncertain where blocks are few
    least = (8.0 * float(np.sqrt(count.shape[0])) + 12.0) * (1.0 + 20.0 / blocks) * noise
    return explained, agree and explained > least


#: The voltage turns where it returns by this share of its range, or by so much of its noise.
_TURN, _NOISES = 1e-4, 8.0
#: The noise of a rate is brought below this share of the mean rate.
_QUIET = 0.05
#: Frequencies are separated from this step of their decimal logarithm on.
_STEP = 0.02


@dataclass(frozen=True, eq=False)
class Drive:
    """A voltage's turning samples `turns` (k,) and its smoothed rate (n,) [V/s]."""

    turns: IndexArray
    rate: FloatArray


def axes(record: Record, predicted: FloatArray, drive: Drive) -> tuple[Axis, ...]:
    """Return the axes of a record; `predicted` (n,) [m] is the displacement's, without noise.

    Against the measured displacement a residual would follow its noise. Errors of gain and lag
    change sign twice a period: they show if they count along the voltage's deviation or motion.
    """
    t, v = record.time - record.time[0], record.voltage
    h = _history(t, v, drive.turns)
    length = record.displacement_unit
    rows = (
        ("voltage", "V", v, None),
        ("displacement", length, predicted, None),
        ("rate", "V/s", drive.rate, None),
        ("since_reversal", "s", h.since, None),
        ("since_reversal_lag", "s", h.since, h.motion),
        ("from_reversal", "V", h.distance, None),
        ("amplitude", "V", h.swing, None),
        ("amplitude_gain", "V", h.swing, h.side),
        ("amplitude_lag", "V", h.swing, h.motion),
        ("frequency", "Hz", h.frequency, None),
        ("frequency_gain", "Hz", h.frequency, h.side),
        ("frequency_lag", "Hz", h.frequency, h.motion),
    )
    return tuple(
        Axis(name, unit, x, log=x is h.since,
             blocks=FINE if name.startswith(("ampl", "freq")) else COARSE, sign=sign)
        for name, unit, x, sign in rows
    )  # fmt: skip


def time_axis(record: Record) -> Axis:
    """Return the time since the record began."""
    t = record.time - record.time[0]
    return Axis("time", "s", t, blocks=FINE)


def hold_axis(record: Record) -> tuple[Axis, int]:
    """Return lg of the time since a hold began, the residual signed by the change before it.

    With it comes the number of holds; holds without a change before them do not count unless there
    are no others.
    """
    since, sign = np.full(record.n, np.nan), np.zeros(record.n)
    spans, step = held(record), record.sample_time
    for start, stop in spans:
        before = record.voltage[max(0, start - 8)]
        change = float(np.sign(np.mean(record.voltage[start:stop]) - before)) if start else 0.0
        since[start:stop] = record.time[start:stop] - record.time[start] + step
        sign[start:stop] = change
    count = len({a for a, _ in spans if sign[a] != 0})
    if not count:
        sign, count = np.isfinite(since).astype(np.float64), len(spans)
    return Axis("holds", "s", since, log=True, blocks=FINE, sign=sign), count


def drive_of(record: Record) -> Drive:
    """Return turning samples and rate of the voltage, both insensitive to the voltage's noise.

    The rate is the slope of a running mean, as long as it takes to bring the rate's noise below
    5 % of its mean size.
    """
    v, n = record.voltage, record.n
    span, noise = float(np.ptp(v)), fast_noise(v)
    turns = reversals(v, max(_TURN * span, _NOISES * noise))
    stops = np.r_[0, turns, n - 1]
    mean_rate = float(np.sum(np.abs(np.diff(v[stops])))) / max(record.duration, 1e-300)
    wanted = _QUIET * mean_rate * record.sample_time
    ratio = 1.4142 * noise / wanted if wanted > 0 else 0.0
    width = int(np.clip(np.ceil(ratio ** (2.0 / 3.0)), 1, max(1, n // 100)))
    smooth = scipy.ndimage.uniform_filter1d(v, width, mode="nearest") if width > 1 else v
    half = max(1, width // 2)
    k = np.arange(n)
    low, high = np.maximum(k - half, 0), np.minimum(k + half, n - 1)
    return Drive(turns, (smooth[high] - smooth[low]) / (record.time[high] - record.time[low]))


@dataclass(frozen=True, eq=False)
class _History:
    """What the voltage did, arrays (n,).

    Since the last reversal: time [s] and voltage [V]. Of the half-wave: peak to peak [V], frequency
    [Hz], the sign of its motion and of the voltage above its middle.
    """

    since: FloatArray
    distance: FloatArray
    swing: FloatArray
    frequency: FloatArray
    motion: FloatArray
    side: FloatArray


def _history(t: FloatArray, v: FloatArray, turns: IndexArray) -> _History:
    """Return what the voltage did since its last reversal, nan or sign 0 where it had none."""
    since, distance, swing, frequency = (np.full(t.size, np.nan) for _ in range(4))
    motion, side = np.zeros(t.size), np.zeros(t.size)
    if turns.size:
        after = slice(turns[0], t.size)
        lengths = np.diff(np.r_[turns, t.size])
        last = np.repeat(turns, lengths)
        since[after] = np.maximum(t[after] - t[last], 0.5 * float(np.median(np.diff(t))))
        distance[after] = v[after] - v[last]
        between = slice(turns[0], turns[-1])
        change = np.diff(v[turns])
        swing[between] = np.repeat(np.abs(change), lengths[:-1])
        # steps of 5 %, so that one frequency is one whatever the sampling makes of its turns
        half = np.round(np.log10(0.5 / np.diff(t[turns])) / _STEP) * _STEP
        frequency[between] = np.repeat(10.0**half, lengths[:-1])
        motion[between] = np.repeat(np.sign(change), lengths[:-1])
        middle = np.repeat(v[turns[:-1]] + 0.5 * change, lengths[:-1])
        side[between] = np.sign(v[between] - middle)
    return _History(since, distance, swing, frequency, motion, side)
