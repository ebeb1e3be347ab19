"""Where a residual is largest: over frequency, over periods of the displacement, at a jump."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.records.drive import tells_tone
from psa_casadi.records.noise import peaks as highest_peaks
from psa_casadi.records.split import Experiment

FloatArray = npt.NDArray[np.float64]

#: Peaks that are tried, and how much finer than 1/duration their frequencies are told.
_PEAKS, _FINER = 4, 8
#: Bins of the displacement; periods between so many of them over the range are tried.
_BINS, _FEWEST_PERIODS, _MOST_PERIODS = 2048, 4, 256
#: A jump is the difference of the means over so many bins on either side.
_SIDE = 64


def residual_peaks(fit: Fit, experiments: Sequence[Experiment]) -> tuple[float, ...]:
    """Frequencies [Hz] of the highest peaks in the spectrum of the first record's residual.

    Samples that do not count are 0, so that a line keeps its phase across them. The range of a
    periodic drive's harmonics is left out, since it may be distortion, but for the mains.
    """
    experiment = experiments[0]
    count = experiment.stop
    used = experiment.used[:count]
    residual = np.zeros(count)
    residual[used] = fit.residuals[: int(used.sum())]
    residual[used] -= np.mean(residual[used])
    power = np.abs(np.fft.rfft(residual * np.hanning(count), _FINER * count)) ** 2
    frequency = np.fft.rfftfreq(_FINER * count, experiment.record.sample_time)
    lowest, apart = _FINER * max(8, count // 200), _FINER * max(3, count // 200)
    order = highest_peaks(power[lowest:], apart, 5 * _PEAKS) + lowest
    record = experiment.record
    tones = [k for k in order if tells_tone(frequency[k], record, hum=True)]
    strongest = np.array(tones[:_PEAKS], dtype=int)
    return tuple(float(f) for f in np.sort(frequency[strongest])) or (
        0.1 / experiment.record.sample_time,
    )


def residual_periods(fit: Fit, experiments: Sequence[Experiment]) -> tuple[float, ...]:
    """Periods [m] with which the residual of the largest record repeats over the displacement.

    Of the mean residual in bins of the predicted displacement, under a Hann window.
    """
    _, span, count, total = _binned(fit, experiments)
    if span <= 0.0:
        return ()
    mean = total / np.maximum(count, 1)
    power = np.abs(np.fft.rfft(mean * np.hanning(_BINS), _FINER * _BINS)) ** 2
    first = _FINER * _FEWEST_PERIODS
    order = highest_peaks(power[first : _FINER * _MOST_PERIODS], 3 * _FINER, _PEAKS) + first
    return tuple(float(p) for p in np.sort(span * _FINER / order))


def residual_jumps(fit: Fit, experiments: Sequence[Experiment]) -> tuple[float, ...]:
    """Places [m] at which the residual of the largest record jumps over the displacement.

    Where the difference of its means on either side is largest over what equal noise would make of
    it; places are displacements of the model, without the record's offset.
    """
    low, span, count, total = _binned(fit, experiments)
    if span <= 0.0:
        return ()
    below, sums = (np.append(0.0, np.cumsum(q)) for q in (count, total))
    edges = np.arange(_SIDE, _BINS - _SIDE + 1)
    left, right = (below[edges + k] - below[edges + k - _SIDE] for k in (0, _SIDE))
    before, after = (sums[edges + k] - sums[edges + k - _SIDE] for k in (0, _SIDE))
    seen = np.minimum(left, right) > 0
    jump = after / np.maximum(right, 1) - before / np.maximum(left, 1)
    power = np.where(seen, jump**2 * left * right / np.maximum(left + right, 1), 0.0)
    places = edges[highest_peaks(power, _SIDE, _PEAKS)]
    found = low + span * np.sort(places) / _BINS
    return tuple(float(x) for x in found)


def _binned(
    fit: Fit, experiments: Sequence[Experiment]
) -> tuple[float, float, FloatArray, FloatArray]:
    """Return lowest displacement and range [m]; samples and sum of the residual in bins of it.

    Of the record whose displacement, as the model has it, goes furthest; the residual is about its
    mean.
    """
    parts = []
    for k, (e, residual) in enumerate(zip(experiments, fit.residuals_of(experiments), strict=True)):
        if e.held_out_whole:
            continue
        shown = measured(e.record)[: e.stop][e.used[: e.stop]]
        parts.append((shown - residual - fit.offset(k), residual))
    x, residual = max(parts, key=lambda part: float(np.ptp(part[0])))
    low, span = float(x.min()), float(np.ptp(x))
    places = (_BINS * (x - low) / max(span, 1e-300)).astype(np.int64)
    places = np.minimum(places, _BINS - 1)
    count = np.bincount(places, minlength=_BINS).astype(float)
    total = np.bincount(places, residual - np.mean(residual), _BINS).astype(float)
    return low, span, count, total
