"""Which spectrum a noise has: white, autoregressive or falling with a power of the frequency.

All are compared by Whittle's likelihood of one periodogram I_j = |E_j|^2 / n, less the price of
Schwarz' criterion for k parameters,

    L = -sum_j (ln S_j + I_j / S_j) - k/2 ln n,

and lines, which no smooth spectrum has, are removed before. Frequencies are in cycles per sample.

Source: Whittle, Arkiv foer Matematik 2 (1953) 423; Schwarz, Annals of Statistics 6 (1978) 461.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np
import scipy

from psa_casadi.records.noise import filtered, forgets, lines_in
from psa_casadi.records.repeats import autoregression_of
from psa_casadi.units import FloatArray, IndexArray

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
