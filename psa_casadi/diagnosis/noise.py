"""The noise floor of every record, and tests of a residual for what is not noise."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np
import scipy

from psa_casadi.common.notes import Note, note
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.colour import Colour, noise_rms, rms
from psa_casadi.diagnosis.task import LIMITS, Thresholds
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.records.noise import first_order_noise, last_place_of, quantum_of
from psa_casadi.records.record import Record
from psa_casadi.records.repeats import MeasuredNoise, holds, repeats
from psa_casadi.records.split import Experiment

#: Neighbours correlate, the spectrum has a line, the residual or its size follows the drive, or
#: the residual what some effect would add.
Structure = Literal["correlation", "line", "drive", "size", "effect"]

_LAGS = 25
#: Factor on the p-value of the correlation where the colour is that of the residual.
_LEFT = 100.0
#: Squares of the residual over their mean that count at most.
_MOST = 9.0


@dataclass(frozen=True)
class Omnibus:
    """Probability of the residual under noise alone, and the deciding test.

    `structure` is what that test finds, `output` the one of several whose residual it is. `excess`
    is the share of the residual's power above the noise; `size` [m] the rms of what the test finds,
    `detection_limit` [m] the rms below which nothing of a stack counts, `alarms_below` the
    probability from which on the test does not alarm.
    """

    p_value: float
    excess: float
    structure: Structure
    size: float
    detection_limit: float
    alarms_below: float
    output: str = ""

    @property
    def alarm(self) -> bool:
        """Whether something besides noise is in the residual, above the detection limit."""
        return self.p_value < self.alarms_below and self.size > self.detection_limit

    @property
    def finding(self) -> Note:
        """What is in the residual besides noise, where the test alarms."""
        return note("structure", seen=self.structure, output=self.output, excess=self.excess)


def omnibus(
    residual: FloatArray,
    voltage: FloatArray,
    time: FloatArray,
    colour: Colour,
    floor: float,
    *,
    lengths: Sequence[int],
    detection_limit: float,
    from_residual: bool,
    alarms_below: float,
) -> Omnibus:
    """Test a residual (samples,) [m] for structure that noise of this colour does not have.

    Four tests with Bonferroni's correction: are neighbours of the whitened residual correlated;
    Fisher's g for a line in its spectrum; an F test on general features of the voltage and time;
    and is its size the same everywhere? A sensor's noise is, what a colour may have swallowed of a
    misfit is not. With `from_residual` the colour is the residual's: its jitter covers the size,
    and its order leaves some correlation that Schwarz's criterion does not pay for. `excess` is the
    share of the residual's power above the noise `floor` [m]; structure must be larger than
    `detection_limit` [m] to count; `lengths` are the records' numbers of samples.
    """
    white = colour.whiten(residual)
    p, share = whiteness(white)
    tests: dict[Structure, tuple[float, float]] = {
        "correlation": (min(1.0, _LEFT * p) if from_residual else p, share),
        "line": _fisher_line(white),
        "drive": _features(white, voltage, time, colour),
    }
    if not from_residual:
        tests["size"] = _sizes(white, voltage, time, lengths)
    structure, (p, share) = min(tests.items(), key=lambda item: item[1][0])
    power = float(np.mean(residual**2))
    size = float(np.sqrt(share * power))
    excess = max(0.0, 1.0 - floor**2 / power) if power > 0 else 0.0
    p = min(1.0, len(tests) * p)
    return Omnibus(p, excess, structure, size, detection_limit, alarms_below)


def whiteness(white: FloatArray) -> tuple[float, float]:
    """Return the p-value that neighbours are not correlated, and the largest correlation.

    What is correlated has that share. Box and Pierce's test with the variance that each product
    has by itself: noise whose size changes is not correlated (Lobato, Nankervis and Savin,
    International Economic Review 42 (2001) 187).
    """
    n = len(white)
    centred = white - np.mean(white)
    power = float(centred @ centred)
    if power <= 0 or n <= 2 * _LAGS:
        return 1.0, 0.0
    pairs = [(centred[k:], centred[:-k]) for k in range(1, _LAGS + 1)]
    sums = np.array([a @ b for a, b in pairs])
    spread = np.array([a**2 @ b**2 for a, b in pairs])
    statistic = float(np.sum(sums**2 / np.maximum(spread, 1e-300)))
    share = float(np.max(np.abs(sums))) / power
    return float(scipy.special.chdtrc(_LAGS, statistic)), share


def _fisher_line(white: FloatArray) -> tuple[float, float]:
    """Return the p-value of the strongest line, and its share of the power."""
    power = np.abs(np.fft.rfft(white - np.mean(white))[1:-1]) ** 2
    count = len(power)
    if count < 8 or not np.sum(power) > 0:
        return 1.0, 0.0
    share = float(np.max(power) / np.sum(power))
    return float(min(1.0, count * (1.0 - share) ** (count - 1))), share


def _features(
    white: FloatArray, voltage: FloatArray, time: FloatArray, colour: Colour
) -> tuple[float, float]:
    """F test of the residual on u, u^2, u^3, sgn(u'), |u'|, u sgn(u'), a trend and slow waves."""
    u, rate, turn, t = _drive(voltage, time)
    columns = [np.ones_like(u), u, u**2, u**3, turn, np.abs(rate), u * turn, u**2 * turn, t, t**2]
    columns += [f(np.pi * k * t) for k in (1, 2, 3) for f in (np.sin, np.cos)]
    x = colour.whiten(np.column_stack(columns))
    return _f_test(x, white)


def _sizes(
    white: FloatArray, voltage: FloatArray, time: FloatArray, records: Sequence[int]
) -> tuple[float, float]:
    """F test of the squares on voltage, rate, time and way since the last reversal.

    Breusch and Pagan, Econometrica 47 (1979) 1287, with Koenker's correction; squares are over
    their mean in each record, and those above `_MOST` count as that.
    """
    lengths = [n for n in records if n]
    parts = np.split(white, np.cumsum(lengths)[:-1])
    powers = np.array([np.mean(part**2) for part in parts])
    if not np.all(powers > 0):
        return 1.0, 0.0
    u, rate, turn, t = _drive(voltage, time)
    speed = np.abs(rate) / (float(np.max(np.abs(rate))) or 1.0)
    way, age = _since_reversal(u, turn)
    columns = [u, u**2, speed, np.sqrt(speed), way, np.exp(-20.0 * way), np.exp(-0.1 * age), t]
    x = np.column_stack([*columns, t**2])
    squares = np.minimum(white**2 / np.repeat(powers, lengths), _MOST)
    return _f_test(x - np.mean(x, axis=0), squares - np.mean(squares))


def _drive(
    voltage: FloatArray, time: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return voltage about its mean over its range, its rate, direction, and the time in 0 to 1."""
    u = (voltage - np.mean(voltage)) / (np.ptp(voltage) or 1.0)
    rate = np.gradient(u)
    turn = np.sign(rate) * (np.abs(rate) > 1e-3 * np.max(np.abs(rate)))
    return u, rate, turn, (time - time[0]) / ((time[-1] - time[0]) or 1.0)


def _since_reversal(u: FloatArray, turn: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the distance |u - u_r| from the last reversal and the samples since it."""
    index = np.arange(len(u))
    moving = np.flatnonzero(turn)
    reversed_at = moving[1:][turn[moving[1:]] != turn[moving[:-1]]]
    last = np.zeros(len(u), dtype=np.int64)
    last[reversed_at] = reversed_at
    last = np.maximum.accumulate(last)
    return np.abs(u - u[last]), (index - last).astype(np.float64)


def _f_test(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Return the p-value that columns x (n, k) explain nothing of y (n,), and their share of it."""
    coefficients, _, rank, _ = np.linalg.lstsq(x, y, rcond=None)
    explained = float(np.sum((x @ coefficients) ** 2))
    rest = float(y @ y) - explained
    freedom = len(y) - rank
    if rest <= 0 or freedom <= 0:
        return 1.0, 0.0
    p = float(scipy.special.fdtrc(rank, freedom, explained / rank / (rest / freedom)))
    return p, explained / (explained + rest)


Source = Literal["repeats", "holds", "fast part"]

#: Fewer samples than this give no level to a few per cent.
ENOUGH = 200
#: Samples from which the colour of the noise is known without a model.
_COLOUR = 500
#: Number of lags of the autocovariance that is stored for a first-order autoregression.
_STORED = 30


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


def detection_limit_of(fit: Fit, limits: Thresholds) -> float:
    """Return the rms [m] below which the residuals of a fit are uninformative of a stack."""
    error = max((s.errors[0] for s in fit.simulated if s.errors), default=0.0)
    counts = [part.size for part in fit.record_residuals]
    pairs = zip(fit.experiments, fit.record_residuals, strict=True)
    squares = [detection_limit(e.record, error, part, limits) ** 2 for e, part in pairs]
    return float(np.sqrt(np.average(squares, weights=counts)))


def _floor(record: Record, valid: FloatArray) -> NoiseFloor:
    quantum, _, _ = _resolution(record)
    source, measured_noise, how = _source(record)
    if measured_noise is not None and measured_noise.level > rms(valid):
        source, measured_noise, how = _FAST_PART
    if measured_noise is None:
        level, r = first_order_noise(valid) if valid.size else (0.0, 0.0)
        covariance = np.asarray(level**2 * r ** np.arange(_STORED if r > 0 else 1), np.float64)
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
        return "holds", still, note("noise_holds", count=still.holds)
    return _FAST_PART


#: Robust standard deviations of the residual from which on a repeated reading is the sensor's.
_FAR = 6.0
#: Share of repeated readings from which on the sensor's count is so coarse that they say nothing.
_RARE = 0.2


def without_stuck_readings(fit: Fit) -> tuple[tuple[Experiment, ...], int]:
    """Return a fit's experiments without repeated readings far from it, and how many these are.

    Noise repeats a reading by chance here and there; where that is also far from the model, which
    the record alone cannot separate from a stack that is late, the sensor was stuck.
    """
    kept, count = [], 0
    for e, predicted in zip(fit.experiments, fit.predicted(), strict=True):
        y = e.record.measured
        residual = np.abs(y - predicted)
        again = np.r_[False, np.diff(y) == 0.0]
        noise = 1.4826 * float(np.nanmedian(residual))
        bad = again & (residual > _FAR * noise) & (np.mean(again) < _RARE)
        count += int(np.count_nonzero(bad))
        record = replace(e.record, displacement=np.where(bad, np.nan, y)) if bad.any() else e.record
        kept.append(replace(e, record=record, used=e.used & ~bad, held_out=e.held_out & ~bad))
    return tuple(kept), count
