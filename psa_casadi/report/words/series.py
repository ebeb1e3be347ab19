"""Records as what pictures need: one series of each, and what its residual looks like."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from psa_casadi.common.units import BoolArray, FloatArray, IndexArray
from psa_casadi.diagnosis.result import Candidate, Diagnosis, StackDiagnosis
from psa_casadi.identification.experiments import varied
from psa_casadi.identification.identify import StackIdentification
from psa_casadi.identification.result import Identification
from psa_casadi.model.variables import NORMAL_95
from psa_casadi.records.noise import high_frequency_noise
from psa_casadi.records.split import Experiment, noise_share
from psa_casadi.report.words import colours, phrases


@dataclass(frozen=True, eq=False)
class Curve:
    """A model's prediction of one record [m], with the name and colour it is drawn with."""

    label: str
    colour: str
    values: FloatArray


@dataclass(frozen=True, eq=False)
class Series:
    """One record with the curves to compare, arrays of shape (n,) in SI units, nan where missing.

    `noise` is the standard deviation of the record's noise [m]; with `counts` lengths are in
    counts of the sensor. Of a model that is no stack, `measured` is another `quantity` in its
    `unit`, and `voltage` the quantity that it is plotted `against`, "" for none. `place` numbers
    its experiment and channel.
    """

    name: str
    time: FloatArray
    voltage: FloatArray
    measured: FloatArray
    curves: tuple[Curve, ...]
    held_out: BoolArray
    noise: float
    counts: bool
    quantity: str = "displacement"
    unit: str = ""
    against: str = "voltage [V]"
    place: tuple[int, int] = (0, 0)

    @property
    def record(self) -> str:
        """The name of the record, without that of the output in front."""
        return self.name.removeprefix(f"{self.quantity} of ")

    def residual(self, curve: Curve) -> FloatArray:
        """Return measured minus predicted [m]."""
        return self.measured - curve.values

    def miss(self, curve: int) -> float:
        """Return the rms error of a curve, by its place, over the spread of what was measured."""
        spread = float(np.nanstd(self.measured)) or 1.0
        return float(np.sqrt(np.nanmean(self.residual(self.curves[curve]) ** 2))) / spread

    def judged_rms(self, curve: Curve) -> float:
        """Return the rms error of a curve over the samples held out, or all if none is [m]."""
        residual = self.residual(curve)
        counted = self.held_out if self.held_out.any() else np.isfinite(residual)
        return float(np.sqrt(np.nanmean(residual[counted] ** 2)))

    @property
    def span(self) -> float:
        """The range of what was measured [m]."""
        return float(np.nanmax(self.measured) - np.nanmin(self.measured))

    @property
    def scale(self) -> phrases.Scale:
        """The unit to show what was measured in."""
        if self.unit:
            return phrases.prefixed_scale(self.span, self.unit)
        return phrases.handy_scale(self.span, counts=self.counts)

    @property
    def title(self) -> str:
        """The measured quantity as a title has it; the name of a model's output stays as it is."""
        return self.quantity if self.unit else self.quantity.capitalize()

    @property
    def label(self) -> str:
        """The label of the axis of the measured quantity."""
        return phrases.in_brackets(self.quantity, self.scale.unit)

    @property
    def time_scale(self) -> phrases.Scale:
        """The unit to show times in: `number = factor * seconds`."""
        return time_scale(float(self.time[-1] - self.time[0]))

    @property
    def residual_scale(self) -> phrases.Scale:
        """The unit to show residuals in."""
        largest = max(float(np.nanmax(np.abs(self.residual(c)))) for c in self.curves)
        if self.unit:
            return phrases.prefixed_scale(largest, self.unit)
        return phrases.length_scale(largest, counts=self.counts)


def time_scale(span: float) -> phrases.Scale:
    """Return the unit to show times of a span [s] in: `number = factor * seconds`."""
    if span >= 1.0:
        return phrases.Scale("s", 1.0)
    return phrases.Scale("ms", 1e3) if span >= 1e-3 else phrases.Scale("µs", 1e6)


#: Readings that a column must have in a record to be a series.
_FEWEST = 8


def series_of(d: Diagnosis) -> tuple[Series, ...]:
    """Return the records of a diagnosis with the base and, if something was added, the extended.

    Of a stack that is the displacement, of any other model every output in every record.
    """
    stack = d if isinstance(d, StackDiagnosis) else None
    count = 1 if stack else len(d.experiments[0].channels)
    noise = {e.output: e.noise for e in d.errors}
    rows = []
    for j in range(count):
        base, extended = d.predictions(j)
        for k, e in enumerate(d.experiments):
            curves = [Curve("base model", colours.BASE, base[k])]
            if phrases.added(d):
                curves.append(Curve("extended model", colours.EXTENDED, extended[k]))
            if stack:
                level = stack.noise[k].level if stack.noise else stack.noise_floor_rms_m
                rows.append(_displacement(k, e, curves, level))
            else:
                rows += _output(d, (k, j), noise, curves)
    return tuple(rows)


def series_of_fit(identification: Identification) -> tuple[Series, ...]:
    """Return the records of an identification with the fitted model.

    The noise of a displacement is that of the residual's fast differences: the level that weighted
    a record in the fit may be its whole residual.
    """
    rows: list[Series] = []
    if isinstance(identification, StackIdentification):
        predictions = identification.fit.predicted()
        rows_of = zip(identification.experiments, predictions, strict=True)
        for k, (e, predicted) in enumerate(rows_of):
            noise = high_frequency_noise((e.record.measured - predicted)[e.known])
            rows.append(_displacement(k, e, [Curve("model", colours.EXTENDED, predicted)], noise))
        return tuple(rows)
    outputs = identification.fit.outputs()
    for j, channel in enumerate(identification.experiments[0].channels):
        place = identification.model.output_names.index(channel.column)
        for k, y in enumerate(outputs):
            curves = [Curve("model", colours.EXTENDED, y[:, place])]
            rows += _output(identification, (k, j), identification.noise, curves)
    return tuple(rows)


def _displacement(k: int, e: Experiment, curves: Sequence[Curve], noise: float) -> Series:
    return Series(
        name=e.record.name,
        time=e.record.time,
        voltage=e.record.voltage,
        measured=e.record.measured,
        curves=tuple(curves),
        held_out=e.held_out,
        noise=noise,
        counts=e.record.displacement_unit == "counts",
        place=(k, 0),
    )


def _output(
    result: Diagnosis | Identification,
    place: tuple[int, int],
    noise: Mapping[str, float],
    curves: Sequence[Curve],
) -> Iterator[Series]:
    """Yield the series of a record and a channel, by their `place`, if it has readings enough."""
    k, j = place
    e, channel = result.experiments[k], result.experiments[0].channels[j]
    if channel.column not in noise or np.isfinite(e.measured(j)).sum() < _FEWEST:
        return
    record, name, moving = e.record, channel.column, varied(result.model, e)
    units = {i.name: i.unit for i in result.model.structure.inputs}
    along = None if moving is None else record.column(moving)
    yield Series(
        name=record.name if len(noise) == 1 else f"{name} of {record.name}",
        time=record.time - record.time[0],
        voltage=np.zeros(record.n) if along is None else along,
        measured=e.measured(j),
        curves=tuple(curves),
        held_out=e.at(j, e.held_out),
        noise=noise[name] * e.share(j) / noise_share(result.experiments, j),
        counts=False,
        quantity=name,
        unit=channel.unit or "1",
        against="" if moving is None else phrases.in_brackets(moving, units[moving]),
        place=place,
    )


def bar_colour(candidate: Candidate, causes: set[str]) -> str:
    """Return the colour of a candidate: named, fitted, or screened only."""
    if candidate.effect in causes:
        return colours.EXTENDED
    return colours.BASE if candidate.fitted else colours.NOISE


def spans(marked: BoolArray) -> list[tuple[int, int]]:
    """Return first and last index of every run of True that gaps of a few samples do not cut."""
    where = np.flatnonzero(marked)
    if not where.size:
        return []
    cuts = np.flatnonzero(np.diff(where) > 8)
    firsts = where[np.concatenate([[0], cuts + 1])]
    lasts = where[np.concatenate([cuts, [where.size - 1]])]
    return [(int(a), int(b)) for a, b in zip(firsts, lasts, strict=True)]


def most_telling(series: Sequence[Series]) -> Series:
    """Return the record whose first curve misses the measurement by the largest share of range."""
    return max(series, key=lambda s: s.miss(0))


def telling_window(s: Series) -> slice:
    """Return the samples where it is easiest to see what the last curve does better than the first.

    Windows of 1/8 to 1/256 of the record, of 48 samples at least, in held-out data if there are
    any; the score is by how much the error falls, of a single curve the error above the noise, over
    the range that the displacement covers there.
    """
    n = len(s.time)
    first = s.curves[0]
    miss = [np.nan_to_num(s.residual(c)) for c in s.curves]
    best, window = -1.0, slice(0, n)
    for share in (8, 16, 32, 64, 128, 256):
        width = max(48, n // share)
        for start in range(0, max(1, n - width), max(1, width // 4)):
            part = slice(start, start + width)
            if s.held_out.any() and not s.held_out[part].all():
                continue
            y = first.values[part]
            errors = [float(np.sqrt(np.mean(m[part] ** 2))) for m in miss]
            fall = max(errors[0] - (errors[-1] if len(errors) > 1 else s.noise), 0.0)
            score = fall / (float(np.ptp(y)) + 6.0 * s.noise + fall) * width**0.25
            if score > best:
                best, window = score, part
    return window


def kept(signals: Sequence[FloatArray], limit: int) -> IndexArray:
    """Return about `limit` indices that keep the extremes of every signal in every bucket.

    The buckets are equal runs of samples. A bucket without any value of a signal keeps a sample
    that is missing there, so that a gap stays a gap.
    """
    n = len(signals[0])
    if n <= limit:
        return np.arange(n)
    buckets = max(1, limit // (2 * len(signals)))
    return extremes(signals, np.linspace(0, n, buckets + 1).astype(np.int64))


def extremes(signals: Sequence[FloatArray], edges: IndexArray) -> IndexArray:
    """Return first and last index, and those of the extremes of every signal between the edges."""
    chosen = {int(edges[0]), int(edges[-1]) - 1}
    for values in signals:
        low, high = np.nan_to_num(values, nan=np.inf), np.nan_to_num(values, nan=-np.inf)
        for a, b in pairwise(edges.tolist()):
            chosen |= {int(a + np.argmin(low[a:b])), int(a + np.argmax(high[a:b]))}
    return np.array(sorted(chosen), dtype=np.int64)


def compact(values: FloatArray) -> npt.NDArray[np.floating]:
    """Return the values in single precision where no picture can show the difference."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return values.astype(np.float32)
    lost = 6e-8 * float(np.max(np.abs(finite)))
    return values if lost > 1e-5 * float(np.ptp(finite)) else values.astype(np.float32)


#: Lags at which an autocorrelation is taken, evenly spread over their logarithm.
_LAGS = 160


@dataclass(frozen=True)
class ResidualFigures:
    """Size and character of one record's residual; lengths in [m].

    `neighbours` is the autocorrelation at a lag of one sample, `outside` the share of the lags
    beyond the band of white noise, `lasting` the time [s] after which the autocorrelation has once
    been within the band or changed its sign; `skewness` and `kurtosis` (excess) are 0 for a normal
    distribution, and of that 0.0027 lies `beyond_three` standard deviations.
    """

    rms: float
    mean: float
    largest: float
    range_share: float
    noise: float
    neighbours: float
    outside: float
    lasting: float
    skewness: float
    kurtosis: float
    beyond_three: float


def residual_figures(s: Series, curve: Curve) -> ResidualFigures:
    """Return size and character of the residual that a curve leaves in its record."""
    residual = s.residual(curve)
    valid = residual[np.isfinite(residual)]
    lags, correlations = autocorrelation(residual)
    calm = np.abs(correlations) <= white_band(residual)
    # lags lie apart, so that an autocorrelation may pass through the band unseen
    below = np.flatnonzero(calm | (np.sign(correlations) != np.sign(correlations[0])))
    last = lags[below[0]] if below.size else lags[-1]
    spread = float(np.std(valid))
    z = (valid - np.mean(valid)) / (spread if spread > 0 else 1.0)
    rms = float(np.sqrt(np.mean(valid**2)))
    return ResidualFigures(
        rms=rms,
        mean=float(np.mean(valid)),
        largest=float(np.max(np.abs(valid))),
        range_share=rms / s.span if s.span > 0 else float("nan"),
        noise=s.noise,
        neighbours=float(correlations[0]),
        outside=float(np.mean(~calm)),
        lasting=float(last * np.median(np.diff(s.time))),
        skewness=float(np.mean(z**3)),
        kurtosis=float(np.mean(z**4)) - 3.0,
        beyond_three=float(np.mean(np.abs(z) > 3.0)),
    )


def autocorrelation(residual: FloatArray) -> tuple[IndexArray, FloatArray]:
    """Return lags [samples] from 1 to a quarter of the record, and the autocorrelation there.

    r(k) = mean(e_i e_(i+k)) / mean(e_i^2), each mean over the pairs of which neither sample is
    missing, with e the residual minus its mean. A lag without any pair has correlation 0.
    """
    n = len(residual)
    there = np.isfinite(residual)
    centred = np.where(there, residual - np.mean(residual[there]), 0.0)
    # sums over the lags, by the fast Fourier transform
    products, pairs = (
        np.fft.irfft(np.abs(np.fft.rfft(v, 2 * n)) ** 2, 2 * n)[:n]
        for v in (centred, there.astype(np.float64))
    )
    power = products[0] / max(pairs[0], 1.0)
    lags = np.unique(np.geomspace(1, max(2, n // 4), _LAGS).round().astype(np.int64))
    means = products[lags] / np.maximum(pairs[lags], 1.0)
    return lags, means / power if power > 0 else np.zeros(len(lags))


def white_band(residual: FloatArray) -> float:
    """Return the autocorrelation that 95 % of the lags of white noise stay below."""
    return NORMAL_95 / float(np.sqrt(np.count_nonzero(np.isfinite(residual))))


def distribution(
    residual: FloatArray, low: float, high: float
) -> tuple[FloatArray, FloatArray, float]:
    """Return the distribution of a residual between two values [m], in 15 to 61 bins.

    That is the bins' centres [m], the shares of the samples in each [%], and their width [m].
    """
    valid = residual[np.isfinite(residual)]
    bins = int(np.clip(2.0 * len(valid) ** (1.0 / 3.0), 15, 61)) | 1
    counts, edges = np.histogram(valid, bins=bins, range=(low, high))
    width = float(edges[1] - edges[0])
    return edges[:-1] + 0.5 * width, 100.0 * counts / len(valid), width


def spectrum(time: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return frequencies [Hz] and the amplitude density [m/sqrt(Hz)] of a residual (Welch, Hann).

    Missing samples and uneven sampling are bridged by straight lines, on a grid of at most four
    times as many points as there are samples.
    """
    valid = np.isfinite(residual)
    step = max(float(np.median(np.diff(time))), float(time[-1] - time[0]) / (4 * len(time)))
    grid = np.arange(time[0], time[-1], step)
    even = np.interp(grid, time[valid], residual[valid])
    segment = min(len(even), max(256, len(even) // 6))
    from scipy.signal import welch  # which takes long to load, and only pages need

    frequency, power = welch(even, 1.0 / step, nperseg=segment)
    return frequency[1:], np.sqrt(power[1:])


def shown_lines(frequency: FloatArray, density: FloatArray, limit: int) -> IndexArray:
    """Return about `limit` indices of a spectrum that keep its peaks, evenly over log frequency."""
    n = len(frequency)
    if n <= limit:
        return np.arange(n)
    steps = np.geomspace(frequency[0], frequency[-1], limit // 2)
    edges = np.unique(np.concatenate([[0], np.searchsorted(frequency, steps), [n]]))
    return extremes([density], edges.astype(np.int64))


def noise_density(s: Series) -> float:
    """Return the amplitude density [m/sqrt(Hz)] of white noise of the record's level."""
    return s.noise * float(np.sqrt(2.0 * np.median(np.diff(s.time))))
