"""The spectrum of a residual with its noise floor, and the lines that stand out of it."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from psa_casadi.diagnosis.noise import NoiseFloor
from psa_casadi.records.record import Record

FloatArray = npt.NDArray[np.float64]
IndexArray = npt.NDArray[np.int64]

#: Points of the spectrum that are kept; lines that are listed.
_POINTS, LINES = 300, 6
#: A line is one that noise would show in one of so many records.
_CHANCE = 1e-4
#: The lowest frequency [1/duration] at which a line can be told from drift; widest surroundings.
_LOWEST, _WIDEST = 8, 64
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
    noise = _floor_density(floor, f, record.sample_time)
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
    peaks, around = _peaks(power)
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


def _peaks(power: FloatArray) -> tuple[IndexArray, FloatArray]:
    """Return where a line stands out of its surroundings, and the mean power of those (n,).

    Powers of noise are exponentially distributed, their median ln 2 times their mean.
    """
    edges = [_LOWEST]
    while edges[-1] < power.size:
        edges.append(edges[-1] + int(np.clip(edges[-1], _LOWEST, _WIDEST)))
    if len(edges) < 3:
        return np.zeros(0, dtype=np.int64), np.zeros_like(power)
    edges = [*edges[:-2], power.size]
    level = np.array([np.median(power[a:b]) for a, b in pairwise(edges)])
    centres = 0.5 * (np.array(edges[:-1]) + np.array(edges[1:]))
    around = np.interp(np.arange(power.size), centres, level / np.log(2.0))
    # neighbouring powers of a window share noise, and a median of few is uncertain
    limit = 1.4 * around * (np.log(power.size) - np.log(_CHANCE))
    inner = np.arange(max(_LOWEST, 3), power.size - 3)
    highest = np.max([power[inner + d] for d in (-3, -2, -1, 1, 2, 3)], axis=0)
    found = inner[(power[inner] > limit[inner]) & (power[inner] > highest)]
    return found[np.argsort(-power[found])[: 4 * LINES]], around


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


def _floor_density(floor: NoiseFloor, frequency: FloatArray, step: float) -> FloatArray:
    """Return the density of the noise from its autocovariance, faded out after Bartlett."""
    lags = np.arange(floor.autocovariance.size)
    faded = floor.autocovariance * (1.0 - lags / lags.size) * np.where(lags > 0, 2.0, 1.0)
    power = np.cos(2.0 * np.pi * np.outer(frequency * step, lags)) @ faded
    return np.sqrt(np.maximum(2.0 * step * power, 0.0))
