"""What a picture needs: curves over time, a telling window, fewer points, a spectrum."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy import signal

from psa_casadi.diagnosis.result import Candidate, Diagnosis
from psa_casadi.experiment.split import Experiment
from psa_casadi.identification.identify import Identification
from psa_casadi.identification.prediction import measured
from psa_casadi.report.phrases import Scale, added, length_scale

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
    counts of the sensor.
    """

    name: str
    time: FloatArray
    voltage: FloatArray
    measured: FloatArray
    curves: tuple[Curve, ...]
    held_out: BoolArray
    noise: float
    counts: bool

    def residual(self, curve: Curve) -> FloatArray:
        """Return measured minus predicted [m]."""
        return self.measured - curve.values

    @property
    def scale(self) -> Scale:
        """The unit to show displacements in."""
        span = float(np.nanmax(self.measured) - np.nanmin(self.measured))
        return length_scale(span, counts=self.counts)

    @property
    def residual_scale(self) -> Scale:
        """The unit to show residuals in."""
        largest = max(float(np.nanmax(np.abs(self.residual(c)))) for c in self.curves)
        return length_scale(largest, counts=self.counts)


def series_of(d: Diagnosis) -> tuple[Series, ...]:
    """Return the records of a diagnosis with the base and, if something was added, the extended."""
    rows = []
    for e, base, extended in zip(d.experiments, d.base, d.extended, strict=True):
        curves = [Curve("base model", BASE_COLOUR, base)]
        if added(d):
            curves.append(Curve("extended model", EXTENDED_COLOUR, extended))
        rows.append(_series(e, curves, d.noise_floor_rms_m))
    return tuple(rows)


def series_of_fit(found: Identification) -> tuple[Series, ...]:
    """Return the records of an identification with the fitted model."""
    predicted = found.fit.predicted(found.experiments)
    return tuple(
        _series(e, [Curve("model", EXTENDED_COLOUR, y)], sigma)
        for e, y, sigma in zip(found.experiments, predicted, found.fit.sigma, strict=True)
    )


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
    """Return the samples where the curves' difference is easiest to see.

    Windows of 1/8 to 1/64 of the record, of 48 samples at least, in held-out data if there are any;
    the score is the difference over the range that the displacement covers in the window.
    """
    n = len(s.time)
    first = s.curves[0]
    miss = s.curves[1].values - first.values if len(s.curves) > 1 else s.residual(first)
    miss = np.nan_to_num(miss)
    best, window = -1.0, slice(0, n)
    for share in (8, 16, 32, 64):
        width = max(48, n // share)
        for start in range(0, max(1, n - width), max(1, width // 4)):
            part = slice(start, start + width)
            if s.held_out.any() and not s.held_out[part].all():
                continue
            y = first.values[part]
            seen = abs(float(np.mean(miss[part]))) + float(np.std(miss[part]))
            score = seen / (float(np.ptp(y)) + 6.0 * s.noise + seen) * width**0.25
            if score > best:
                best, window = score, part
    return window


def kept(signals: Sequence[FloatArray], limit: int) -> IndexArray:
    """Return about `limit` indices that keep the extremes of every signal in every bucket."""
    n = len(signals[0])
    if n <= limit:
        return np.arange(n)
    buckets = max(1, limit // (2 * len(signals)))
    edges = np.linspace(0, n, buckets + 1).astype(np.int64)
    chosen = {0, n - 1}
    for values in signals:
        low, high = np.nan_to_num(values, nan=np.inf), np.nan_to_num(values, nan=-np.inf)
        for a, b in pairwise(edges.tolist()):
            chosen |= {int(a + np.argmin(low[a:b])), int(a + np.argmax(high[a:b]))}
    return np.array(sorted(chosen), dtype=np.int64)


def spectrum(time: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return frequencies [Hz] and the amplitude density [m/sqrt(Hz)] of a residual (Welch, Hann).

    Missing samples and uneven sampling are bridged by straight lines.
    """
    valid = np.isfinite(residual)
    step = float(np.median(np.diff(time)))
    grid = np.arange(time[0], time[-1], step)
    even = np.interp(grid, time[valid], residual[valid])
    segment = min(len(even), max(256, len(even) // 6))
    frequency, power = signal.welch(even, 1.0 / step, nperseg=segment)
    return frequency[1:], np.sqrt(power[1:])


def noise_density(s: Series) -> float:
    """Return the amplitude density [m/sqrt(Hz)] of white noise of the record's level."""
    return s.noise * float(np.sqrt(2.0 * np.median(np.diff(s.time))))
