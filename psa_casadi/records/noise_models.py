"""Models of a residual: spectra, tones, jumps between levels, and what follows the drive.

Spectra are white, autoregressive or fall with a power of the frequency. All are compared by
Whittle's likelihood of one periodogram I_j = |E_j|^2 / n, less the price of Schwarz' criterion for
k parameters,

    L = -sum_j (ln S_j + I_j / S_j) - k/2 ln n,

and lines, which no smooth spectrum has, are removed before. Frequencies are in cycles per sample.

What follows the drive is a regression on functions of the input u, its history and the prediction
y: powers, direction and rate, first-order lags of u, play operators (Krasnosel'skii and Pokrovskii
1989), and the distance from the last reversal. They are weighted by the noise's spectrum, so that
noise of any colour follows them by chance only.

Jumps are between two levels that the signal visits repeatedly, or a few steps. Two levels are a
Markov chain in white noise, whose likeliest path is Viterbi's: with the chance p of a jump and
c = ln(1/p - 1), the log odds of the upper level are d_k = e_k + min(max(d_(k-1), -c), c), e_k the
evidence of sample k. Steps are detected by a matched filter: the noise's whitening filter makes of
each the same response. A step costs 3/2 ln n for its place and its size.

Sources: Whittle, Arkiv foer Matematik 2 (1953) 423; Schwarz, Annals of Statistics 6 (1978) 461;
Viterbi, IEEE Transactions on Information Theory 13 (1967) 260; Turin, IRE Transactions on
Information Theory 6 (1960) 311.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import accumulate, pairwise
from typing import Literal

import numpy as np
import scipy

from psa_casadi.common.units import BoolArray, FloatArray, IndexArray
from psa_casadi.records.drive import reversals
from psa_casadi.records.noise import convolved, filtered, forgets, lag_products, lines_in, peaks
from psa_casadi.records.repeats import autoregression_of

#: A spectrum's shape by the name of its family.
Family = Literal["white", "autoregressive", "one_over_f"]
#: Bins of a periodogram, as wide as a share of their frequency.
_BINS = 400
#: Lags of the filter that whitens any spectrum.
FILTER = 24
#: A family must gain this many nats over white noise; nearer families are indistinguishable.
LEAST, NEAR = 5.0, 3.0
#: Rounds in which two parameters of a shape are sought, in this many steps each; each round is
#: within a step of the one before.
_ROUNDS, _STEPS = 3, 9
#: Slopes of spectra that are sought; beyond the highest one the signal is smooth.
_SLOPES = (0.4, 2.6)
#: A correlation time beyond this part of a signal is indistinguishable from a random walk.
_WANDERS = 50


@dataclass(frozen=True, eq=False)
class Colour:
    """A spectrum S(f): its family, what it gains over white noise [nats], and its shape.

    `figures` are the order and the correlation `time` [samples] of an autoregression, or the slope
    a of f^-a and the corner [cycles per sample] at which white noise is as large. `is_clear` is
    False if another family is as likely. `density` gives the shape of S at frequencies (m,).
    """

    family: Family
    gain: float
    figures: Mapping[str, float]
    density: Callable[[FloatArray], FloatArray]
    is_clear: bool = True

    def whitened(self, signal: FloatArray) -> FloatArray:
        """Return a signal (n,) through the filter of order 24 that makes this noise white."""
        if self.family == "white":
            return signal
        white = filtered(self.filter(signal.size), [1.0], signal)
        white[:FILTER] = 0.0  # nothing is known before
        return white

    def filter(self, n: int) -> FloatArray:
        """Return the coefficients (25,) of the filter that makes noise of n samples white."""
        covariance = self.covariance(n)[: FILTER + 1]
        a = scipy.linalg.solve_toeplitz(covariance[:-1], covariance[1:])
        return np.asarray(np.r_[1.0, -a])

    def covariance(self, n: int) -> FloatArray:
        """Return the shape of the autocovariance (n,) that belongs to the spectrum."""
        shape = self.density(np.maximum(np.arange(n // 2 + 1), 1) / n)
        return np.asarray(scipy.fft.irfft(shape, n))


WHITE = Colour("white", 0.0, {}, np.ones_like)


def straightened(signal: FloatArray) -> FloatArray:
    """Return a signal (n,) without its mean and trend."""
    t = np.linspace(-1.0, 1.0, signal.size)
    centred = signal - np.mean(signal)
    return np.asarray(centred - t * (t @ centred) / (t @ t))


def score(signal: FloatArray, colour: Colour) -> float:
    """Return L of a signal (n,) with a colour, up to a constant of n alone."""
    power = max(float(np.var(straightened(signal))), 1e-300)
    return colour.gain - 0.5 * signal.size * float(np.log(power))


def colour_of(signal: FloatArray) -> Colour:
    """Return the simplest spectrum that explains a signal (n,), by the criterion above.

    Families: white; autoregressive of order 1 to 8, or of first order on white noise; f^-a, alone
    or on white noise. `is_clear` is False if the best of another family is as likely.
    """
    flat = straightened(signal)
    periodogram = _Periodogram(flat)
    power = _power(periodogram)
    families = [*_autoregressive(periodogram, flat), _lag(periodogram), power]
    best = max(families, key=lambda c: c.gain)
    if best.gain < LEAST:
        return WHITE
    if best.figures.get("time", 0.0) > flat.size / _WANDERS and power.gain > best.gain - NEAR:
        return power  # what forgets so slowly has a spectrum of f^-2
    others = [c.gain for c in families if c.family != best.family]
    return replace(best, is_clear=best.gain - max(others, default=-np.inf) > NEAR)


class _Periodogram:
    """The periodogram of a signal (n,) in bins: means `power` (b,) of `count` lines each."""

    def __init__(self, flat: FloatArray) -> None:
        self.n, half = flat.size, (flat.size + 1) // 2
        edges = np.unique(np.geomspace(1, half, _BINS).astype(np.int64))
        power = np.abs(scipy.fft.rfft(flat)) ** 2 / self.n
        self.count = np.diff(edges).astype(np.float64)
        self.power = np.add.reduceat(power[:half], edges[:-1]) / self.count + 1e-300
        self.frequency = 0.5 * (edges[:-1] + edges[1:] - 1) / self.n

    def gain(self, shape: FloatArray, parameters: int) -> FloatArray:
        """Return by how much L of shapes (..., b) is above that of white noise."""
        lines = float(np.sum(self.count))
        level = (self.power / shape) @ self.count / (self.power @ self.count)
        price = 0.5 * parameters * float(np.log(self.n))
        return np.asarray(-np.log(shape) @ self.count - lines * np.log(level) - price)

    def likeliest(
        self, shape: Callable[..., FloatArray], *ranges: tuple[float, float]
    ) -> tuple[float, float, float, Callable[[FloatArray], FloatArray]]:
        """Return the two parameters of the likeliest shape in their ranges, its gain, and it."""
        for _ in range(_ROUNDS):
            first, second = (np.linspace(*r, _STEPS) for r in ranges)
            values = self.gain(shape(first[:, None, None], second[:, None], self.frequency), 2)
            i, j = divmod(int(np.argmax(values)), _STEPS)
            best = float(first[i]), float(second[j])
            widths = [(high - low) / (_STEPS - 1) for low, high in ranges]
            ranges = tuple((b - w, b + w) for b, w in zip(best, widths, strict=True))
        return *best, float(values[i, j]), partial(shape, *best)


def _autoregressive(periodogram: _Periodogram, flat: FloatArray) -> list[Colour]:
    a = autoregression_of(flat)
    if not a.size:
        return []

    def density(f: FloatArray) -> FloatArray:
        turn = np.polyval(np.r_[-a[::-1], 1.0], np.exp(-2j * np.pi * f))
        return np.asarray(1.0 / np.maximum(np.abs(turn) ** 2, 1e-12))

    gain = float(periodogram.gain(density(periodogram.frequency), a.size))
    colour, n = Colour("autoregressive", gain, {}, density), periodogram.n
    figures = {"order": float(a.size), "time": forgets(colour.covariance(n)[: n // 2])}
    f = np.linspace(0.5 / flat.size, 0.5, 1024)
    peak = int(np.argmax(density(f)))
    if 0 < peak < f.size - 1:
        figures["peak"] = float(f[peak])
    return [replace(colour, figures=figures)]


def _lag(periodogram: _Periodogram) -> Colour:
    """First-order autoregression on white noise: 1 + c / |1 - r z|^2, c over its largest."""

    def shape(memory: FloatArray, size: FloatArray, f: FloatArray) -> FloatArray:
        r = np.exp(-np.exp(-memory))
        low = (1.0 - r) ** 2
        return np.asarray(1.0 + np.exp(size) * low / (low + 4.0 * r * np.sin(np.pi * f) ** 2))

    memories = (-0.7, np.log(periodogram.n / 4.0))
    memory, _, gain, density = periodogram.likeliest(shape, memories, (-3.0, 14.0))
    return Colour("autoregressive", gain, {"order": 1.0, "time": float(np.exp(memory))}, density)


def _power(periodogram: _Periodogram) -> Colour:
    """Spectrum 1 + (corner / f)^a; the corner may lie beyond all frequencies."""

    def shape(slope: FloatArray, corner: FloatArray, f: FloatArray) -> FloatArray:
        return np.asarray(1.0 + np.exp(slope * (corner - np.log(f))))

    corners = (-np.log(periodogram.n), 4.0)
    slope, corner, gain, density = periodogram.likeliest(shape, _SLOPES, corners)
    pure = float(np.log(0.5)) < corner - 1.0
    gain += 0.5 * float(np.log(periodogram.n)) * pure
    figures = {"slope": slope} if pure else {"slope": slope, "corner": float(np.exp(corner))}
    return Colour("one_over_f", gain, figures, density)


@dataclass(frozen=True)
class Tone:
    """A line: frequency [cycles per sample] and amplitude in the signal's unit."""

    frequency: float
    amplitude: float


#: Lines that are sought at most.
_MOST = 6


def line_spectrum(signal: FloatArray) -> tuple[FloatArray, IndexArray]:
    """Return the periodogram of a signal (n,) under Hann's window, and its lines."""
    power = np.abs(scipy.fft.rfft((signal - np.mean(signal)) * np.hanning(signal.size))) ** 2
    return power, lines_in(power)[0]


def centre_of(power: FloatArray, line: int) -> float:
    """Return where in a periodogram a line has its centre, by a parabola of the logarithms."""
    low, middle, high = np.log(np.maximum(power[line - 1 : line + 2], 1e-300)).tolist()
    return float(line + 0.5 * (low - high) / (low - 2.0 * middle + high))


def tones_in(signal: FloatArray) -> tuple[list[Tone], FloatArray]:
    """Return the tones in a signal (n,), 0 where there is none, and the signal without them.

    The strongest is taken off before the next one is sought. Each is fitted by least squares, to
    first order in its frequency.
    """
    left, tones = signal.copy(), list[Tone]()
    there, t = signal != 0.0, np.linspace(-1.0, 1.0, signal.size)
    while len(tones) < _MOST:
        power, lines = line_spectrum(left)
        if not lines.size:
            break
        frequency = centre_of(power, int(lines[0])) / signal.size
        turn = 2.0 * np.pi * frequency * np.arange(signal.size)
        pair = np.column_stack([np.cos(turn), np.sin(turn)]) * there[:, None]
        columns = np.column_stack([pair, pair * t[:, None]])
        weights = np.linalg.solve(columns.T @ columns, columns.T @ left)
        left = left - columns @ weights
        tones.append(Tone(frequency, float(np.hypot(*weights[:2]))))
    return tones, left


#: Widths of play operators and of the way after a reversal, over the input's range.
_PLAYS, _WAYS = (0.05, 0.1, 0.2, 0.4), (0.05, 0.25)
#: Lags of first order: their number, from this many samples to this part of the record.
_LAGS, _FASTEST, _SLOWEST = 4, 5.0, 4.0
#: A turn comes back by this share of the range; with more turns than this no history is formed.
_TURN, _TURNS = 0.01, 1000
#: Nats beyond its price that a column, or a round of steps, must gain; and columns at most.
_CLEAR, _MOST_COLUMNS = 5.0, 16


def columns_of(inputs: Sequence[FloatArray], predicted: FloatArray) -> FloatArray:
    """Return functions (k, n), of equal size, of inputs (n,), and of a prediction (n,).

    The foremost input comes first.
    """
    y = _scaled(predicted)
    rate = np.gradient(y)
    functions = [y, y**2, y**3, rate, np.abs(rate), np.gradient(rate)]
    for k, u in enumerate(inputs):
        v = _scaled(u)
        functions += [v, v**2, v**3]
        if k == 0 and np.ptp(u) > 0.0:
            functions += _history(v)
    rows = np.array([straightened(c) for c in functions])
    size = np.linalg.norm(rows, axis=1)
    kept = size > 1e-9 * float(size.max(initial=0.0))
    return np.asarray(rows[kept] / size[kept, None])


def _spectra(rows: FloatArray) -> FloatArray:
    return np.asarray(scipy.fft.rfft(rows, axis=-1)[..., 1:].view(np.float64))


def _scaled(signal: FloatArray) -> FloatArray:
    """Return a signal within -1 and 1; 0 if it is constant."""
    low, high = float(np.min(signal)), float(np.max(signal))
    return (2.0 * signal - low - high) / (high - low) if high > low else np.zeros_like(signal)


def _history(v: FloatArray) -> list[FloatArray]:
    """Return what the input's history shows, of an input within -1 and 1."""
    rate = np.gradient(v)
    way = rate / (np.abs(rate) + 0.1 * float(np.sqrt(np.mean(rate**2))) + 1e-300)
    functions = [way, v * way, v**2 * way]
    times = np.geomspace(_FASTEST, max(v.size / _SLOWEST, 2.0 * _FASTEST), _LAGS)
    decays = np.exp(-1.0 / times)
    functions += [filtered([1.0 - r], [1.0, -r], v - v[0]) for r in decays]
    turns = reversals(v, _TURN * 2.0)
    if not 0 < turns.size <= _TURNS:
        return functions
    edges = [0, *turns.tolist(), v.size - 1]
    widths = 2.0 * np.array(_PLAYS)
    play, at = np.empty((v.size, widths.size)), np.full(widths.size, v[0])
    for a, b in pairwise(edges):
        part = v[a : b + 1, None]
        bound = np.maximum if part[-1, 0] > part[0, 0] else np.minimum
        play[a : b + 1] = bound(at, part - 0.5 * widths * np.sign(part[-1] - part[0]))
        at = play[b]
    last = np.repeat(edges[:-1], np.diff(edges) + np.r_[np.zeros(len(edges) - 2, int), 1])
    since = np.abs(v - v[last])
    side = np.sign(v[np.repeat(edges[1:], np.diff([*edges[:-1], v.size]))] - v[last])
    functions += [np.exp(-since / (2.0 * w)) * side for w in _WAYS]
    return [*functions, *play.T]


def followed(signal: FloatArray, columns: FloatArray, colour: Colour) -> tuple[FloatArray, float]:
    """Return what of a signal (n,) follows the columns, 0 where it does none, and its price.

    Column by column the one that explains most is added, as long as it gains more nats than
    ln k + ln(n)/2 and `_CLEAR`; weighted by the noise's spectrum at the level of what is left.
    """
    k, n = columns.shape
    none = np.zeros(n), 0.0
    if not k or n < 4 * k:
        return none
    weight = np.repeat(1.0 / np.sqrt(colour.density(np.arange(1, n // 2 + 1) / n)), 2)
    x, e = _spectra(columns) * weight, _spectra(straightened(signal)) * weight
    normal, cross, power = x @ x.T, x @ e, float(e @ e)
    least = float(np.log(k)) + 0.5 * float(np.log(n))
    chosen, left, weights = list[int](), power, np.zeros(0)
    while len(chosen) < _MOST_COLUMNS:
        rest = normal - normal[:, chosen] @ _solved(normal, chosen, normal[chosen])
        free = np.diag(rest) > 1e-8 * np.diag(normal)
        gone = cross - normal[:, chosen] @ weights
        explains = np.where(free, gone**2, 0.0) / np.where(free, np.diag(rest), 1.0)
        best = int(np.argmax(explains))
        if 0.5 * n * np.log(left / max(left - explains[best], 1e-12 * power)) < least + _CLEAR:
            break
        chosen.append(best)
        weights = _solved(normal, chosen, cross[chosen])
        left = max(power - float(cross[chosen] @ weights), 1e-12 * power)
    if not chosen:
        return none
    values: FloatArray = weights @ columns[chosen]
    return values, least * len(chosen)


def _solved(normal: FloatArray, chosen: list[int], right: FloatArray) -> FloatArray:
    """Return the solution of the chosen normal equations; an empty one of none."""
    return np.asarray(np.linalg.lstsq(normal[np.ix_(chosen, chosen)], right, rcond=1e-12)[0])


#: A period returns the input to this share of the variance of its changes, after it has moved by
#: half of it; it is no shorter, and is passed this many times at least.
_SAME, _MOVED, _SHORTEST, _PASSES = 0.02, 0.5, 8, 3
#: Phases of a period between which what returns is a straight line.
_PHASES = 64


def period_of(drive: FloatArray) -> float | None:
    """Return after how many samples a drive (n,) returns, None where it does not do so thrice."""
    n = drive.size
    v = drive - np.mean(drive)
    products = lag_products(v, n // _PASSES)
    square = np.r_[0.0, np.cumsum(v**2)]
    lags = np.arange(products.size)
    both = square[n - lags] + (square[n] - square[lags])
    away = (both - 2.0 * products) / np.maximum(both, 1e-300)
    moved = np.flatnonzero(away > _MOVED)
    back = np.flatnonzero(away[moved[0] :] < _SAME) if moved.size else moved
    if not back.size:
        return None
    first = int(moved[0] + back[0])
    lag = first + int(np.argmin(away[first : first + max(first // 4, 2)]))
    if not _SHORTEST <= lag < away.size - 1:
        return None
    low, middle, high = away[lag - 1 : lag + 2]
    bend = float(low - 2.0 * middle + high)
    return lag + (0.5 * float(low - high) / bend if bend > 0.0 else 0.0)


def returning(signal: FloatArray, index: IndexArray, period: float) -> tuple[FloatArray, float]:
    """Return what of a signal (m,) at samples `index` returns with a period, and its price."""
    phase = (index / period % 1.0) * _PHASES
    cell = phase.astype(np.int64) % _PHASES
    count = np.bincount(cell, minlength=_PHASES)
    mean = np.bincount(cell, weights=signal, minlength=_PHASES) / np.maximum(count, 1)
    repeated = np.asarray(np.interp(phase, np.arange(_PHASES) + 0.5, mean, period=_PHASES))
    return repeated, 0.5 * _PHASES * float(np.log(signal.size))


#: Widths of the means from which the two levels are first read, and iterations.
_WIDTHS, _ITERATIONS = (1, 4, 16, 64), 6
#: Two levels explain 2/pi = 0.64 of a normal distribution's variance, and more than this of theirs.
_SPLIT = 0.68
#: Two levels with fewer jumps are steps; steps at most: more are none.
_FEW, _MOST_STEPS = 3, 24
#: Whitened samples to either side of a step that detect it, rounds in which colour and steps
#: are, standard deviations of a step, samples between two, and steps at most.
_REACH, _STEP_ROUNDS, _STANDS_OUT, _APART, _MANY = 64, 6, 6.0, 4, 80


@dataclass(frozen=True, eq=False)
class Jumps:
    """Levels (n,) of a signal without mean, the places where it jumps, and the score with them."""

    levels: FloatArray
    places: IndexArray
    score: float

    @property
    def sizes(self) -> FloatArray:
        """How far it jumps at each place."""
        return np.diff(self.levels)[self.places - 1]

    @property
    def alternate(self) -> bool:
        """Whether jumps go up and down in turn, by nearly the same: between two levels."""
        up, size = self.sizes > 0.0, np.abs(self.sizes)
        turns = up[1:] != up[:-1]
        return bool(up.size > _FEW and turns.mean() > 0.8 and np.std(size) < 0.4 * np.mean(size))

    @property
    def undone(self) -> bool:
        """Whether every jump is one of a pair within `_REACH` samples that cancels: outliers.

        Not where jumps alternate between two levels.
        """
        before, last = self.places - 1, self.levels.size - 1
        ways = (
            (np.minimum(self.places + _REACH, last), before),
            (self.places, np.maximum(before - _REACH, 0)),
        )
        moved = np.min([np.abs(self.levels[b] - self.levels[a]) for b, a in ways], axis=0)
        return bool(np.all(moved < 0.5 * np.abs(self.sizes))) and not self.alternate


def two_levels(signal: FloatArray) -> Jumps | None:
    """Return the two levels between which a signal (n,) jumps, None without any."""
    n = signal.size
    split, low, high, count = max(_split(signal, width) for width in _WIDTHS)
    if split < _SPLIT:
        return None
    noise = float(np.sqrt(max(float(np.var(signal)) * (1.0 - split), 1e-300)))
    for _ in range(_ITERATIONS):
        clear = float(np.log(max(n / max(count, 1.0) - 1.0, 1.5)))
        upper = _path((high - low) * (signal - 0.5 * (high + low)) / noise**2, clear)
        if upper.all() or not upper.any():
            return None
        low, high = float(signal[~upper].mean()), float(signal[upper].mean())
        levels = np.where(upper, high, low)
        noise = max(float(np.std(signal - levels)), 1e-3 * noise)
        places = np.flatnonzero(np.diff(levels)) + 1
        count = float(places.size)
    if count <= _FEW:
        return None
    price = count * clear + n * float(np.log1p(np.exp(-clear))) + 2.0 * float(np.log(n))
    rest = signal - levels
    return Jumps(levels - levels.mean(), places, score(rest, colour_of(rest)) - price)


def _split(signal: FloatArray, width: int) -> tuple[float, float, float, float]:
    """Return the share of the variance of means that two levels explain, these, and the jumps."""
    means = signal[: signal.size // width * width].reshape(-1, width).mean(axis=1)
    low, high = np.quantile(means, [0.05, 0.95]).tolist()
    for _ in range(8):  # k-means
        upper = means > 0.5 * (low + high)
        if upper.all() or not upper.any():
            return 0.0, low, high, 0.0
        low, high = float(means[~upper].mean()), float(means[upper].mean())
    share = float(upper.mean())
    split = share * (1.0 - share) * (high - low) ** 2 / float(np.var(means))
    return split, low, high, 0.5 * float(np.count_nonzero(np.diff(upper)))


def _path(evidence: FloatArray, clear: float) -> BoolArray:
    """Return where the likeliest path is on the upper level, (n,)."""
    odds = np.array([*accumulate(evidence.tolist(), lambda d, e: e + min(max(d, -clear), clear))])
    sure = np.where(np.abs(odds) > clear, np.arange(odds.size), odds.size - 1)
    return np.asarray(odds[np.minimum.accumulate(sure[::-1])[::-1]] > 0.0)


def steps_in(signal: FloatArray, colour: Colour) -> Jumps | None:
    """Return the steps, or jumps between two levels, of a signal (n,) on a noise of a colour.

    None where none are clear, or too many for steps. The colour becomes that of what they leave.
    """
    n, best, places = signal.size, None, np.zeros(0, np.int64)
    least, levels = score(signal, colour) + _CLEAR, np.zeros(n)
    for _ in range(_STEP_ROUNDS):
        a = colour.filter(n)
        shape = np.cumsum(np.r_[np.zeros(_REACH), a, np.zeros(_REACH + 1 - a.size)])
        kernel = (shape - shape.mean())[::-1]
        match = np.abs(convolved(colour.whitened(signal - levels)[:, None], kernel)[:, 0])
        match /= 1.4826 * float(np.median(match))
        apart = _REACH if colour is WHITE else _APART
        match[: 2 * apart] = match[-2 * apart :] = 0.0
        more = peaks(np.where(match > _STANDS_OUT, match, 0.0), apart, _MANY)
        places = np.unique(np.r_[places, more])
        if not more.size or places.size > _MANY:
            break
        places, levels = _fitted(signal, places, colour)
        rest_colour = colour_of(signal - levels)
        likelihood = score(signal - levels, rest_colour) - 1.5 * places.size * float(np.log(n))
        if likelihood < least:
            break
        best, least = Jumps(levels, places, likelihood), likelihood
        colour = colour if colour is WHITE else rest_colour
    few = best is None or best.places.size <= _MOST_STEPS or best.alternate
    return best if few else None


def _fitted(
    signal: FloatArray, places: IndexArray, colour: Colour
) -> tuple[IndexArray, FloatArray]:
    """Return the places of steps that are clear, and these (n,), by generalised least squares."""
    least = 3.0 * float(np.log(signal.size)) + 2.0 * _CLEAR
    steps = (np.arange(signal.size)[:, None] >= np.r_[0, places]).astype(np.float64)
    white = filtered(colour.filter(signal.size), [1.0], steps)[FILTER:]
    y = colour.whitened(signal)[FILTER:]
    normal, along, power = white.T @ white, white.T @ y, float(y @ y)
    kept = np.arange(places.size + 1)
    while True:
        inverse = np.linalg.pinv(normal[np.ix_(kept, kept)], hermitian=True)
        sizes = inverse @ along[kept]
        noise = (power - float(along[kept] @ sizes)) / y.size
        gains = sizes[1:] ** 2 / (np.diag(inverse)[1:] * noise)
        if not gains.size or gains.min() > least:
            break
        kept = np.delete(kept, 1 + int(np.argmin(gains)))
    levels = steps[:, kept] @ sizes
    return places[kept[1:] - 1], levels - levels.mean()


def jumps_in(signal: FloatArray) -> Jumps | None:
    """Return the likeliest jumps of a signal (n,), None without any."""
    colour = colour_of(signal)
    starts = [colour] if colour is WHITE else [colour, WHITE]
    tried = [two_levels(straightened(signal)), *(steps_in(signal, c) for c in starts)]
    return max((t for t in tried if t is not None), key=lambda t: t.score, default=None)
