"""The evidence of a fitted model: ranges of its inputs, covariance, runs to simulate again."""

from collections.abc import Sequence

import numpy as np

from psa_casadi.common.units import FloatArray
from psa_casadi.identification.determinacy import Determinacy
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.fitting.prediction import OUTPUT, measured, record_start
from psa_casadi.model.compose import Model
from psa_casadi.model.evidence import (
    Covariance,
    Evidence,
    RecordRun,
    ReferenceRun,
    SeenRange,
)
from psa_casadi.model.variables import Interval
from psa_casadi.records.noise import fast_noise, runs_of
from psa_casadi.records.record import Record
from psa_casadi.simulation.simulate import record_inputs

#: The most samples of a reference run, and what straight lines between them may miss the voltage
#: by, over its range.
_LONGEST, _MISSED = 300, 2e-3
#: Digits of a reference run's samples, of their largest value.
_DIGITS = 7
#: Differences of neighbouring samples are noise up to this many of its standard deviations.
_NOISE = 6.0 * np.sqrt(2.0)


def evidence_of(
    fit: Fit,
    determinacy: Determinacy,
    predicted: Sequence[FloatArray],
    *,
    by: str,
    sampled: Sequence[Record] = (),
) -> Evidence:
    """Return the evidence of a fit: ranges of the inputs, covariance, runs to simulate again.

    `predicted` [m] are the records in full, in the order of the experiments; `sampled` the records
    before block averages, if there are any. Held-out samples have the error of the
    runs; its interval and the budget are the diagnosis's to add.
    """
    model, records = fit.model, [e.record for e in fit.experiments]
    runs, used, theta = [], [], fit.placed()
    for k, (e, y) in enumerate(zip(fit.experiments, predicted, strict=True)):
        x0 = record_start(model, e.record, fit.unknowns.start(theta, k))
        errors = measured(e.record) - y
        inputs = sampled[k] if sampled else e.record
        used.append(errors[e.used])
        runs.append(
            RecordRun(
                record=e.record.name,
                sha256=e.record.sha256,
                start=dict(zip(model.state_names, x0.tolist(), strict=True)),
                offset_m=float(y[0]) - _shown(model, e.record, x0),
                samples=e.record.n,
                averaged=max(1, round(e.record.sample_time / inputs.sample_time)),
                fitted_m=_rms(errors[e.known]),
                held_out_m=_rms(errors[e.held_out]) if e.held_out.any() else None,
                held_out=tuple(runs_of(e.held_out)),
            )
        )
    chosen = next((k for k, e in enumerate(fit.experiments) if e.held_out_whole), 0)
    matrix = 0.5 * (determinacy.covariance + determinacy.covariance.T)
    known = np.isfinite(matrix).all()  # without names where it has overflowed
    rows = tuple(tuple(row) for row in matrix.tolist())
    return Evidence(
        by=by,
        fitted_m=_rms(np.concatenate(used)),
        seen=_ranges(records),
        covariance=Covariance(determinacy.names, rows) if known else Covariance((), ()),
        runs=tuple(runs),
        reference=_reference(model, records[chosen]),
        outside=tuple(c.name for c in model.effects if not c.in_plant),
        unnamed=tuple(c.description for c in model.effects if c.name.startswith("patch")),
    )


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0


def _shown(model: Model, record: Record, x0: FloatArray) -> float:
    """Return what the sensor shows at the start of a record, without an offset [m]."""
    inputs = record_inputs(model, record, 1)[0]
    y = np.array(model.structure.f(0.0, x0, inputs, model.parameter_vector())[1]).ravel()
    return float(y[model.output_names.index(OUTPUT)])


def _ranges(records: Sequence[Record]) -> SeenRange:
    warm = [t for r in records if (t := r.temperature) is not None]
    rates = []
    for r in records:  # the largest, beyond what the voltage's white noise makes
        moved = np.abs(np.diff(r.voltage)) - _NOISE * fast_noise(r.voltage)
        rates.append(max(0.0, float(np.max(moved / np.diff(r.time)))))
    return SeenRange(
        voltage=_interval([r.voltage for r in records]),
        rate=max(rates),
        duration=max(r.duration for r in records),
        temperature=_interval(warm) if warm else None,
    )


def _interval(columns: Sequence[FloatArray]) -> Interval:
    return Interval(min(float(c.min()) for c in columns), max(float(c.max()) for c in columns))


def _reference(model: Model, record: Record) -> ReferenceRun:
    """Return the longest first part of a record whose voltage `_LONGEST` samples interpolate."""
    stride = 1
    while stride < record.n // 8 and _is_interpolated(record, 2 * stride):
        stride *= 2
    kept = np.arange(0, min(record.n, _LONGEST * stride), stride)
    columns = {n: getattr(record, n, None) for n in model.input_names}
    y = measured(record)[kept]
    valid = np.isfinite(y)
    rounded = iter(_rounded(y[valid]))
    return ReferenceRun(
        record=record.name,
        time=tuple(round(float(t), 12) for t in record.time[kept] - record.time[0]),
        inputs={n: _rounded(c[kept]) for n, c in columns.items() if c is not None},
        displacement=tuple(next(rounded) if v else None for v in valid),
    )


def _is_interpolated(record: Record, stride: int) -> bool:
    """Whether straight lines between every `stride`-th sample follow the voltage."""
    part = slice(0, min(record.n, (_LONGEST - 1) * stride + 1))
    time, voltage = record.time[part], record.voltage[part]
    lines = np.interp(time, time[::stride], voltage[::stride])
    last = (len(time) - 1) // stride * stride + 1
    misfit = np.abs(lines - voltage)[:last]
    return bool(np.max(misfit) <= _MISSED * max(float(np.ptp(record.voltage)), 1e-300))


def _rounded(values: FloatArray) -> tuple[float, ...]:
    largest = float(np.max(np.abs(values), initial=0.0))
    digits = _DIGITS - 1 - int(np.floor(np.log10(largest))) if largest > 0.0 else 0
    return tuple(round(float(v), digits) + 0.0 for v in values)
