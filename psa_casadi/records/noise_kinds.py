"""Which noise explains what a model leaves of a record: the simplest that does, by likelihood.

A residual is a sum of what follows the drive, of lines, of jumps between levels, and of noise with
a spectrum, whose innovations may have heavy tails, outliers, or a size that grows with the
reading's rate, as a clock that jitters by t makes it: s^2 + t^2 (dy/dt)^2. Each is added where it
gains more likelihood than its parameters cost by Schwarz' criterion. What follows the drive is a
misfit of the model and no noise; where it may be that, only the colour is said.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import numpy.typing as npt
import scipy

from psa_casadi.notes import Note, note
from psa_casadi.records.drive import reversals
from psa_casadi.records.driven import (
    Columns,
    columns_of,
    followed,
    period_of,
    price_of_return,
    returning,
)
from psa_casadi.records.jumps import Jumps, alternates, jumps_on, steps_in, two_levels
from psa_casadi.records.noise import high_frequency_noise, local_scale, quantum_of
from psa_casadi.records.noise_spectra import (
    LEAST,
    WHITE,
    Colour,
    Tone,
    colour_of,
    score,
    straightened,
    tones_in,
)
from psa_casadi.units import FloatArray

BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]
Kind = Literal[
    "white", "autoregressive", "one_over_f", "coloured", "telegraph", "steps", "heavy_tails",
    "outliers", "jitter", "grows", "quantised", "held", "dropped", "lines", "misfit",
]  # fmt: skip

#: Fewer samples show no kind of noise.
FEWEST = 200
#: Median filter of a robust residual, and standard deviations of what is put aside for its colour.
_WIDTH, _ASIDE = 5, 5.0
#: Rounding is all that is seen where the residual is at most so many times q / sqrt(12).
_ROUNDED = 1.5


@dataclass(frozen=True)
class NoiseKind:
    """A noise by its kind, with its `figures` in SI units and the places `at` which it is.

    | kind | figures | at |
    | --- | --- | --- |
    | white | rms | |
    | autoregressive | rms, order, time of correlation [s], peak of the spectrum [Hz] if any | |
    | one_over_f | rms, slope a of f^-a, corner [Hz] above which it is white, if any | |
    | coloured | rms, time [s]: noise or misfit, which of them is not told | |
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


def notes_of(found: Sequence[NoiseFound]) -> tuple[Note, ...]:
    """Return what is said of noises, one note for each kind in each output, the figures of one.

    White noise, and a misfit, need no word.
    """
    several = len({f.output for f in found}) > 1
    told: dict[tuple[str, str], tuple[NoiseFound, NoiseKind, list[str]]] = {}
    for f in found:
        for k in f.kinds:
            names = told.setdefault((f.output, k.kind), (f, k, []))[2]
            names.append(f"{f.output} in {f.record}" if several else f.record)
    return tuple(
        note("noise_kind", where=(*names,), unit=f.unit, kind=k.kind, figures=k.figures, at=k.at)
        for f, k, names in told.values()
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
    found = _dropped(time, dt)
    noise = high_frequency_noise((reading - predicted)[there])
    quantum = quantum_of(reading[there])
    again = _held(reading, predicted, there, noise, quantum)
    if again.any():
        found.append(_of_runs(again, there))
        there = there & ~again
    index = np.flatnonzero(there)
    if index.size < FEWEST:
        return tuple(found)
    residual = (reading - predicted)[there]
    rounding = (quantum or 0.0) / float(np.sqrt(12.0))
    rms = float(np.std(residual))
    if rms <= _ROUNDED * rounding:
        figures = {"step": quantum or 0.0, "rms": rms}
        return (*found, NoiseKind("quantised", figures))
    seen = _Seen(time, predicted, tuple(inputs), index, dt, residual)
    return (*found, *seen.kinds())


def _dropped(time: FloatArray, dt: float) -> list[NoiseKind]:
    """Return how many samples an even clock lacks, where it lacks some."""
    steps = np.diff(time) / dt
    whole = np.round(steps)
    even = np.mean(np.abs(steps - whole) < 0.1) > 0.9 and np.mean(whole == 1.0) > 0.5
    missing = int(np.sum(whole[whole > 1.0] - 1.0))
    return [NoiseKind("dropped", {"count": float(missing)})] if even and missing else []


#: Readings that repeat beyond so many times chance by this share of all are held, where chance does
#: not make as many as this; below this share of the range there is no noise, and no motion.
_REPEATED, _BY_CHANCE, _OFTEN, _QUIET = 0.02, 3.0, 0.1, 1e-6


def _held(
    reading: FloatArray,
    predicted: FloatArray,
    there: BoolArray,
    noise: float,
    quantum: float | None,
) -> BoolArray:
    """Return which readings repeat the one before though noise or motion should change it."""
    same = np.r_[False, np.diff(reading) == 0.0] & there
    moved = np.abs(np.diff(predicted, prepend=predicted[0]))
    if noise < _QUIET * float(np.ptp(predicted)):
        same &= moved > _QUIET * float(np.ptp(predicted))  # what rests repeats by itself
    chance = (quantum or 0.0) / (2.0 * np.sqrt(np.pi) * max(noise, float(np.median(moved)), 1e-300))
    share = int(np.count_nonzero(same)) / max(1, int(np.count_nonzero(there)))
    held = chance < _OFTEN and share > _REPEATED + _BY_CHANCE * chance
    return same if held else np.zeros_like(same)


def _of_runs(again: BoolArray, there: BoolArray) -> NoiseKind:
    starts = np.flatnonzero(there & ~again)
    run = float(np.median(np.diff(starts))) if starts.size > 1 else 1.0
    return NoiseKind("held", {"share": float(again.sum() / there.sum()), "run": run})


@dataclass(frozen=True, eq=False)
class _Seen:
    """A residual (m,) at samples `index` of the record's n, every `dt` seconds."""

    time: FloatArray
    predicted: FloatArray
    inputs: tuple[FloatArray, ...]
    index: IntArray
    dt: float
    residual: FloatArray

    def kinds(self) -> list[NoiseKind]:
        """Return the kinds of noise."""
        flat = self.residual - np.mean(self.residual)
        robust = _robust(flat)
        jumps, misfit, colour = self._parts(robust)
        steps = np.zeros_like(flat) if jumps is None else jumps[1].levels
        left = robust - steps - misfit
        found = [] if jumps is None else [jumps[0]]
        if misfit.any():
            share = 1.0 - float(left @ left) / max(float(np.sum((left + misfit) ** 2)), 1e-300)
            found.append(NoiseKind("misfit", {"share": share}))
        tones, of_drive, gone = self._tones(left, bool(misfit.any()))
        if tones or of_drive:
            left = left - gone
            colour = colour_of(left)
        if jumps is not None and (jumps[0].kind == "telegraph" or colour.gain < _SLIGHT * LEAST):
            colour = WHITE
        if tones:
            tones.sort(key=lambda t: -t.amplitude)
            at = tuple(t.frequency / self.dt for t in tones)
            found.append(NoiseKind("lines", {"amplitude": tones[0].amplitude}, at))
        smooth = colour.figures.get("slope", 0.0) > _SMOOTH
        white = colour.whitened(flat - steps - misfit - gone)
        if colour.family == "autoregressive":
            smooth = float(np.var(_robust(white))) < _PREDICTED * float(np.var(left))
        told = colour.told and not (smooth or of_drive)
        sure = colour is WHITE or (told and self._is_noise(left, misfit))
        found.append(self._coloured(colour, left) if sure else self._only_coloured(left))
        kept = np.ones(white.size, dtype=np.bool_)
        if jumps is not None:
            kept[np.clip(jumps[1].places[:, None] + np.arange(-2, 2), 0, white.size - 1)] = False
        white = np.where(kept, white, 0.0)
        scale = 1.4826 * float(np.median(np.abs(white[kept])))
        if jumps is not None and jumps[0].kind == "telegraph":
            return found
        whole = sure and jumps is None
        spikes = None if sure else flat != robust
        return found + self._innovations(white / max(scale, 1e-300), scale, whole, spikes)

    def _parts(
        self, robust: FloatArray
    ) -> tuple[tuple[NoiseKind, Jumps] | None, FloatArray, Colour]:
        """Return jumps, what follows the drive, and the colour of the rest: the likeliest ones."""
        colour = colour_of(robust)
        misfit, price, own = self._misfit(robust, colour)
        if own is WHITE:
            return None, misfit, own
        jumps = self._jumps(robust, score(robust - misfit, own) - price, colour)
        if jumps is not None:
            rest = robust - jumps[1].levels
            other, _, colour = self._misfit(rest, colour_of(rest))
            if jumps[1].sharp or colour.gain < _SLIGHT * LEAST or not other.any():
                return jumps, other, colour
        jumps = self._jumps(robust - misfit, score(robust - misfit, own), own) if price else None
        if jumps is not None:
            colour = colour_of(robust - misfit - jumps[1].levels)
            if colour.gain < _SLIGHT * LEAST:
                return jumps, misfit, colour
        return None, misfit, own

    def _misfit(self, robust: FloatArray, colour: Colour) -> tuple[FloatArray, float, Colour]:
        """Return what of the residual follows the drive, its price, and the colour of the rest."""
        columns = self.columns
        best = np.zeros_like(robust), 0.0, colour
        highest, weights = score(robust, colour), [colour, *([] if colour is WHITE else [WHITE])]
        while weights:
            misfit, price = followed(robust, columns, weights.pop())
            own = colour_of(robust - misfit) if price else colour
            value = score(robust - misfit, own) - price
            share = 1.0 - float(np.var(robust - misfit)) / float(np.var(robust))
            if share > _MUCH and highest - LEAST < value <= highest + LEAST:
                best = best[0], best[1], replace(best[2], told=False)
            if value > highest + LEAST and share > 0.0:
                best, highest = (misfit, price, own), value
                weights += [own] if len(weights) < 1 and own is not WHITE else []
        if self.period is not None and best[2] is not WHITE:
            misfit = best[0] + returning(robust - best[0], self.index, self.period)
            price = best[1] + price_of_return(robust.size)
            own = colour_of(robust - misfit)
            if score(robust - misfit, own) - price > highest + LEAST:
                best = misfit, price, own
        return best

    def _tones(self, left: FloatArray, of_misfit: bool) -> tuple[list[Tone], bool, FloatArray]:
        """Return the lines that are not the drive's, whether some are, and all of them (m,).

        Beside a misfit only those of the mains are known not to be the drive's.
        """
        even = np.zeros(int(self.index[-1] - self.index[0]) + 1)
        place = self.index - self.index[0]
        even[place] = np.where(left == 0.0, 1e-300, left)
        found, rest = tones_in(even)
        if not found:
            return [], False, np.zeros_like(left)
        part = slice(self.index[0], self.index[-1] + 1)
        own = [any(self._of_drive(t.frequency, u[part]) for u in self.inputs) for t in found]
        tones = [
            t for t, o in zip(found, own, strict=True)
            if not o and (not of_misfit or _is_mains(t.frequency / self.dt))
        ]  # fmt: skip
        return tones, len(tones) < len(found), left - rest[place]

    def _of_drive(self, frequency: float, drive: FloatArray) -> bool:
        """Whether a line may be the drive's: a line of it, or a harmonic of its strongest line."""
        power = np.abs(scipy.fft.rfft((drive - np.mean(drive)) * np.hanning(drive.size))) ** 2
        k, n = round(frequency * drive.size), drive.size
        near = power[max(1, k - 2) : k + 3]
        around = np.r_[power[max(1, k - 16) : max(1, k - 3)], power[k + 4 : k + 17]]
        loud = 4.0 * np.sqrt(near.max(initial=0.0)) / n > _LOUD * float(np.ptp(drive))
        if loud and near.max(initial=0.0) > _LINE * float(np.median(around)):
            return True
        first = int(np.argmax(power))
        line = slice(max(1, first - 5), first + 6)
        if float(np.sum(power[line])) < _DOMINANT * float(power.sum()) or first < 2:
            return False
        places = np.arange(power.size)[line]
        centre = float(np.average(places, weights=power[line]))
        own = n / self.period if self.period else centre
        order = frequency * n / own
        wide = _SHARP / own if self.period else _BROAD
        return round(order) <= _HARMONICS and abs(order - round(order)) < min(wide, _BROAD)

    @cached_property
    def columns(self) -> Columns:
        """What a misfit may follow."""
        return columns_of([u[self.index] for u in self.inputs], self.predicted[self.index])

    @cached_property
    def period(self) -> float | None:
        """After how many samples the foremost input returns."""
        return period_of(self.inputs[0]) if self.inputs and np.ptp(self.inputs[0]) > 0.0 else None

    def _is_noise(self, left: FloatArray, misfit: FloatArray) -> bool:
        """Whether what is coloured cannot be a misfit's form: there is none, or a slight one.

        Or one that is no larger, and whose drive returns, so that what does not is none.
        """
        size, noise = float(np.std(misfit)), float(np.std(left))
        return size < _LITTLE * noise or (self.period is not None and noise > _FORM * size)

    def _jumps(
        self, left: FloatArray, least: float, colour: Colour
    ) -> tuple[NoiseKind, Jumps] | None:
        """Return the jumps whose score exceeds the `least`, if they do not follow the drive."""
        white = -0.5 * left.size * float(np.log(max(float(np.var(left)), 1e-300)))
        tried: list[tuple[Kind, Jumps]] = []
        two = two_levels(straightened(left))
        if two is not None and two.places.size > _FEW:
            more = colour_of(left - two.levels).gain + score(left, WHITE) - white
            tried.append(("telegraph", replace(two, gain=two.gain + more, sharp=True)))
        steps = steps_in(left)
        if steps is not None:
            more = colour_of(left - steps.levels).gain
            tried.append((_kind_of(steps), replace(steps, gain=steps.gain + more)))
        tried = [t for t in tried if white + t[1].gain > least + LEAST]
        on = None if tried or colour is WHITE else jumps_on(left, colour)
        if on is not None and white + on.gain > least + LEAST:
            tried.append((_kind_of(on), on))
        if not tried:
            return None
        kind, best = max(tried, key=lambda pair: pair[1].gain)
        if self._with_drive(best.places):
            return None
        figures = {"count": float(best.places.size)}
        figures["size" if kind == "steps" else "apart"] = best.apart
        at = self._times(best.places) if kind == "steps" else ()
        return NoiseKind(kind, figures, at), best

    def _times(self, places: IntArray) -> tuple[float, ...]:
        """Return the times of the first three places [s]."""
        return tuple(self.time[self.index[places[:3]]].tolist())

    def _with_drive(self, places: IntArray) -> bool:
        """Whether places sit at turns, values or rates of the input, as a misfit's do.

        By the binomial distribution of how many are at turns, and the two-sample test of Kolmogorov
        and Smirnov in its asymptotic form.
        """
        if not self.inputs or places.size < _FEW:
            return False
        values = self.inputs[0][self.index]
        span = float(np.ptp(values))
        turns = reversals(values, _TURN * span) if span > 0.0 else np.zeros(0, np.int64)
        near = np.zeros(values.size, dtype=np.bool_)
        near[np.clip(turns[:, None] + np.arange(-_NEAR, _NEAR + 1), 0, values.size - 1)] = True
        hits = int(np.count_nonzero(near[places]))
        if hits and scipy.special.bdtrc(hits - 1, places.size, float(near.mean())) < _NO_CHANCE:
            return True
        rate, middle = np.gradient(values), 0.5 * float(values.min() + values.max())
        return any(
            _unlike(x[places], x) for x in (values, np.abs(values - middle), rate, np.abs(rate))
        )

    def _coloured(self, colour: Colour, left: FloatArray) -> NoiseKind:
        figures = {"rms": float(np.std(left))}
        for name, value in colour.figures.items():
            if name == "samples":
                figures["time"] = value * self.dt
            elif name in ("corner", "peak"):
                figures[name] = value / self.dt
            else:
                figures[name] = value
        return NoiseKind(colour.family, figures)

    def _only_coloured(self, left: FloatArray) -> NoiseKind:
        n = left.size
        products = scipy.fft.irfft(np.abs(scipy.fft.rfft(left, 2 * n)) ** 2, 2 * n)[: n // 2]
        below = np.flatnonzero(products < products[0] / np.e)
        lag = int(below[0]) if below.size else products.size
        return NoiseKind("coloured", {"rms": float(np.std(left)), "time": lag * self.dt})

    def _innovations(
        self, z: FloatArray, scale: float, sure: bool, spikes: BoolArray | None
    ) -> list[NoiseKind]:
        """Return what else the innovations z (m,) over their scale show: size, tails, outliers.

        Where it is not `sure` that they are noise, outliers alone; of given `spikes`, only these.
        """
        rate = np.gradient(self.predicted, self.time)[self.index]
        reading = self.predicted[self.index]
        sizes: list[tuple[Kind, FloatArray]] = [("jitter", rate), ("grows", reading)]
        found = list[NoiseKind]()
        grown = [] if not sure else [g for k, x in sizes if (g := _grown(z, k, x)) is not None]
        if grown:
            best = max(grown, key=lambda g: g.gain)
            name = "rms" if best.kind == "jitter" else "share"
            found.append(NoiseKind(best.kind, {name: best.size * scale}))
            z = z / best.deviation
        tails, outliers = _tails(z), _outliers(z)
        if tails is not None and sure and tails[0] > (outliers.gain if outliers else 0.0):
            return [*found, NoiseKind("heavy_tails", {"freedom": tails[1]})]
        if outliers is None:
            return found
        places = np.flatnonzero(outliers.where if spikes is None else outliers.where & spikes)
        if not places.size or self._with_drive(places):
            return found
        return [*found, NoiseKind("outliers", {"count": float(places.size)}, self._times(places))]


#: A drive's harmonics up to this one are its own, to this many of the record's resolutions, or to
#: this share of its frequency where it does not repeat. A line of it is this many times its
#: surroundings; the strongest holds most of its power.
_HARMONICS, _SHARP, _BROAD, _LINE, _DOMINANT = 40, 0.75, 0.1, 30.0, 0.5
#: A misfit of this share that is as likely as a colour leaves open which of the two it is.
_MUCH = 0.2
#: What is left of a misfit may be its form where it is smaller than this share of it; a misfit of
#: less than this share of the noise is slight.
_FORM, _LITTLE = 0.5, 0.3
#: Two levels with fewer jumps are steps; the chance below which places follow the drive; samples
#: about a turn that are at it, and the share of the range by which a turn comes back.
_FEW, _NO_CHANCE, _NEAR, _TURN = 3, 1e-3, 3, 0.01
#: Mains frequencies [Hz], and the share by which a line may be off one.
_MAINS, _OFF = (50.0, 60.0), 0.004
#: A spectrum that falls faster is a smooth signal's, not a noise's, and so is one of which no more
#: than this share is new in each sample.
_SMOOTH, _PREDICTED = 2.1, 0.01
#: Times the least gain below which the colour beside jumps is that of jumps that were missed.
_SLIGHT = 5.0
#: An input moves at a frequency where it has this share of its range.
_LOUD = 5e-3


def _kind_of(jumps: Jumps) -> Kind:
    return "telegraph" if jumps.places.size > _FEW and alternates(jumps) else "steps"


def _unlike(own: FloatArray, every: FloatArray) -> bool:
    """Whether values (k,) are no sample of all of them (n,)."""
    order, own = np.sort(every), np.sort(own)
    upper = np.searchsorted(order, own, side="right") / order.size
    lower = np.searchsorted(order, own, side="left") / order.size
    rank = np.arange(1, own.size + 1) / own.size
    apart = max(float(np.max(rank - upper)), float(np.max(lower - rank + 1.0 / own.size)))
    return bool(scipy.special.kolmogorov(apart * np.sqrt(own.size)) < _NO_CHANCE)


def _is_mains(frequency: float) -> bool:
    """Whether a frequency [Hz] is the mains' or a harmonic of it."""
    return any(
        abs(frequency - round(frequency / f) * f) < _OFF * frequency and round(frequency / f)
        for f in _MAINS
    )


def _robust(flat: FloatArray) -> FloatArray:
    """Return a residual (m,) with its spikes put to the median of their neighbours."""
    middle = scipy.ndimage.median_filter(flat, _WIDTH, mode="nearest")
    away = flat - middle
    scale = 1.3 * local_scale(away)
    return np.where(np.abs(away) > _ASIDE * scale, middle, flat) if np.all(scale > 0.0) else flat


@dataclass(frozen=True, eq=False)
class _Grown:
    """A size that grows: its gain [nats], `size` per unit, the deviation (m,) of each sample."""

    kind: Kind
    gain: float
    size: float
    deviation: FloatArray


#: Standard errors from which on a size that grows is sought by likelihood, and by how little
#: neighbours' products may grow over how the squares do; ratios of variances that are tried.
_ERRORS, _NEIGHBOURS = 5.0, 0.2
_RATIOS = np.geomspace(0.02, 2e3, 26)


def _grown(z: FloatArray, kind: Kind, x: FloatArray) -> _Grown | None:
    """Return how the size of innovations (m,) grows with x: variance s^2 (1 + c x^2).

    Only where neighbours do not grow alike: what a model misses at a high rate is smooth.
    """
    size = x**2 / max(float(np.mean(x**2)), 1e-300)
    centred = size - np.mean(size)
    power = float(centred @ centred)
    limited = np.minimum(z**2, 25.0)
    error = float(np.std(limited)) / np.sqrt(max(power, 1e-300))
    slope = float(centred @ limited) / max(power, 1e-300)
    if not power > 1e-3 * z.size or slope < _ERRORS * error:
        return None
    beside = np.clip(z[1:], -5, 5) * np.clip(z[:-1], -5, 5)
    if abs(float(centred[1:] @ beside)) / power > _NEIGHBOURS * slope + 3.0 * error:
        return None

    def likelihood(ratio: float) -> float:
        grown = 1.0 + ratio * size
        return -0.5 * float(np.sum(np.log(grown))) - 0.5 * z.size * float(
            np.log(np.mean(limited / grown))
        )

    likely = [likelihood(r) for r in _RATIOS]
    k = int(np.argmax(likely))
    fine = np.geomspace(_RATIOS[max(k - 1, 0)], _RATIOS[min(k + 1, _RATIOS.size - 1)], 9)
    fine_ones = [likelihood(r) for r in fine]
    ratio, gain = float(fine[int(np.argmax(fine_ones))]), max(fine_ones)
    gain -= -0.5 * z.size * float(np.log(np.mean(limited))) + 0.5 * float(np.log(z.size))
    if gain < LEAST:
        return None
    grown = 1.0 + ratio * size
    level = float(np.mean(limited / grown))
    each = float(np.sqrt(ratio * level / max(float(np.mean(x**2)), 1e-300)))
    return _Grown(kind, gain, each, np.sqrt(level * grown))


#: Degrees of freedom that are tried, and above which tails are a normal distribution's.
_FREEDOM, _NORMAL = np.geomspace(1.2, 40.0, 12), 25.0
#: Excess of the fourth moment, in standard errors, from which on tails are sought.
_HEAVY = 4.0


def _tails(z: FloatArray) -> tuple[float, float] | None:
    """Return what Student's t gains over a normal distribution, and its degrees of freedom."""
    n = z.size
    x = z / float(np.std(z))
    if float(np.mean(x**4)) - 3.0 < _HEAVY * np.sqrt(24.0 / n):
        return None
    square, best = (z / (1.4826 * float(np.median(np.abs(z))))) ** 2, (-np.inf, 0.0)
    normal = -0.5 * n * (np.log(float(np.mean(square))) + 1.0 + np.log(2.0 * np.pi))
    for nu in _FREEDOM:
        scale = 1.0
        for _ in range(4):
            scale = float(np.mean((nu + 1.0) * square / (nu + square / scale)))
        gain = scipy.special.gammaln(0.5 * (nu + 1.0)) - scipy.special.gammaln(0.5 * nu)
        gain -= 0.5 * np.log(nu * np.pi * scale)
        total = n * gain - 0.5 * (nu + 1.0) * float(np.sum(np.log1p(square / (nu * scale))))
        best = max(best, (float(total), float(nu)))
    gain = best[0] - float(normal) - 0.5 * float(np.log(n))
    return (gain, best[1]) if gain > LEAST and best[1] < _NORMAL else None


#: Outliers are at most this share of the samples; iterations of their mixture; and standard
#: deviations of the largest residual from which on they are sought.
_RARE, _MIXED, _LARGE = 0.02, 12, 4.5


@dataclass(frozen=True, eq=False)
class _Outliers:
    """Which innovations (m,) are outliers, and what a mixture with them gains [nats]."""

    gain: float
    where: BoolArray


def _outliers(z: FloatArray) -> _Outliers | None:
    """Return the outliers of innovations: a rare part of them that is so many times as wide."""
    n = z.size
    scale = 1.4826 * float(np.median(np.abs(z)))
    if not scale > 0.0 or float(np.max(np.abs(z))) < _LARGE * scale:
        return None
    square = (z / scale) ** 2
    normal = -0.5 * n * (np.log(float(np.mean(square))) + 1.0)
    rare, level, wide = max(3.0, float(np.sum(square > 25.0))) / n, 1.0, 100.0
    likelihood, chance = -np.inf, np.zeros(n)
    for _ in range(_MIXED):
        usual = np.log1p(-rare) - 0.5 * (np.log(level) + square / level)
        other = np.log(rare) - 0.5 * (np.log(wide) + square / wide)
        both = np.logaddexp(usual, other)
        likelihood, chance = float(np.sum(both)), np.exp(other - both)
        rare = float(np.clip(np.mean(chance), 1.0 / n, 0.5))
        wide = float(chance @ square / max(float(np.sum(chance)), 1e-300))
        level = float((1.0 - chance) @ square / max(n - float(np.sum(chance)), 1.0))
        wide = max(wide, 4.0 * level)
    gain = likelihood - float(normal) - float(np.log(n))
    where = chance > 0.5
    if gain < LEAST or rare > _RARE or not where.any():
        return None
    return _Outliers(gain, where)
