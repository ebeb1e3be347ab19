"""The noise floor of every record: from repeats, from holds, or from the fast part."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np

from psa_casadi.common.notes import Note, note
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.colour import Colour, noise_rms, rms
from psa_casadi.diagnosis.task import LIMITS, Thresholds
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.records.noise import first_order_noise, last_place_of, quantum_of
from psa_casadi.records.record import Record
from psa_casadi.records.repeats import MeasuredNoise, holds, repeats
from psa_casadi.records.split import Experiment

Source = Literal["repeats", "holds", "fast part"]

#: Fewer samples than this give no level to a few per cent.
ENOUGH = 200
#: Samples from which the colour of the noise is known without a model.
_COLOUR = 500
#: Number of lags of the autocovariance that is stored for a first-order autoregression.
_LAGS = 30


@dataclass(frozen=True, eq=False)
class NoiseFloor:
    """The noise of one record: standard deviation `level` [m, or counts] and where it comes from.

    `autocovariance` (lags,) [m^2] starts at lag 0 and is that of `level`; `autoregression` (p,) is
    empty for white noise; `samples` is what the level rests on. `quantum` is the step between the
    sensor's levels, None where it shows none; `finding` states all this.
    """

    record: str
    level: float
    source: Source
    samples: int
    autocovariance: FloatArray
    autoregression: FloatArray
    quantum: float | None
    finding: Note

    @property
    def sentence(self) -> str:
        """All this in words."""
        return str(self.finding)


def noise_floor(
    records: Sequence[Record], residuals: Sequence[FloatArray]
) -> tuple[NoiseFloor, ...]:
    """Return the noise floor of every record, from the best source that it offers.

    Repeats come first, then holds: no model is involved in them. Else the fast part of the residual
    (n,), nan where nothing counts, shows the noise, white or of first order (`first_order_noise`).
    No level is below quantum/sqrt(12), the rms of rounding to a quantum.
    """
    return tuple(_floor(r, e[np.isfinite(e)]) for r, e in zip(records, residuals, strict=True))


def pooled_level(
    noise: Sequence[NoiseFloor], residuals: Sequence[FloatArray], colour: Colour
) -> float:
    """Return the rms of the noise over all records [m].

    Where no voltage was repeated that of the residual's fast part counts, at most that of noise of
    this `colour` and at least that of rounding: a hold may ring.
    """
    counts = [np.count_nonzero(np.isfinite(e)) for e in residuals]
    powers = [
        n.level**2
        if n.source == "repeats"
        else max(noise_rms(e[np.isfinite(e)], colour), _rounding(n.quantum)) ** 2
        for n, e in zip(noise, residuals, strict=True)
    ]
    return float(np.sqrt(np.average(powers, weights=counts)))


def known_colour(record: Record, residual: FloatArray) -> FloatArray | None:
    """Return the autoregression of a record's noise where repeats show it, else None.

    Holds do not: what rings or hums during a hold would count as the noise's colour. Where a
    `residual` (n,) is smaller than what differs between repeats, the repeats hold more than noise:
    what a first loop leaves behind, and creep.
    """
    source, result, _ = _source(record)
    if result is None or source != "repeats" or result.samples < _COLOUR:
        return None
    return result.autoregression if result.level <= rms(residual) else None


def detection_limit(
    record: Record, error: float, residual: FloatArray, limits: Thresholds = LIMITS
) -> float:
    """Return the rms [m] below which a `residual` (n,) is uninformative of a stack.

    It is that of the simulation's largest `error` [m], of the form that no model has exactly
    (`form_of_range`), and of rounding in the sensor or the file where the residual is hardly
    more than that.
    """
    quantum, last_place, size = _resolution(record)
    rounding = _rounding(max(quantum or 0.0, last_place))
    if rms(residual) > limits.dithered * rounding:
        rounding = 0.0
    return float(np.sqrt(rounding**2 + error**2 + (limits.form_of_range * size) ** 2))


def detection_limit_of(fit: Fit, experiments: Sequence[Experiment], limits: Thresholds) -> float:
    """Return the rms [m] below which the residuals of a fit are uninformative of a stack."""
    error = max((s.errors[0] for s in fit.simulated if s.errors), default=0.0)
    counts = [int(e.used.sum()) for e in experiments]
    pairs = zip(experiments, fit.record_residuals, strict=True)
    squares = [detection_limit(e.record, error, part, limits) ** 2 for e, part in pairs]
    return float(np.sqrt(np.average(squares, weights=counts)))


def _floor(record: Record, valid: FloatArray) -> NoiseFloor:
    quantum, _, _ = _resolution(record)
    source, measured_noise, how = _source(record)
    if measured_noise is not None and measured_noise.level > rms(valid):
        source, measured_noise, how = _FAST_PART
    if measured_noise is None:
        level, r = first_order_noise(valid) if valid.size else (0.0, 0.0)
        covariance = np.asarray(level**2 * r ** np.arange(_LAGS if r > 0 else 1), np.float64)
        regression = np.array([r] if r > 0 else [])
        measured_noise = MeasuredNoise(level, covariance, regression, valid.size)
    rounding = _rounding(quantum)
    level, covariance = measured_noise.level, measured_noise.autocovariance.copy()
    if level < rounding:
        covariance[0] += rounding**2 - level**2
        level = rounding
    unit = record.displacement_unit
    finding = note(
        "noise", record=record.name, level=(level, unit), how=how, samples=measured_noise.samples,
        quantum=None if quantum is None else (quantum, unit),
        rounding=(rounding, unit),
    )  # fmt: skip
    samples, regression = measured_noise.samples, measured_noise.autoregression
    return NoiseFloor(record.name, level, source, samples, covariance, regression, quantum, finding)


def _rounding(quantum: float | None) -> float:
    """Rms of rounding to a quantum, 0 where there is none."""
    return (quantum or 0.0) / float(np.sqrt(12.0))


_FAST_PART: tuple[Source, None, Note] = ("fast part", None, note("noise_fast"))


@lru_cache(maxsize=64)
def _resolution(record: Record) -> tuple[float | None, float, float]:
    """Return a record's quantum, its last decimal place, and its range [m]; None, 0 without any."""
    y = record.displacement
    valid = np.zeros(0) if y is None else y[np.isfinite(y)]
    if not valid.size:
        return None, 0.0, 0.0
    return quantum_of(valid), last_place_of(valid), float(np.ptp(valid))


@lru_cache(maxsize=64)
def _source(record: Record) -> tuple[Source, MeasuredNoise | None, Note]:
    """Return the best source that needs no model, the noise that it measures, and a note on it."""
    again = repeats(record)
    if again is not None and again.samples >= ENOUGH:
        return "repeats", again, note("noise_repeats", apart=(again.distances[0], "s"))
    still = holds(record)
    if still is not None and still.samples >= ENOUGH:
        return "holds", still, note("noise_holds", count=still.count)
    return _FAST_PART


#: Robust standard deviations of the residual from which on a repeated reading is the sensor's.
_FAR = 6.0
#: Share of repeated readings from which on the sensor's count is so coarse that they say nothing.
_RARE = 0.2


def without_stuck_readings(
    experiments: Sequence[Experiment], fit: Fit
) -> tuple[tuple[Experiment, ...], int]:
    """Return the experiments without repeated readings far from a fit, and how many these are.

    Noise repeats a reading by chance here and there; where that is also far from the model, which
    the record alone cannot separate from a stack that is late, the sensor was stuck.
    """
    kept, count = [], 0
    for e, predicted in zip(experiments, fit.predicted(), strict=True):
        y = measured(e.record)
        residual = np.abs(y - predicted)
        again = np.r_[False, np.diff(y) == 0.0]
        noise = 1.4826 * float(np.nanmedian(residual))
        bad = again & (residual > _FAR * noise) & (np.mean(again) < _RARE)
        count += int(np.count_nonzero(bad))
        record = replace(e.record, displacement=np.where(bad, np.nan, y)) if bad.any() else e.record
        kept.append(replace(e, record=record, used=e.used & ~bad, held_out=e.held_out & ~bad))
    return tuple(kept), count
