"""What a picture needs: curves over time, a telling window, fewer points, small numbers."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from psa_casadi.diagnosis.result import Candidate, Diagnosis
from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.identification.identify import Identification
from psa_casadi.records.noise import high_frequency_noise
from psa_casadi.records.split import Experiment
from psa_casadi.report.words.phrases import (
    Scale,
    handy_scale,
    in_brackets,
    length_scale,
    prefixed_scale,
)
from psa_casadi.report.words.verdict_words import added

FloatArray = npt.NDArray[np.float64]
IndexArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

MEASURED_COLOUR, BASE_COLOUR, EXTENDED_COLOUR = "#3a3a3a", "#d55e00", "#0072b2"
NOISE_COLOUR, HELD_OUT_COLOUR = "#8a8a8a", "#f3e9c4"


@dataclass(frozen=True, eq=False)
class Curve:
    """A model's prediction of one record [m], with the name and colour it is drawn with."""

    label: str
    colour: str
    values: FloatArray


@dataclass(frozen=True, eq=False)
class Series:
    """One record with the curves to compare, arrays of shape (n,) in SI units, nan where missing.

    `noise` is the standard deviation of the record's noise [m]; `counts` says that lengths are in
    counts of the sensor. Of a model that is no stack, `measured` is another `quantity` in its
    `unit`, and `voltage` what it is shown `against`, "" if there is nothing.
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

    def residual(self, curve: Curve) -> FloatArray:
        """Return measured minus predicted [m]."""
        return self.measured - curve.values

    @property
    def scale(self) -> Scale:
        """The unit to show what was measured in."""
        span = float(np.nanmax(self.measured) - np.nanmin(self.measured))
        if self.unit:
            return prefixed_scale(span, self.unit)
        return handy_scale(span, counts=self.counts)

    @property
    def title(self) -> str:
        """The measured quantity as a title has it; the name of a model's output stays as it is."""
        return self.quantity if self.unit else self.quantity.capitalize()

    @property
    def label(self) -> str:
        """What an axis of the measured quantity says."""
        return in_brackets(self.quantity, self.scale.unit)

    @property
    def time_scale(self) -> Scale:
        """The unit to show times in: `shown = factor * seconds`."""
        return time_scale(float(self.time[-1] - self.time[0]))

    @property
    def residual_scale(self) -> Scale:
        """The unit to show residuals in."""
        largest = max(float(np.nanmax(np.abs(self.residual(c)))) for c in self.curves)
        if self.unit:
            return prefixed_scale(largest, self.unit)
        return length_scale(largest, counts=self.counts)


def time_scale(span: float) -> Scale:
    """Return the unit to show times of a span [s] in: `shown = factor * seconds`."""
    if span >= 1.0:
        return Scale("s", 1.0)
    return Scale("ms", 1e3) if span >= 1e-3 else Scale("µs", 1e6)


def series_of(d: Diagnosis) -> tuple[Series, ...]:
    """Return the records of a diagnosis with the base and, if something was added, the extended."""
    rows = []
    levels = [n.level for n in d.noise] or [d.noise_floor_rms_m] * len(d.experiments)
    for e, base, extended, noise in zip(d.experiments, d.base, d.extended, levels, strict=True):
        curves = [Curve("base model", BASE_COLOUR, base)]
        if added(d):
            curves.append(Curve("extended model", EXTENDED_COLOUR, extended))
        rows.append(_series(e, curves, noise))
    return tuple(rows)


def series_of_fit(found: Identification) -> tuple[Series, ...]:
    """Return the records of an identification with the fitted model.

    The noise is that of the residual's fast differences: the level that weighted a record in the
    fit may be its whole residual.
    """
    rows = []
    predictions = found.fit.predicted(found.experiments)
    for e, predicted in zip(found.experiments, predictions, strict=True):
        noise = high_frequency_noise((measured(e.record) - predicted)[e.known])
        rows.append(_series(e, [Curve("model", EXTENDED_COLOUR, predicted)], noise))
    return tuple(rows)


def _series(e: Experiment, curves: Sequence[Curve], noise: float) -> Series:
    return Series(
        name=e.record.name,
        time=e.record.time,
        voltage=e.record.voltage,
        measured=measured(e.record),
        curves=tuple(curves),
        held_out=e.held_out,
        noise=noise,
        counts=e.record.displacement_unit == "counts",
    )


def bar_colour(candidate: Candidate, causes: set[str]) -> str:
    """Return the colour of a candidate: named, fitted, or screened only."""
    if candidate.effect in causes:
        return EXTENDED_COLOUR
    return BASE_COLOUR if candidate.fitted else NOISE_COLOUR


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

    def miss(s: Series) -> float:
        spread = float(np.nanstd(s.measured)) or 1.0
        return float(np.sqrt(np.nanmean(s.residual(s.curves[0]) ** 2))) / spread

    return max(series, key=miss)


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
            seen = max(errors[0] - (errors[-1] if len(errors) > 1 else s.noise), 0.0)
            score = seen / (float(np.ptp(y)) + 6.0 * s.noise + seen) * width**0.25
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
