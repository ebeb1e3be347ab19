"""Which spectrum a noise has: white, autoregressive or falling with a power of the frequency.

All are compared by Whittle's likelihood of one periodogram I_j = |E_j|^2 / n, less the price of
Schwarz' criterion for k parameters,

    L = -sum_j (ln S_j + I_j / S_j) - k/2 ln n,

and lines, which no smooth spectrum has, are found before. Frequencies are in cycles per sample.

Source: Whittle, Arkiv foer Matematik 2 (1953) 423; Schwarz, Annals of Statistics 6 (1978) 461.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Literal

import numpy as np
import numpy.typing as npt
import scipy

from psa_casadi.records.noise import filtered, lag_products
from psa_casadi.records.repeats import autoregression
from psa_casadi.units import FloatArray

#: A spectrum's shape by the name of its family.
Family = Literal["white", "autoregressive", "one_over_f"]
#: Bins of a periodogram: each is so many times narrower than its frequency, and has so many lines
#: at most.
_NARROW, _WIDEST = 12, 48
#: Orders of the autoregression tried, and lags of the filter that whitens any spectrum.
_ORDER, _FILTER = 8, 24
#: A family must gain so many nats over white noise; families nearer than this cannot be told apart.
LEAST, NEAR = 5.0, 3.0
#: Rounds in which two parameters of a shape are sought, in so many steps each; each round is within
#: a step of the one before.
_ROUNDS, _STEPS = 3, 9
#: What forgets within no less than this part of a signal cannot be told from a walk.
_WANDERS = 50


@dataclass(frozen=True, eq=False)
class Colour:
    """A spectrum S(f): its family, what it gains over white noise [nats], and its shape.

    `figures` are the order and the correlation time [samples] of an autoregression, or the slope a
    of f^-a and the corner [cycles per sample] at which white noise is as large. `told` is False
    where another family is as likely. `density` gives the shape of S at frequencies (m,).
    """

    family: Family
    gain: float
    figures: Mapping[str, float]
    density: Callable[[FloatArray], FloatArray]
    told: bool = True

    def whitened(self, signal: FloatArray) -> FloatArray:
        """Return a signal (n,) through the filter of order 24 that makes this noise white."""
        if self.family == "white":
            return signal
        white = filtered(self.filter(signal.size), [1.0], signal)
        white[:_FILTER] = 0.0  # nothing is known before
        return white

    def filter(self, n: int) -> FloatArray:
        """Return the coefficients (25,) of the filter that makes noise of n samples white."""
        covariance = self.covariance(n)[: _FILTER + 1]
        a = scipy.linalg.solve_toeplitz(covariance[:-1], covariance[1:])
        return np.asarray(np.r_[1.0, -a])

    def covariance(self, n: int) -> FloatArray:
        """Return the shape of the autocovariance (n,) that belongs to the spectrum."""
        shape = self.density(np.maximum(np.arange(n // 2 + 1), 1) / n)
        found: FloatArray = scipy.fft.irfft(shape, n)
        return found


@dataclass(frozen=True, eq=False)
class Periodogram:
    """Means `power` (b,) of a periodogram over bins of `count` lines each about `frequency`."""

    n: int
    frequency: FloatArray
    power: FloatArray
    count: FloatArray

    def likelihood(self, shape: FloatArray, parameters: int) -> FloatArray:
        """Return L of shapes (..., b), each at the level that suits it best."""
        lines = float(np.sum(self.count))
        level = (self.power / shape) @ self.count / lines
        price = 0.5 * parameters * float(np.log(self.n))
        found: FloatArray = -np.log(shape) @ self.count - lines * (np.log(level) + 1.0) - price
        return found


def straightened(signal: FloatArray) -> FloatArray:
    """Return a signal (n,) without its mean and trend."""
    t = np.linspace(-1.0, 1.0, signal.size)
    centred = signal - np.mean(signal)
    left: FloatArray = centred - t * (t @ centred) / (t @ t)
    return left


def periodogram(signal: FloatArray) -> Periodogram:
    """Return the binned periodogram of a signal (n,) without its mean and trend."""
    n = scipy.fft.prev_fast_len(signal.size, real=True)
    power = np.abs(scipy.fft.rfft(straightened(signal[:n]))) ** 2 / n
    edges = _edges((n + 1) // 2)
    count = np.diff(edges).astype(np.float64)
    means = np.add.reduceat(power[: edges[-1]], edges[:-1]) / count
    centre = 0.5 * (edges[:-1] + edges[1:] - 1) / n
    return Periodogram(n, centre, np.maximum(means, 1e-300), count)


@lru_cache(maxsize=32)
def _edges(stop: int) -> npt.NDArray[np.intp]:
    edges = [1]
    while edges[-1] < stop:
        edges.append(min(stop, edges[-1] + int(np.clip(edges[-1] // _NARROW, 1, _WIDEST))))
    return np.array(edges, dtype=np.intp)


def _white(frequency: FloatArray) -> FloatArray:
    return np.ones_like(frequency)


WHITE = Colour("white", 0.0, {}, _white)


def score(signal: FloatArray, colour: Colour) -> float:
    """Return L of a signal (n,) with a colour, up to a constant of n alone."""
    return colour.gain - 0.5 * signal.size * float(
        np.log(max(float(np.var(straightened(signal))), 1e-300))
    )


def colour_of(signal: FloatArray) -> Colour:
    """Return the simplest spectrum that explains a signal (n,), by the criterion above.

    Families: white; autoregressive of order 1 to 8, or of first order on white noise; f^-a, alone
    or on white noise. One that cannot be told from the best one of another family is not `told`.
    """
    seen = periodogram(signal)
    white = float(seen.likelihood(np.ones_like(seen.frequency), 0))
    found = [f for f in (_autoregressive(seen, signal), _lag(seen), _power(seen)) if f is not None]
    best = max(found, key=lambda f: f[0])
    if best[0] - white < LEAST:
        return WHITE
    power = next(f for f in found if f[1] == "one_over_f")
    if best[2].get("samples", 0.0) > signal.size / _WANDERS and power[0] > best[0] - NEAR:
        best, found = power, [power]  # what forgets so slowly has a spectrum of f^-2
    other = max((f[0] for f in found if f[1] != best[1]), default=-np.inf)
    gain, family, figures, density = best
    return Colour(family, gain - white, figures, density, told=bool(gain - other > NEAR))


_Found = tuple[float, Family, dict[str, float], Callable[[FloatArray], FloatArray]]


def _autoregressive(seen: Periodogram, signal: FloatArray) -> _Found | None:
    flat = straightened(signal)
    a = autoregression(lag_products(flat, _ORDER + 1) / flat.size, flat.size)
    if not a.size:
        return None

    def density(f: FloatArray) -> FloatArray:
        turn = np.polyval(np.r_[-a[::-1], 1.0], np.exp(-2j * np.pi * f))
        found: FloatArray = 1.0 / np.maximum(np.abs(turn) ** 2, 1e-12)
        return found

    colour = Colour("autoregressive", 0.0, {}, density)
    covariance = colour.covariance(flat.size)
    figures = {"order": float(a.size), "samples": _forgets(covariance / covariance[0])}
    f = np.linspace(0.5 / flat.size, 0.5, 1024)
    peak = int(np.argmax(density(f)))
    if 0 < peak < f.size - 1:
        figures["peak"] = float(f[peak])
    gain = float(seen.likelihood(density(seen.frequency), a.size))
    return gain, "autoregressive", figures, density


def _forgets(correlation: FloatArray) -> float:
    """Return the lag from which on correlations (n,) stay below 1/e in size."""
    above = np.flatnonzero(np.abs(correlation[: correlation.size // 2]) > np.exp(-1.0))
    last = int(above[-1]) if above.size else 0
    high, low = abs(float(correlation[last])), abs(float(correlation[last + 1]))
    return last + (high - float(np.exp(-1.0))) / max(high - low, 1e-300)


def _lag(seen: Periodogram) -> _Found:
    """First-order autoregression on white noise: 1 + c / |1 - r z|^2, c over its largest."""

    def shape(memory: FloatArray, size: FloatArray, f: FloatArray) -> FloatArray:
        r = np.exp(-np.exp(-memory))
        low = (1.0 - r) ** 2
        found: FloatArray = 1.0 + np.exp(size) * low / (low + 4.0 * r * np.sin(np.pi * f) ** 2)
        return found

    longest = np.log(seen.n / 4.0)
    memory, size, gain = _sought(seen, shape, (-0.7, longest), (-3.0, 14.0))
    return (
        gain,
        "autoregressive",
        {"order": 1.0, "samples": float(np.exp(memory))},
        lambda f: shape(np.asarray(memory), np.asarray(size), f),
    )


#: Slopes of spectra that are sought; beyond the highest one the signal is smooth.
_SLOPES = (0.4, 2.6)


def _power(seen: Periodogram) -> _Found:
    """Spectrum 1 + (corner / f)^a; the corner may lie beyond all frequencies."""

    def shape(slope: FloatArray, corner: FloatArray, f: FloatArray) -> FloatArray:
        found: FloatArray = 1.0 + np.exp(slope * (corner - np.log(f)))
        return found

    slope, corner, gain = _sought(seen, shape, _SLOPES, (-np.log(seen.n), 4.0))
    pure = float(np.log(0.5)) < corner - 1.0
    gain += 0.5 * float(np.log(seen.n)) * pure
    return (
        gain,
        "one_over_f",
        {"slope": float(slope), **({} if pure else {"corner": float(np.exp(corner))})},
        lambda f: shape(np.asarray(slope), np.asarray(corner), f),
    )


def _sought(
    seen: Periodogram,
    shape: Callable[[FloatArray, FloatArray, FloatArray], FloatArray],
    first: tuple[float, float],
    second: tuple[float, float],
) -> tuple[float, float, float]:
    """Return the two parameters of the likeliest shape within their ranges, and its L."""
    ranges = [first, second]
    best, gain = (0.0, 0.0), -np.inf
    for _ in range(_ROUNDS):
        grids = [np.linspace(*r, _STEPS) for r in ranges]
        each = shape(grids[0][:, None, None], grids[1][None, :, None], seen.frequency)
        values = seen.likelihood(each, 2)
        i, j = np.unravel_index(int(np.argmax(values)), values.shape)
        best, gain = (float(grids[0][i]), float(grids[1][j])), float(values[i, j])
        widths = [(r[1] - r[0]) / (_STEPS - 1) for r in ranges]
        ranges = [(b - w, b + w) for b, w in zip(best, widths, strict=True)]
    return best[0], best[1], gain


@dataclass(frozen=True)
class Tone:
    """A line: frequency [cycles per sample] and amplitude in the signal's unit."""

    frequency: float
    amplitude: float


#: Lines that are sought at most; the lowest one, in periods of the record.
_MOST, _LOWEST = 6, 8
#: Nats beyond ln of the lines' number that a line must exceed its surroundings by: noise does it in
#: one of 20,000 records.
_CHANCE = 10.0
#: Lines to either side that belong to a tone under Hann's window, and that are its surroundings.
_OWN, _AROUND = 3, 12
#: Ratio of the edges of the bands in which the median is the background, and fewest lines of one.
_BAND, _FEWEST = 1.25, 24


def tones_in(signal: FloatArray) -> tuple[list[Tone], FloatArray]:
    """Return the tones in a signal (n,), 0 where there is none, and the signal without them.

    Each is fitted by least squares at its likeliest frequency, and the strongest is taken off
    before the next one is sought.
    """
    left, found = signal.copy(), list[Tone]()
    there = signal != 0.0
    index = np.arange(signal.size, dtype=np.float64)
    while len(found) < _MOST:
        frequency = _strongest(left)
        if frequency is None:
            break
        for _ in range(2):  # Gauss and Newton: d/df of a cos + b sin is -2 pi k (a sin - b cos)
            a, b, step = _fitted_tone(left, index, frequency, there)
            frequency += step
        turn = 2.0 * np.pi * frequency * index
        left = left - (a * np.cos(turn) + b * np.sin(turn)) * there
        found.append(Tone(float(frequency), float(np.hypot(a, b))))
    return found, left


def _fitted_tone(
    signal: FloatArray, index: FloatArray, frequency: float, there: FloatArray
) -> tuple[float, float, float]:
    """Return a and b of a cos + b sin, and by how much the frequency should move."""
    turn = 2.0 * np.pi * frequency * index
    pair = np.column_stack([np.cos(turn), np.sin(turn)]) * there[:, None]
    a, b = np.linalg.solve(pair.T @ pair, pair.T @ signal)
    slope = 2.0 * np.pi * (index - np.mean(index)) * (b * pair[:, 0] - a * pair[:, 1])
    columns = np.column_stack([pair, slope])
    _, _, step = np.linalg.solve(columns.T @ columns, columns.T @ signal)
    return float(a), float(b), float(np.clip(step, -0.5 / signal.size, 0.5 / signal.size))


def _strongest(signal: FloatArray) -> float | None:
    """Return the frequency of the line that stands out most, None where none does."""
    n = scipy.fft.prev_fast_len(signal.size, real=True)
    power = np.abs(scipy.fft.rfft((signal[:n] - np.mean(signal[:n])) * np.hanning(n))) ** 2
    if power.size < 4 * _AROUND or not np.any(power > 0):
        return None
    ratio = power / np.maximum(_background(power), 1e-300)
    least = float(np.log(power.size)) + _CHANCE
    ratio[:_LOWEST] = 0.0
    ratio[-_OWN:] = 0.0
    for k in np.flatnonzero(ratio > least)[np.argsort(-ratio[ratio > least], kind="stable")]:
        near = np.r_[power[max(0, k - _AROUND) : k - _OWN], power[k + _OWN + 1 : k + _AROUND + 1]]
        if power[k] < least * float(np.median(near)) / np.log(2.0):
            continue
        if power[k] < max(power[k - 1], power[k + 1]):
            continue
        side = np.log(np.maximum(power[k - 1 : k + 2], 1e-300))
        return float(k + 0.5 * (side[0] - side[2]) / (side[0] - 2.0 * side[1] + side[2])) / n
    return None


def _background(power: FloatArray) -> FloatArray:
    """Return the smooth part of a periodogram (m,): medians of bands, over ln 2, between them."""
    edges, places, levels = [1], list[float](), list[float]()
    while edges[-1] < power.size:
        edges.append(min(power.size, edges[-1] + max(_FEWEST, int((_BAND - 1.0) * edges[-1]))))
    for start, stop in pairwise(edges):
        places.append(0.5 * (start + stop - 1))
        levels.append(float(np.median(power[start:stop])) / float(np.log(2.0)))
    found: FloatArray = np.interp(np.arange(power.size), places, levels)
    return found
