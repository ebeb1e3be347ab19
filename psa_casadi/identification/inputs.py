"""How inputs are read: held or straight lines between samples, noisy or smoothed, at which times.

A simulation joins the samples of the voltage by straight lines. Where an amplifier smooths them,
chords cut the bends of a fast signal off: by u'' h^2/12 in the mean of a sampling interval h, 0.2 %
of the amplitude of a sine with 40 samples a period. A plant that answers within some intervals
shows this mean, and the error looks like a further resonance or a lag.

Samples that hardware takes at even times may get their time stamps from a computer that is busy.
The stamps jitter, the samples do not, and a model at the stamps seems to miss what is fast.

Either reading of a stack's records is simulated once. The difference d of the displacements is
fitted to the residual r of a fit, together with all fitted parameters: its share d.r/d.d is near 1
if that reading is right, 0 if it is not.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np
import scipy
from numpy.lib.stride_tricks import sliding_window_view

from psa_casadi.common.errors import PsaError
from psa_casadi.common.notes import Note, note
from psa_casadi.common.units import FloatArray
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.fitting.prediction import Further, trace_record
from psa_casadi.identification.multistart import search_starts
from psa_casadi.identification.refitting import refit, relevelled, weighted
from psa_casadi.records.noise import fast_noise
from psa_casadi.records.record import Record
from psa_casadi.records.signals import Hold
from psa_casadi.records.split import Experiment

#: Nats by which inputs that are read another way must be likelier: a cause's price.
LIKELIER = 8.0
#: Order of the autoregression of a residual.
_ORDER = 8
#: Noise of an input that is smoothed, over its standard deviation, and at most: what moves from
#: sample to sample is no noise.
_NOISY, _MOVING = 0.005, 0.3


def read_otherwise(of: Fit, *, undecided: bool) -> tuple[Fit, tuple[Note, ...]]:
    """Return the fit with the likeliest reading of the inputs, and notes on it.

    Held or straight lines between samples, if that is `undecided`; then straight lines through
    noisy readings, or through smoothed ones. The same fit if it was interrupted.
    """
    best, notes = of, list[Note]()
    changes = (held_otherwise, _smoothed_instead) if undecided else (_smoothed_instead,)
    for change in () if of.interrupted else changes:
        if other := change(best):
            best, why = other
            notes.append(why)
    return best, tuple(notes)


def read_like(
    experiments: Sequence[Experiment], hold: Hold, notes: Sequence[Note]
) -> tuple[Experiment, ...]:
    """Return experiments whose inputs are read as those were of which that was `notes`."""
    names = [n for q in notes if q.code == "inputs_smoothed" for n in q.values["inputs"]]
    return tuple(_smoothed(e, names)[0] for e in held_as(experiments, hold))


def _smoothed_instead(of: Fit) -> tuple[Fit, Note] | None:
    """Return the fit with noisy inputs smoothed, where that is `LIKELIER`.

    Noise that is read at an input passes through the model: it adds to the residual, and bends the
    parameters (errors in variables).
    """
    pairs = [_smoothed(e, of.model.input_names) for e in of.experiments]
    noisy = tuple(dict.fromkeys(n for _, names in pairs for n in names))
    if not noisy:
        return None
    return _instead(of, tuple(e for e, _ in pairs), "inputs_smoothed", inputs=noisy)


def _smoothed(e: Experiment, names: Sequence[str]) -> tuple[Experiment, list[str]]:
    """Return an experiment whose noisy inputs are smoothed, and the names of these.

    Cubic splines by generalised cross-validation (Wahba, Spline models for observational data,
    1990), where the readings have noise and are lines between samples.
    """
    record, noisy = e.record, dict[str, FloatArray]()
    for name in names if record.hold == "linear" else ():
        u = record.column(name)
        if u is None or not np.isfinite(u).all() or not np.ptp(u) > 0.0:
            continue
        if _NOISY < fast_noise(u) / float(np.std(u)) < _MOVING:
            t = record.time
            noisy[name] = scipy.interpolate.make_smoothing_spline(t, u)(t)
    if not noisy:
        return e, []
    signals = cast("Any", record)
    return replace(e, record=replace(signals, columns={**signals.columns, **noisy})), [*noisy]


def held_otherwise(of: Fit) -> tuple[Fit, Note] | None:
    """Return the fit with inputs the other way between samples, where that is `LIKELIER`.

    All inputs of all records are held, or none is.
    """
    hold = other_hold(of.experiments)
    return _instead(of, held_as(of.experiments, hold), "hold_found", hold=hold)


def _instead(
    of: Fit, others: Sequence[Experiment], code: str, **values: Any
) -> tuple[Fit, Note] | None:
    """Return the fit of other experiments and its note, where it is `LIKELIER`."""
    try:
        fit = refitted(of, others)
    except PsaError:
        return None
    nats = likelier(fit, of)
    if nats < LIKELIER:
        return None
    return relevelled(fit, every=True), note(code, **values, nats=nats)


def likelier(new: Fit, old: Fit) -> float:
    """Return by how many nats a fit is likelier than another one of the same readings.

    sum_j n_j ln(w_j/w'_j), w the rms of what an autoregression leaves of an output's residual: half
    a sample shows at jumps, whatever slow structure the model misses.
    """
    pairs = zip(old.channels, new.channels, strict=True)
    return sum(a.residuals.size * float(np.log(_innovation(a) / _innovation(b))) for a, b in pairs)


def other_hold(experiments: Sequence[Experiment]) -> Hold:
    """Return what inputs are not between samples."""
    return "linear" if any(e.record.hold == "zero" for e in experiments) else "zero"


def refitted(of: Fit, others: Sequence[Experiment]) -> Fit:
    """Fit other experiments of as many records from the end of a fit, or from its values alone.

    Raises SimulationError.
    """
    try:
        return refit(of, others=others, sigma=of.sigma, tolerance=1e-6)
    except PsaError:
        return search_starts(of.model, weighted(of, others), of.unknowns.names, starts=1)[0]


def _innovation(o: Further) -> float:
    """Return the rms of what an autoregression leaves of an output's residual, in its unit."""
    windows = [sliding_window_view(p, _ORDER + 1) for p in o.parts if p.size > _ORDER]
    if not windows:
        return max(o.rms, 1e-300)
    *past, now = np.vstack(windows).T
    weights, *_ = np.linalg.lstsq(np.transpose(past), now, rcond=1e-12)
    left = now - np.transpose(past) @ weights
    return max(float(np.sqrt(np.mean(left**2))), o.straight, 1e-300)


def held_as(experiments: Sequence[Experiment], hold: Hold) -> tuple[Experiment, ...]:
    """Return experiments whose inputs are held, or straight lines."""
    return tuple(replace(e, record=replace(e.record, hold=hold)) for e in experiments)


#: Standard errors by which the share of the difference that the residual holds must exceed none,
#: and how far it may be from the whole of it. Smooth plants have 0.85 to 0.98 (the base has bent
#: itself to the rest), others 0.0 +- 0.1, and residuals that hold something else -6000 to 11.
_SURE, _NEAR = 6.0, 0.25
#: Stamps this share of a step from even ones are even.
_ROUNDING = 1e-6


#: A fit's records in another reading, and a note on it.
Otherwise = tuple[tuple[Experiment, ...], Note]


def smooth_between(fit: Fit) -> Otherwise | None:
    """Return the experiments with the voltage moved to a smooth curve's mean, and a note; or None.

    None where the error of the `fit` does not hold the difference, or a record cannot be simulated.
    """
    held = _held(fit, _of_smooth)
    if held is None:
        return None
    moved = []
    for e in fit.experiments:
        # a sample is moved by the mean of the intervals on its sides
        higher = _higher(e.record)
        others = np.concatenate([higher[:1], _middle(higher), higher[-1:]])
        moved.append(replace(e, record=replace(e.record, voltage=e.record.voltage + others)))
    share, low, high = held
    return tuple(moved), note("smooth_voltage", share=share, low=low, high=high)


def even_clock(fit: Fit) -> Otherwise | None:
    """Return the experiments with samples at even times, and a note; or None.

    None where the stamps are even or farther than half a sample from it, where the error of the
    `fit` does not hold the difference, or a record cannot be simulated.
    """
    experiments = fit.experiments
    even = [_evened(e.record) for e in experiments]
    held = None
    if any(record is not e.record for record, e in zip(even, experiments, strict=True)):
        held = _held(fit, _of_even)
    if held is None:
        return None
    moved = tuple(replace(e, record=record) for e, record in zip(experiments, even, strict=True))
    late = np.concatenate(
        [new.record.time - e.record.time for new, e in zip(moved, experiments, strict=True)]
    )
    share, low, high = held
    rms = float(np.sqrt(np.mean(late**2)))
    return moved, note("even_clock", rms=rms, share=share, low=low, high=high)


def _held(
    fit: Fit, change: Callable[[Fit, int, Record], FloatArray]
) -> tuple[float, float, float] | None:
    """Return the share of a change of displacement (n,) that a fit's error holds, and its interval.

    None where that is neither clearly there nor near to all of it.
    """
    try:
        parts = [
            (np.zeros(e.record.n) if e.held_out_whole else change(fit, k, e.record))[e.used]
            for k, e in enumerate(fit.experiments)
        ]
    except PsaError:
        return None
    basis, _ = np.linalg.qr(fit.jacobian / np.maximum(np.linalg.norm(fit.jacobian, axis=0), 1e-300))
    both = np.concatenate(parts), fit.residuals
    moved, left = (x - basis @ (basis.T @ x) for x in both)
    power = float(moved @ moved)
    if power <= 0.0:
        return None
    share, error = float(moved @ left) / power, float(np.sqrt(np.mean(left**2) / power))
    if not (share > _SURE * error and abs(share - 1.0) < _NEAR):
        return None
    return share, share - 1.96 * error, share + 1.96 * error


def _of_smooth(fit: Fit, number: int, record: Record) -> FloatArray:
    """Return what a smooth voltage changes in a record's displacement (n,) [m].

    Straight lines between twice as many samples of the curve lack a quarter of it.
    """
    time, voltage = np.empty(2 * record.n - 1), np.empty(2 * record.n - 1)
    time[::2], time[1::2] = record.time, _middle(record.time)
    voltage[::2], voltage[1::2] = record.voltage, _middle(record.voltage) + 1.5 * _higher(record)
    finer = Record(
        name=record.name,
        time=time,
        voltage=voltage,
        load_force=_between(record, time, record.load_force),
        temperature=_between(record, time, record.temperature),
    )
    smooth = _shown(fit, number, finer)[::2]
    return np.asarray((smooth - _shown(fit, number, record)) * 4.0 / 3.0)


def _of_even(fit: Fit, number: int, record: Record) -> FloatArray:
    """Return what even times change in a record's displacement (n,) [m]."""
    return _shown(fit, number, _evened(record)) - _shown(fit, number, record)


def _shown(fit: Fit, number: int, record: Record) -> FloatArray:
    start = fit.start(number)
    way, n = fit.way, record.n
    return trace_record(fit.model, record, start, (), stop=n, way=way, by_start=False).y[:, 0]


def _evened(record: Record) -> Record:
    """Return a record with the nearest even times; the record itself if they are not near."""
    places = np.arange(record.n)
    step, first = np.polyfit(places, record.time, 1)
    even = first + step * places
    late = float(np.max(np.abs(record.time - even)))
    return replace(record, time=even) if _ROUNDING * step < late < 0.5 * step else record


def _between(record: Record, time: FloatArray, column: FloatArray | None) -> FloatArray | None:
    return None if column is None else np.interp(time, record.time, column)


def _middle(values: FloatArray) -> FloatArray:
    return 0.5 * (values[1:] + values[:-1])


def _higher(record: Record) -> FloatArray:
    """Return by how much the mean of a smooth curve is above each straight line, (n - 1,) [V].

    A parabola with the second derivative c has a mean that is higher by -h^2 c/12, and is higher by
    1.5 times that in the middle. At a sample, c is the median of the second differences there and
    on either side: a corner has none.
    """
    step = np.diff(record.time)
    bends = np.zeros(record.n + 2)
    bends[2:-2] = np.diff(np.diff(record.voltage) / step) / _middle(step)
    bends = np.median([bends[:-2], bends[1:-1], bends[2:]], axis=0)
    return np.asarray(-(step**2) * _middle(bends) / 12.0)
