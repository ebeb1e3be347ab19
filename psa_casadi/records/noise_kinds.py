"""Which noise explains what a model leaves of a record: the simplest that does, by likelihood.

A residual is a sum of what follows the drive, of lines, of jumps between levels, and of noise with
a spectrum, whose innovations may have heavy tails, outliers, or a size that grows with the
reading's rate, as a clock that jitters by t makes it: s^2 + t^2 (dy/dt)^2. Each is added where it
gains more likelihood than its parameters cost by Schwarz' criterion. What follows the drive is a
misfit of the model and no noise; if it may be that, only the colour is stated.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import scipy

from psa_casadi.common.notes import Note, note
from psa_casadi.common.units import BoolArray, FloatArray, IndexArray
from psa_casadi.records.drive import dominant_line, is_mains, reversals
from psa_casadi.records.noise import (
    forgets,
    growth,
    high_frequency_noise,
    lag_products,
    local_scale,
    quantum_of,
)
from psa_casadi.records.noise_models import (
    LEAST,
    WHITE,
    Colour,
    Jumps,
    centre_of,
    colour_of,
    columns_of,
    followed,
    jumps_in,
    line_spectrum,
    period_of,
    returning,
    score,
    tones_in,
)

Kind = Literal[
    "white", "autoregressive", "one_over_f", "coloured", "telegraph", "steps", "heavy_tails",
    "outliers", "jitter", "grows", "quantised", "held", "dropped", "lines", "misfit",
]  # fmt: skip

#: Fewer samples show no kind of noise.
FEWEST = 200
#: Median filter of a robust residual, and standard deviations of what is put aside for its colour.
_WIDTH, _ASIDE = 5, 5.0
#: The residual is rounding alone if its rms is at most this many times q / sqrt(12).
_ROUNDED = 1.5


@dataclass(frozen=True)
class NoiseKind:
    """A noise by its kind, with its `figures` in SI units and the places `at` which it is.

    | kind | figures | at |
    | --- | --- | --- |
    | white | rms | |
    | autoregressive | rms, order, time of correlation [s], peak of the spectrum [Hz] if any | |
    | one_over_f | rms, slope a of f^-a, corner [Hz] above which it is white, if any | |
    | coloured | rms, time [s]: noise or misfit, which are indistinguishable here | |
    | telegraph | count of jumps, apart: the distance of the two levels | |
    | steps | count, size | the first three [s] |
    | heavy_tails | freedom: degrees of freedom of Student's t | |
    | outliers | count | the first three [s] |
    | jitter | rms [s] of the clock | |
    | grows | share of the reading that the noise has | |
    | quantised | step, rms | |
    | held | share of readings that repeat the one before, run: samples of a usual run | |
    | dropped | count of samples that an even clock lacks | |
    | lines | amplitude of the strongest | frequencies [Hz], the strongest first |
    | misfit | share of the residual's power that follows the drive | |
    """

    kind: Kind
    figures: Mapping[str, float]
    at: tuple[float, ...] = ()


@dataclass(frozen=True)
class NoiseFound:
    """The kinds of noise in what a model leaves of an output of a record, in its `unit`."""

    record: str
    output: str
    unit: str
    kinds: tuple[NoiseKind, ...]


def notes_of(noise_founds: Sequence[NoiseFound]) -> tuple[Note, ...]:
    """Return one note for each kind of noise in each output, with the figures of one record.

    White noise, and a misfit, need no word.
    """
    several = len({f.output for f in noise_founds}) > 1
    table: dict[tuple[str, str], tuple[NoiseFound, NoiseKind, list[str]]] = {}
    for f in noise_founds:
        for k in f.kinds:
            names = table.setdefault((f.output, k.kind), (f, k, []))[2]
            names.append(f"{f.output} in {f.record}" if several else f.record)
    return tuple(
        note("noise_kind", where=(*names,), unit=f.unit, kind=k.kind, figures=k.figures, at=k.at)
        for f, k, names in table.values()
        if k.kind not in ("white", "misfit")
    )


def noise_kinds(
    time: FloatArray,
    reading: FloatArray,
    predicted: FloatArray,
    inputs: Sequence[FloatArray] = (),
    used: BoolArray | None = None,
) -> tuple[NoiseKind, ...]:
    """Return the kinds of noise in reading minus prediction (n,), the simplest that explain it.

    `time` [s] and the `inputs` (n,), the one that moves most foremost, are known throughout; `used`
    (n,) are the samples that count, by default those with a reading. None of fewer than 200.
    """
    there = np.isfinite(reading) & np.isfinite(predicted)
    there = there if used is None else there & used
    if np.count_nonzero(there) < FEWEST or not np.ptp((reading - predicted)[there]) > 0.0:
        return ()
    dt = float(np.median(np.diff(time)))
    kinds = _dropped(time, dt)
    quantum = quantum_of(reading[there]) or 0.0
    again = _held(reading, predicted, there, quantum)
    there = there & ~again
    if again.any():
        share = again.sum() / (again.sum() + there.sum())
        ends = np.diff(np.flatnonzero(there), prepend=-1, append=there.size)
        kinds.append(NoiseKind("held", {"share": float(share), "run": float(np.median(ends))}))
    index = np.flatnonzero(there)
    if index.size < FEWEST:
        return tuple(kinds)
    residual = (reading - predicted)[there]
    rms = float(np.std(residual))
    if rms <= _ROUNDED * quantum / np.sqrt(12.0):
        return (*kinds, NoiseKind("quantised", {"step": quantum, "rms": rms}))
    return (*kinds, *_Residual(time, predicted, tuple(inputs), index, dt, residual).kinds())


def _dropped(time: FloatArray, dt: float) -> list[NoiseKind]:
    """Return how many samples an even clock lacks, where it lacks some."""
    steps = np.diff(time) / dt
    whole = np.round(steps)
    even = np.mean(np.abs(steps - whole) < 0.1) > 0.9 and np.mean(whole == 1.0) > 0.5
    missing = int(np.sum(whole[whole > 1.0] - 1.0))
    return [NoiseKind("dropped", {"count": float(missing)})] if even and missing else []


#: Readings are held if the share that repeats exceeds a multiple of chance, where chance does
#: not make as many as this; below this share of the range there is no noise, and no motion.
_REPEATED, _BY_CHANCE, _OFTEN, _QUIET = 0.02, 3.0, 0.1, 1e-6


def _held(
    reading: FloatArray, predicted: FloatArray, there: BoolArray, quantum: float
) -> BoolArray:
    """Return which readings repeat the one before though noise or motion should change it."""
    same = np.r_[False, np.diff(reading) == 0.0] & there
    moved = np.abs(np.diff(predicted, prepend=predicted[0]))
    noise = high_frequency_noise((reading - predicted)[there])
    if noise < _QUIET * float(np.ptp(predicted)):
        same &= moved > _QUIET * float(np.ptp(predicted))  # what rests repeats by itself
    chance = quantum / (2.0 * np.sqrt(np.pi) * max(noise, float(np.median(moved)), 1e-300))
    share = int(np.count_nonzero(same)) / max(1, int(np.count_nonzero(there)))
    held = chance < _OFTEN and share > _REPEATED + _BY_CHANCE * chance
    return same if held else np.zeros_like(same)


@dataclass(frozen=True, eq=False)
class _Residual:
    """A residual (m,) at samples `index` of the record's n, every `dt` seconds."""

    time: FloatArray
    predicted: FloatArray
    inputs: tuple[FloatArray, ...]
    index: IndexArray
    dt: float
    residual: FloatArray

    def kinds(self) -> list[NoiseKind]:
        """Return the kinds of noise."""
        flat = self.residual - np.mean(self.residual)
        robust = _robust(flat)
        jumps, misfit, colour = self._parts(robust)
        kinds = [] if jumps is None else [self._jumping(jumps)]
        left = robust - misfit - (0.0 if jumps is None else jumps.levels)
        if misfit.any():
            share = 1.0 - float(left @ left) / max(float(np.sum((left + misfit) ** 2)), 1e-300)
            kinds.append(NoiseKind("misfit", {"share": share}))
        lines, of_drive, tones = self._tones(left, has_misfit=bool(misfit.any()))
        kinds += lines
        if tones.any():
            left = left - tones
            colour = colour_of(left)
        if jumps is not None and (jumps.alternate or colour.gain < _UNDETECTED * LEAST):
            colour = WHITE
        white = colour.whitened(left)
        new = float(np.var(white) / np.var(left)) if colour.family == "autoregressive" else 1.0
        smooth = colour.figures.get("slope", 0.0) > _SMOOTH or new < _PREDICTED
        white = white + flat - robust
        is_noise = colour.is_clear and not smooth and not of_drive and self._is_noise(left, misfit)
        sure = colour is WHITE or is_noise
        figures = colour.figures if sure else {"time": forgets(lag_products(left, left.size // 2))}
        units = {"time": self.dt, "corner": 1.0 / self.dt, "peak": 1.0 / self.dt}
        figures = {name: value * units.get(name, 1.0) for name, value in figures.items()}
        kind = colour.family if sure else "coloured"
        kinds.append(NoiseKind(kind, {"rms": float(np.std(left)), **figures}))
        if jumps is not None and jumps.alternate:
            return kinds
        if jumps is not None:
            white[np.clip(jumps.places[:, None] + np.arange(-2, 2), 0, white.size - 1)] = 0.0
        return kinds + self._innovations(white, sure and jumps is None, (flat != robust) | sure)

    def _parts(self, robust: FloatArray) -> tuple[Jumps | None, FloatArray, Colour]:
        """Return jumps, what follows the drive, and the colour of the rest: the likeliest ones."""
        misfit, price, colour = self._misfit(robust)
        if colour is WHITE:
            return None, misfit, colour
        least = score(robust - misfit, colour) - price + LEAST
        jumps = jumps_in(robust)
        if jumps is None or jumps.score < least or jumps.undone or self._with_drive(jumps.places):
            return None, misfit, colour
        return jumps, *self._misfit(robust - jumps.levels)[::2]

    def _jumping(self, jumps: Jumps) -> NoiseKind:
        figures = {"count": float(jumps.places.size)}
        size = float(np.median(np.abs(jumps.sizes)))
        if jumps.alternate:
            return NoiseKind("telegraph", {**figures, "apart": size})
        return NoiseKind("steps", {**figures, "size": size}, self._times(jumps.places))

    def _misfit(self, robust: FloatArray) -> tuple[FloatArray, float, Colour]:
        """Return what of the residual follows the drive, its price, and the colour of the rest."""
        colour = colour_of(robust)
        best, highest = (np.zeros_like(robust), 0.0, colour), score(robust, colour)
        for weight in (WHITE, colour):
            misfit, price = followed(robust, self.columns, weight)
            rest_colour = colour_of(robust - misfit)
            likelihood = score(robust - misfit, rest_colour) - price
            share = 1.0 - float(np.var(robust - misfit)) / float(np.var(robust))
            if likelihood > highest + LEAST and share > 0.0:
                best, highest = (misfit, price, rest_colour), likelihood
            elif share > _MUCH and likelihood > highest - LEAST:
                best = *best[:2], replace(best[2], is_clear=False)
        if self.period is not None and best[2] is not WHITE:
            again, cost = returning(robust - best[0], self.index, self.period)
            rest_colour = colour_of(robust - best[0] - again)
            if score(robust - best[0] - again, rest_colour) - best[1] - cost > highest + LEAST:
                best = best[0] + again, best[1] + cost, rest_colour
        return best

    def _tones(
        self, left: FloatArray, *, has_misfit: bool
    ) -> tuple[list[NoiseKind], bool, FloatArray]:
        """Return the lines that are not the drive's, whether some are, and all of them (m,).

        With a misfit, only lines of the mains are certainly not the drive's.
        """
        part = slice(self.index[0], self.index[-1] + 1)
        place = self.index - self.index[0]
        even = np.zeros(int(place[-1]) + 1)
        even[place] = np.where(left == 0.0, 1e-300, left)
        tones, rest = tones_in(even)
        at, largest = list[float](), 0.0
        for tone in tones:
            hertz = tone.frequency / self.dt
            of_drive = any(self._of_drive(tone.frequency, u[part]) for u in self.inputs)
            if not of_drive and (not has_misfit or is_mains(hertz)):
                at.append(hertz)
                largest = max(largest, tone.amplitude)
        kinds = [NoiseKind("lines", {"amplitude": largest}, (*at,))] if at else []
        return kinds, len(at) < len(tones), left - rest[place]

    def _of_drive(self, frequency: float, drive: FloatArray) -> bool:
        """Whether a line may be the drive's: a line of it, or a harmonic of its strongest line."""
        power, lines = line_spectrum(drive)
        place = frequency * drive.size
        near = float(np.max(power[lines[np.abs(lines - place) <= 2.0]], initial=0.0))
        if 4.0 * np.sqrt(near) / drive.size > _LOUD * float(np.ptp(drive)):
            return True
        first = dominant_line(power)
        if first is None:
            return False
        base = drive.size / self.period if self.period else centre_of(power, first)
        wide = min(_SHARP / base, _BROAD) if self.period else _BROAD
        order = round(place / base)
        return order <= _HARMONICS and abs(place / base - order) < wide

    @cached_property
    def columns(self) -> FloatArray:
        """What a misfit may follow."""
        return columns_of([u[self.index] for u in self.inputs], self.predicted[self.index])

    @cached_property
    def period(self) -> float | None:
        """After how many samples the foremost input returns."""
        return period_of(self.inputs[0]) if self.inputs and np.ptp(self.inputs[0]) > 0.0 else None

    def _is_noise(self, left: FloatArray, misfit: FloatArray) -> bool:
        """Whether the colour cannot be the form of a misfit: there is none, or a small one.

        Or one that is no larger, and whose drive returns, so that what does not is none.
        """
        size, noise = float(np.std(misfit)), float(np.std(left))
        return size < _LITTLE * noise or (self.period is not None and noise > _FORM * size)

    def _times(self, places: IndexArray) -> tuple[float, ...]:
        """Return the times of the first three places [s]."""
        return tuple(self.time[self.index[places[:3]]].tolist())

    def _with_drive(self, places: IndexArray) -> bool:
        """Whether places sit at steps, turns, values or rates of the input, as a misfit's do.

        By the binomial distributions of how many are at the largest steps, each number's step being
        the least, and at turns, and by Pearson's chi-square test of how many lie in each eighth of
        all values.
        """
        if not self.inputs:
            return False
        values = self.inputs[0][self.index]
        largest = scipy.ndimage.maximum_filter1d(np.abs(np.diff(values, prepend=values[0])), 3)
        steps, counts = np.sort(largest[places])[::-1], np.arange(places.size)
        shares = 1.0 - np.searchsorted(np.sort(largest), steps) / largest.size
        at_steps = places.size * float(np.min(scipy.special.bdtrc(counts, places.size, shares)))
        if places.size <= _FEW:
            return at_steps < _NO_CHANCE
        turns = reversals(values, _TURN * float(np.ptp(values)))
        near = np.zeros(values.size, dtype=np.bool_)
        near[np.clip(turns[:, None] + np.arange(-_NEAR, _NEAR + 1), 0, values.size - 1)] = True
        hits = int(np.count_nonzero(near[places]))
        chances = [at_steps]
        if hits:
            at_turns = scipy.special.bdtrc(hits - 1, places.size, float(near.mean()))
            chances.append(float(at_turns))
        rate, away = np.gradient(values), np.abs(values - 0.5 * (values.min() + values.max()))
        for x in (values, away, rate, np.abs(rate)):
            bins = np.searchsorted(np.quantile(x, np.arange(1, 8) / 8.0), x)
            expected = np.bincount(bins) * (places.size / x.size)
            excess = np.bincount(bins[places], minlength=expected.size) - expected
            apart = excess[expected > 0.0] ** 2 / expected[expected > 0.0]
            chances.append(float(scipy.special.chdtrc(max(apart.size - 1, 1), apart.sum())))
        return bool(min(chances) < _NO_CHANCE)

    def _innovations(self, white: FloatArray, whole: bool, spikes: BoolArray) -> list[NoiseKind]:
        """Return what else the innovations (m,) show: size, tails, outliers among the `spikes`.

        Outliers alone where these are not the `whole` noise.
        """
        kinds, tails = list[NoiseKind](), (0.0, 0.0)
        scale = 1.4826 * float(np.median(np.abs(white[white != 0.0])))
        z = white / max(scale, 1e-300)
        if whole:
            rate = np.gradient(self.predicted, self.time)[self.index]
            jitter, grows = (_grown(z, x) for x in (rate, self.predicted[self.index]))
            gain, size, deviation = best = max(jitter, grows, key=lambda g: g[0])
            if gain > LEAST:
                kind: Kind = "jitter" if best is jitter else "grows"
                kinds.append(NoiseKind(kind, {"rms" if best is jitter else "share": size * scale}))
                z = z / deviation
            tails = _tails(z)
        gain, where = _outliers(z)
        if tails[0] > max(gain, LEAST):
            return [*kinds, NoiseKind("heavy_tails", {"freedom": tails[1]})]
        places = np.flatnonzero(where & spikes)
        if gain < LEAST or not places.size or self._with_drive(places):
            return kinds
        return [*kinds, NoiseKind("outliers", {"count": float(places.size)}, self._times(places))]


#: A drive's harmonics up to this one count as the drive, to this many of the record's resolutions,
#: or to this share of its frequency where it does not repeat; it moves where it has this share of
#: its range.
_HARMONICS, _SHARP, _BROAD, _LOUD = 40, 0.75, 0.1, 5e-3
#: A misfit of this share that is as likely as a colour leaves open which of the two it is.
_MUCH = 0.2
#: What is left of a misfit may be its form where it is smaller than this share of it; a misfit of
#: less than this share of the noise is small.
_FORM, _LITTLE = 0.5, 0.3
#: Fewer places follow nothing; the chance below which they follow the drive; samples about a turn
#: that are at it, and the share of the range by which a turn comes back.
_FEW, _NO_CHANCE, _NEAR, _TURN = 2, 1e-3, 3, 0.01
#: A spectrum that falls faster is a smooth signal's, not a noise's, and so is one of which no more
#: than this share is new in each sample.
_SMOOTH, _PREDICTED = 2.1, 0.01
#: Times the least gain below which the colour of the rest is that of undetected jumps.
_UNDETECTED = 5.0
#: Standard errors, and the share of the growth of squares, by which neighbours' products may grow.
_ERRORS, _NEIGHBOURS = 3.0, 0.2
#: Degrees of freedom that are tried, and above which tails are a normal distribution's.
_FREEDOM, _NORMAL = np.geomspace(1.2, 40.0, 12), 25.0
#: Standard deviations of an outlier, and the largest share of them among the samples.
_LARGE, _RARE = 4.5, 0.02


def _robust(flat: FloatArray) -> FloatArray:
    """Return a residual (m,) with its spikes put to the median of their neighbours."""
    middle = scipy.ndimage.median_filter(flat, _WIDTH, mode="nearest")
    away = flat - middle
    scale = 1.3 * local_scale(away)
    return np.where(np.abs(away) > _ASIDE * scale, middle, flat) if np.all(scale > 0.0) else flat


def _grown(z: FloatArray, x: FloatArray) -> tuple[float, float, FloatArray]:
    """Return how the size of innovations (m,) grows with x: variance s^2 (1 + c x^2).

    That is what it gains [nats], the size per unit, and the deviation of each sample. Neighbours do
    not grow together: a misfit at a high rate is smooth.
    """
    power = max(float(np.mean(x**2)), 1e-300)
    size, limited = x**2 / power, np.minimum(z**2, 25.0)
    ratio, gain = growth(limited, size)
    grown = 1.0 + ratio * size
    level = float(np.mean(limited / grown))
    centred, near = size - np.mean(size), np.clip(z, -5.0, 5.0)
    others = abs(float(centred[1:] @ (near[1:] * near[:-1])))
    error = float(np.std(limited) * np.linalg.norm(centred))
    if others > _NEIGHBOURS * float(centred @ limited) + _ERRORS * error:
        gain = 0.0
    each = float(np.sqrt(ratio * level / power))
    return gain - 0.5 * float(np.log(z.size)), each, np.sqrt(level * grown)


def _tails(z: FloatArray) -> tuple[float, float]:
    """Return what Student's t gains over a normal distribution, and its degrees of freedom.

    Its scale is that of the median: half of the samples are within it.
    """
    n, tried = z.size, list[tuple[float, float]]()
    for nu in _FREEDOM:
        scale = float(np.median(np.abs(z))) / scipy.special.stdtrit(nu, 0.75)
        each = scipy.special.gammaln([0.5 * (nu + 1.0), 0.5 * nu]) @ [1.0, -1.0]
        each -= 0.5 * np.log(nu * np.pi) + np.log(scale)
        far = float(np.sum(np.log1p((z / scale) ** 2 / nu)))
        tried.append((float(n * each - 0.5 * (nu + 1.0) * far), float(nu)))
    likely, freedom = max(tried)
    normal = -0.5 * n * (float(np.log(2.0 * np.pi * np.mean(z**2))) + 1.0)
    gain = likely - normal - 0.5 * float(np.log(n))
    return (gain, freedom) if freedom < _NORMAL else (0.0, 0.0)


def _outliers(z: FloatArray) -> tuple[float, BoolArray]:
    """Return what outliers among innovations gain [nats], and where they are, (m,).

    A rare part of them has another variance; compared with one normal distribution.
    """
    where = np.abs(z) > _LARGE * 1.4826 * float(np.median(np.abs(z)))
    if not 0.0 < np.mean(where) <= _RARE:
        return 0.0, where
    gain = 0.5 * z.size * float(np.log(np.mean(z**2))) - float(np.log(z.size))
    for part in (z[where], z[~where]):
        gain += part.size * float(np.log(part.size / z.size) - 0.5 * np.log(np.mean(part**2)))
    return gain, where
