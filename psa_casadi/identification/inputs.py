"""How inputs are read: held or straight lines between samples, noisy or smoothed."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np
import scipy
from numpy.lib.stride_tricks import sliding_window_view

from psa_casadi.errors import PsaError
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.fitting.further import Further
from psa_casadi.identification.multistart import search_starts
from psa_casadi.identification.refitting import refit, relevelled, weighted
from psa_casadi.notes import Note, note
from psa_casadi.records.noise import fast_noise
from psa_casadi.records.signals import Hold
from psa_casadi.records.split import Experiment
from psa_casadi.units import FloatArray

#: Nats by which inputs that are read another way must be likelier: a cause's price.
LIKELIER = 8.0
#: Order of the autoregression of a residual.
_ORDER = 8
#: Noise of an input that is smoothed, over its standard deviation, and at most: what moves from
#: sample to sample is no noise.
_NOISY, _MOVING = 0.005, 0.3


def read_otherwise(
    of: Fit, experiments: Sequence[Experiment], *, undecided: bool
) -> tuple[Fit, tuple[Experiment, ...], tuple[Note, ...]]:
    """Return the fit with inputs as they are likelier read, and what is said of that.

    Held or straight lines between samples, where that is `undecided`; then straight lines through
    noisy readings, or through smoothed ones.
    """
    best, read, statement = of, tuple(experiments), tuple[Note, ...]()
    if undecided and (other := held_otherwise(best, read)):
        best, read, output = other
        statement = (output,)
    if other := _smoothed_instead(best, read):
        best, read, output = other
        statement = (*statement, output)
    return best, read, statement


def read_like(
    experiments: Sequence[Experiment], hold: Hold, notes: Sequence[Note]
) -> tuple[Experiment, ...]:
    """Return experiments whose inputs are read as those were of which that was `notes`."""
    result = held_as(experiments, hold)
    names = [
        n for output in notes if output.code == "inputs_smoothed" for n in output.values["inputs"]
    ]
    return tuple(_smoothed(e, names)[0] for e in result)


def _smoothed_instead(
    of: Fit, experiments: Sequence[Experiment]
) -> tuple[Fit, tuple[Experiment, ...], Note] | None:
    """Return the fit with noisy inputs smoothed, where that is `LIKELIER`.

    Noise that is read at an input passes through the model: it adds to the residual, and bends the
    parameters (errors in variables).
    """
    pairs = [_smoothed(e, of.model.input_names) for e in experiments]
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


def held_otherwise(
    of: Fit, experiments: Sequence[Experiment]
) -> tuple[Fit, tuple[Experiment, ...], Note] | None:
    """Return the fit with inputs the other way between samples, where that is `LIKELIER`.

    All inputs of all records are held, or none is.
    """
    hold = other_hold(experiments)
    return _instead(of, held_as(experiments, hold), "hold_found", hold=hold)


def _instead(
    of: Fit, others: Sequence[Experiment], code: str, **values: Any
) -> tuple[Fit, tuple[Experiment, ...], Note] | None:
    """Return the fit of other experiments and its note, where it is `LIKELIER`."""
    try:
        fit = refitted(of, others)
    except PsaError:
        return None
    nats = likelier(fit, of)
    if nats < LIKELIER:
        return None
    best, again = relevelled(fit, others, every=True)
    return best, again, note(code, **values, nats=nats)


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
    """Fit other experiments of as many records from where a fit stands, or from its values alone.

    Raises SimulationError.
    """
    try:
        return refit(of, weighted(of, others), sigma=of.sigma, tolerance=1e-6)
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
