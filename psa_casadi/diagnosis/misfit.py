"""What a simulation gets wrong: views, lines and harmonics of one record's residual.

A view is the residual against one coordinate: time, voltage, rate, history, drive.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy

from psa_casadi.common.errors import InputError
from psa_casadi.common.notes import Note, note, texts
from psa_casadi.common.units import BoolArray, FloatArray, IndexArray
from psa_casadi.diagnosis.noise import NoiseFloor
from psa_casadi.records.drive import drive_frequency, reversals
from psa_casadi.records.noise import correlation_inflation, fast_noise, lines_in
from psa_casadi.records.record import Record
from psa_casadi.records.repeats import held, repetitions

#: Most bins of a view, bins of a decade on a logarithmic axis, fewest samples of a bin.
BINS, PER_DECADE, _IN_BIN = 24, 5, 8
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
    if np.count_nonzero(there) < 8 * _IN_BIN:
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
    kept = count.sum(1) >= _IN_BIN
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
    most = min(BINS, x.size // (2 * _IN_BIN))
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
        mean = np.where(size >= _IN_BIN, total[:, ~part].sum(1) / np.maximum(size, 1.0), 0.0)
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
    since, distance, swing, frequency, motion, side = _history(t, v, drive.turns)
    length = record.displacement_unit
    rows = (
        ("voltage", "V", v, None),
        ("displacement", length, predicted, None),
        ("rate", "V/s", drive.rate, None),
        ("since_reversal", "s", since, None),
        ("since_reversal_lag", "s", since, motion),
        ("from_reversal", "V", distance, None),
        ("amplitude", "V", swing, None),
        ("amplitude_gain", "V", swing, side),
        ("amplitude_lag", "V", swing, motion),
        ("frequency", "Hz", frequency, None),
        ("frequency_gain", "Hz", frequency, side),
        ("frequency_lag", "Hz", frequency, motion),
    )
    return tuple(
        Axis(name, unit, x, log=x is since,
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


def _history(t: FloatArray, v: FloatArray, turns: IndexArray) -> tuple[FloatArray, ...]:
    """Return what the voltage did, arrays (n,): nan or sign 0 where it had no reversal before.

    Since the last reversal: time [s] and voltage [V]. Of the half-wave: peak to peak [V], frequency
    [Hz], the sign of its motion and of the voltage above its middle.
    """
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
    return since, distance, swing, frequency, motion, side


#: Points of the spectrum that are kept; lines that are listed.
_POINTS, LINES = 300, 6
_MAINS = (50.0, 60.0)
_HARMONICS = 40
#: The drive moves at a frequency where it has this share of its range.
_LOUD = 5e-3


@dataclass(frozen=True)
class Line:
    """A tone: `frequency` [Hz], `amplitude` [m, or counts], and what has such a frequency."""

    frequency: float
    amplitude: float
    name: str
    of_drive: bool


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Amplitude density [m/sqrt(Hz)] of a residual and of the noise at `frequency` [Hz].

    `lines` are the strongest first; `share` is what those that are no harmonics of the drive hold
    of the residual's power above the noise. Amplitudes are in `unit`.
    """

    frequency: FloatArray
    density: FloatArray
    floor: FloatArray
    lines: tuple[Line, ...]
    share: float
    unit: str

    @property
    def others(self) -> tuple[Line, ...]:
        """The lines that are not the drive's."""
        return tuple(line for line in self.lines if not line.of_drive)


def spectrum_of(
    record: Record, residual: FloatArray, floor: NoiseFloor, excess: float, drive: float | None
) -> Spectrum:
    """Return the spectrum of a residual (n,), nan counting as zero after the mean is removed.

    `excess` [m^2] is its power above the noise, `drive` [Hz] the fundamental of a periodic voltage.
    Hann's window over the whole record; uneven sampling is bridged by straight lines.
    """
    even, step = _even(record.time, residual)
    n = even.size
    window = np.hanning(n + 1)[:-1]
    there = float(np.mean(even != 0.0)) or 1.0
    power = np.abs(np.fft.rfft(even * window)) ** 2 * 2.0 * step / float(window @ window) / there
    frequency = np.arange(power.size) / (n * step)
    lines = _lines(record, frequency, power, drive, window)
    held = sum(0.5 * line.amplitude**2 for line in lines if not line.of_drive)
    share = min(1.0, held / max(excess, held)) if held > 0 else 0.0
    f, density = _condensed(frequency, power)
    # the noise's from its autocovariance, faded out after Bartlett
    lags = np.arange(floor.autocovariance.size)
    faded = floor.autocovariance * (1.0 - lags / lags.size) * np.where(lags > 0, 2.0, 1.0)
    of_noise = np.cos(2.0 * np.pi * np.outer(f * record.sample_time, lags)) @ faded
    noise = np.sqrt(np.maximum(2.0 * record.sample_time * of_noise, 0.0))
    return Spectrum(f, density, noise, lines, share, record.displacement_unit)


def _lines(
    record: Record,
    frequency: FloatArray,
    power: FloatArray,
    drive: float | None,
    window: FloatArray,
) -> tuple[Line, ...]:
    """Return the strongest lines; where the voltage moves too, they are the drive's."""
    width = float(frequency[1])
    v, _ = _even(record.time, record.voltage)
    moved = 2.0 * np.abs(np.fft.rfft(v * window)) / float(np.sum(window))
    loud = moved > _LOUD * float(np.ptp(record.voltage))
    peaks, around = lines_in(power)
    rows = []
    for k in peaks.tolist():
        near = slice(k - 2, k + 3)
        held = max(float(np.sum(power[near]) - 5.0 * around[k]), 0.0)
        # a tone of amplitude A holds A^2/2, spread over the window's lines
        amplitude = float(np.sqrt(2.0 * held * width))
        centre = float(power[near] @ frequency[near] / np.sum(power[near]))
        line = _named(centre, amplitude, drive, record.sample_time, width)
        if not line.of_drive and loud[near].any():
            line = Line(centre, amplitude, "moved by the drive", True)
        rows.append(line)
    return tuple(sorted(rows, key=lambda line: -line.amplitude)[:LINES])


def _even(time: FloatArray, residual: FloatArray) -> tuple[FloatArray, float]:
    """Return the residual without its mean, 0 where missing, on an even grid, and its step."""
    there = np.isfinite(residual)
    centred = np.where(there, residual - np.mean(residual[there]), 0.0)
    step = float(time[-1] - time[0]) / (time.size - 1)
    steps = np.diff(time)
    if float(np.max(np.abs(steps - step))) < 0.1 * step:
        return centred, step
    grid = time[0] + step * np.arange(time.size)
    even = np.interp(grid, time[there], centred[there])
    return even, step


def _named(f: float, amplitude: float, drive: float | None, step: float, width: float) -> Line:
    """Return a line with what may have made it: the drive, the mains or its alias, or unknown."""
    near = 1.5 * width
    if drive is not None:
        order = round(f / drive)
        if 1 <= order <= _HARMONICS and abs(f - order * drive) < near:
            return Line(f, amplitude, f"harmonic {order} of the drive", True)
    for mains in _MAINS:
        for order in (1, 2, 3):
            tone, rate = order * mains, 1.0 / step
            alias = abs(tone - rate * round(tone / rate))
            if abs(f - alias) < max(near, 2e-3 * tone):
                what = f"{mains:g} Hz mains" if order == 1 else f"{tone:g} Hz, from the mains"
                return Line(f, amplitude, what if tone < 0.5 * rate else f"alias of {what}", False)
    return Line(f, amplitude, "", False)


def _condensed(frequency: FloatArray, power: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return frequencies and root mean powers of bands that widen with the frequency."""
    edges = np.unique(np.geomspace(1, power.size, _POINTS).astype(np.int64))
    starts = edges[:-1] if edges.size > 1 else edges
    size = np.diff(np.r_[starts, power.size])
    means = np.add.reduceat(power, starts) / size
    return np.add.reduceat(frequency, starts) / size, np.sqrt(means)


#: Fewest periods that are split.
PERIODS = 3
#: The excited lines hold this share of the voltage's power.
_EXCITED = 0.995
_SIGNIFICANT = 1e-5


@dataclass(frozen=True, eq=False)
class HarmonicSplit:
    """Power of a residual [m^2] by its place among the harmonics of the drive.

    `linear` lies at the excited lines, coherent with the voltage; `even` and `odd` at harmonics
    that are not excited; `noise` between the harmonics, what lies under them included.
    `fundamental` [Hz] is the drive's, `excited` the number of its lines.
    """

    fundamental: float
    periods: int
    excited: int
    linear: float
    even: float
    odd: float
    noise: float

    @property
    def repeats(self) -> float:
        """Power of all that repeats."""
        return self.linear + self.even + self.odd


def harmonic_split(record: Record, residual: FloatArray) -> HarmonicSplit | None:
    """Split a residual (n,) under a voltage of three periods or more, None under any other.

    The harmonics of a periodic voltage carry all that repeats: even nonlinearity at even, odd at
    odd harmonics; lines between them are noise. At an excited line the linear misfit and the
    coherent odd one cannot be separated by one record. Source: Pintelon and Schoukens, System
    Identification, 2nd ed., section 4.3.
    """
    runs = [r for r in repetitions(record) if r.stop - r.start >= (PERIODS - 1) * r.lag]
    if not runs:
        return None
    run = min(runs, key=lambda r: (r.lag, r.start - r.stop))  # the shortest period's longest run
    periods = (run.stop + run.lag - run.start) // run.lag
    # the first period is left to transients where enough others remain
    periods -= periods > PERIODS
    stop = run.stop + run.lag
    part = slice(stop - periods * run.lag, stop)
    e, v = residual[part].reshape(periods, run.lag), record.voltage[part]
    if not np.isfinite(e).any(axis=0).all():
        return None
    amplitude = np.abs(np.fft.rfft(v - np.mean(v)))[::periods]
    excited = _excited(amplitude)
    base = int(np.gcd.reduce(np.flatnonzero(excited)))
    order = np.arange(amplitude.size)
    harmonic = (order % base == 0) & (order > 0)
    classes = {
        "linear": excited,
        "even": harmonic & ~excited & (order // base % 2 == 0),
        "odd": harmonic & ~excited & (order // base % 2 == 1),
    }
    line, between = _powers(_filled(e), periods)
    table = {name: _significant(line[c], between[c], periods) for name, c in classes.items()}
    total = float(np.sum(line[1:])) + float(np.sum(between[1:])) * (periods - 1)
    noise = max(total - sum(table.values()), 0.0)
    first = float(record.time[run.start + run.lag] - record.time[run.start])
    return HarmonicSplit(base / first, periods, int(excited.sum()), **table, noise=noise)


def _excited(amplitude: FloatArray) -> BoolArray:
    """Return the fewest lines that hold 99.5 % of the power, and those as strong as the last."""
    power = amplitude**2
    power[0] = 0.0
    order = np.argsort(-power)
    last = int(np.searchsorted(np.cumsum(power[order]), _EXCITED * float(np.sum(power))))
    strong: BoolArray = power >= 0.5 * power[order[min(last, order.size - 1)]]
    return strong


def _filled(e: FloatArray) -> FloatArray:
    """Return periods (periods, lag) without line and mean, missing samples from other periods."""
    there = np.isfinite(e)
    usual = np.nanmean(e, axis=0)
    whole = np.where(there, e, usual).ravel()
    # a line through the means of the periods does not touch what repeats
    middle = np.arange(e.shape[0]) - 0.5 * (e.shape[0] - 1)
    slope = float(middle @ np.mean(np.where(there, e, usual), axis=1) / (middle @ middle))
    place = (np.arange(whole.size) - 0.5 * (whole.size - 1)) / e.shape[1]
    flat: FloatArray = whole - np.mean(whole) - slope * place
    return flat


def _powers(e: FloatArray, periods: int) -> tuple[FloatArray, FloatArray]:
    """Return the power [m^2] of every harmonic, and the mean of the lines around each (lines,)."""
    power = 2.0 * np.abs(np.fft.rfft(e)) ** 2 / e.size**2
    lines = (power.size - 1) // periods + 1
    rows = np.zeros((lines + 1, periods))
    rows.ravel()[: power.size] = power[: rows.size]
    means = np.sum(rows[:, 1:], axis=1) / max(periods - 1, 1)
    before = np.r_[means[0], means[: lines - 1]]
    return rows[:lines, 0], 0.5 * (before + means[:lines])


def _significant(line: FloatArray, between: FloatArray, periods: int) -> float:
    """Return the power of some harmonics above the noise, 0 where noise could have made it."""
    noise = float(np.sum(between))
    if not line.size or not np.sum(line) > 0:
        return 0.0
    above = float(np.sum(line)) - noise
    if noise > 0:
        freedom = 4 * (periods - 1) * max(1, line.size // 2)
        p = float(scipy.special.fdtrc(2 * line.size, freedom, float(np.sum(line)) / noise))
        above = above if p < _SIGNIFICANT else 0.0
    return max(above, 0.0)


#: A view that explains less than this of the excess is not put into words.
WORTH_SAYING = 0.05
#: A drift is removed before other views are taken if the drive turns so often in a bin of time.
TURNS = 2
#: Fewer samples than this show nothing.
FEWEST = 64


@dataclass(frozen=True)
class Slope:
    """Residual per decade of time since a hold began [m], signed by the change, and its error."""

    value: float
    error: float


@dataclass(frozen=True, eq=False)
class Misfit:
    """One record's residual: its size, the views of it, and the findings.

    `rms` [m, or counts] is without the mean `mean`; `floor` is the noise, `excess` the share of the
    power above it. The view named "holds" is None in a record without holds, as is `slope`;
    `split` is None unless the voltage is periodic. `findings` begin with the size; the rest is
    what explains more than 5 % of the excess, in falling order, and the split; noise has none.
    """

    record: str
    rms: float
    mean: float
    floor: NoiseFloor
    excess: float
    views: tuple[View, ...]
    holds: View | None
    slope: Slope | None
    spectrum: Spectrum
    split: HarmonicSplit | None
    findings: tuple[Note, ...]

    @property
    def sentences(self) -> tuple[str, ...]:
        """The findings in words."""
        return texts(self.findings)


def misfit(record: Record, residual: FloatArray, floor: NoiseFloor) -> Misfit:
    """Return what the residual (n,) [m] of a record shows, measured minus predicted.

    `residual` is nan where nothing counts. Time and memory grow with the number of samples.

    Raises:
        InputError: the residual has another length than the record, or fewer than 64 samples.
    """
    if residual.shape != record.time.shape or np.count_nonzero(np.isfinite(residual)) < FEWEST:
        raise InputError(
            f"record '{record.name}': its residual has {np.count_nonzero(np.isfinite(residual))}"
            f" valid samples of {residual.size} for {record.n} instants; give one value for each"
            f" instant, {FEWEST} of them valid at least."
        )
    ground = ground_of(residual, floor.level)
    drive = drive_of(record)
    over_time = view(ground, time_axis(record))
    steady = _steady(ground, record, over_time, drive)
    known = record.displacement  # the prediction is this less the residual, up to a constant
    predicted = np.full(record.n, np.nan) if known is None else known - residual
    rows = axes(record, predicted, drive)
    # what varies as slowly as time itself would vanish with the drift
    slow = ("amplitude", "frequency")
    all_views = [over_time, *(view(ground if a.name in slow else steady, a) for a in rows)]
    held, slope, count = _holds(record, ground)
    split = harmonic_split(record, residual)
    line = split.fundamental if split is not None else drive_frequency(record)
    spectrum = spectrum_of(record, residual, floor, ground.excess, line)
    power = float(np.mean(ground.residual**2))
    excess = max(0.0, 1.0 - floor.level**2 / power) if power > 0 else 0.0
    rms, mean, unit = float(np.sqrt(power)), float(np.nanmean(residual)), record.displacement_unit
    shares = [(v.share, _followed(v, unit)) for v in all_views if v.significant]
    if held is not None and held.significant:
        shares.append((held.share, _held(held, slope, count, unit)))
    lines = tuple((n.frequency, n.name, (n.amplitude, unit)) for n in spectrum.others[:3])
    tones = note("lines", lines=lines, count=len(spectrum.others), share=spectrum.share)
    shares.append((spectrum.share, tones))
    gain = sorted((row for row in shares if row[0] > WORTH_SAYING), key=lambda row: -row[0])
    findings = [_size(record, rms, mean, floor, excess), *(finding for _, finding in gain)]
    if split is not None and split.repeats > WORTH_SAYING * ground.excess:
        findings.append(_split(split, unit))
    return Misfit(
        record.name, rms, mean, floor, excess, tuple(all_views), held, slope, spectrum, split,
        tuple(findings),
    )  # fmt: skip


def _steady(ground: Ground, record: Record, over_time: View, drive: Drive) -> Ground:
    """Return the residual without its slow part, if the drive turns often in every bin of time.

    A drift would hide smaller views. Under a slow drive the two cannot be separated, and the
    residual stays as it is.
    """
    if not over_time.significant or drive.turns.size < TURNS * over_time.x.size:
        return ground
    time = record.time[ground.index] - record.time[0]
    return replace(ground, residual=ground.residual - np.interp(time, over_time.x, over_time.mean))


def _holds(record: Record, ground: Ground) -> tuple[View | None, Slope | None, int]:
    """Return the residual against lg of the time since a hold began, its slope, and the holds."""
    axis, count = hold_axis(record)
    if not count:
        return None, None, 0
    result = view(ground, axis)
    good = result.spread > 0
    if np.count_nonzero(good) < 3:
        return result, None, count
    x, weight = np.log10(result.x[good]), result.spread[good] ** -2.0
    x = x - np.average(x, weights=weight)
    spread = float(np.sum(weight * x**2))
    value = float(np.sum(weight * x * result.mean[good])) / spread
    return result, Slope(value, 1.0 / float(np.sqrt(spread))), count


def _size(record: Record, rms: float, mean: float, floor: NoiseFloor, excess: float) -> Note:
    """Return how large the residual is, against its noise."""
    unit = record.displacement_unit
    return note(
        "residual", record=record.name, rms=(rms, unit), noise=(floor.level, unit),
        ratio=rms / floor.level if floor.level > 0 else None, source=floor.source,
        excess=excess, mean=(mean, unit) if abs(mean) > rms else None,
    )  # fmt: skip


def _followed(v: View, unit: str) -> Note:
    """Return what the residual follows, with the extremes that stand clear of their errors."""
    ends = tuple(((float(v.mean[k]), unit), (float(v.x[k]), v.x_unit)) for k in v.extremes)
    return note("follows", axis=v.name, ends=ends, share=v.share)


def _held(v: View, slope: Slope | None, count: int, unit: str) -> Note:
    """Return how the residual moves in holds; without a slope it only differs."""
    if slope is None:
        return _followed(v, unit)
    clear = abs(slope.value) > 3.0 * slope.error
    moves = (slope.value, unit) if clear else None
    return note("holds", count=count, moves=moves, share=v.share)


def _split(s: HarmonicSplit, unit: str) -> Note:
    total = s.repeats + s.noise
    rows = {"linear": s.linear, "even": s.even, "odd": s.odd}
    parts = tuple(
        (name, p / total, (float(np.sqrt(p)), unit))
        for name, p in sorted(rows.items(), key=lambda row: -row[1])
        if p > 0
    )
    return note(
        "harmonics", periods=s.periods, excited=s.excited, parts=parts, rest=s.noise / total
    )
