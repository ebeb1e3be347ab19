"""What an identification finds: a fitted model, what its records determine, and what to doubt.

The evidence of a fitted model: ranges of its inputs, covariance, runs to simulate again.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from psa_casadi.common.display import Reported, frame, made
from psa_casadi.common.notes import Note, note, texts
from psa_casadi.common.strict_json import json_text
from psa_casadi.common.units import BoolArray, FloatArray
from psa_casadi.identification.determinacy import Determinacy
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.fitting.prediction import OUTPUT, record_start
from psa_casadi.model.compose import Model
from psa_casadi.model.evidence import Covariance, Evidence, RecordRun, ReferenceRun, SeenRange
from psa_casadi.model.variables import Interval, Provenance
from psa_casadi.records.noise import fast_noise, first_order_noise, runs_of
from psa_casadi.records.noise_kinds import NoiseFound, noise_kinds
from psa_casadi.records.record import Record
from psa_casadi.records.signals import Signals
from psa_casadi.records.split import Experiment, noise_share
from psa_casadi.records.suspects import SPIKE
from psa_casadi.simulation.simulate import record_inputs
from psa_casadi.version import __version__

#: A residual above this multiple of its fast noise shows that the model lacks something.
EXCESSIVE = 1.5


@dataclass(frozen=True)
class StartOutcome:
    """One start of a search: its name, the cost and rms it led to, and what became of it.

    `rms` is that of the first output, in its unit; both are nan where it could not be simulated.
    `agrees` is True where it led to the same minimum as the best, False where it led elsewhere,
    None where the quick fit was so much worse that it was not followed to the end.
    """

    name: str
    cost: float
    rms: float
    agrees: bool | None


@dataclass(frozen=True, eq=False, repr=False)
class Identification(Reported):
    """An identified model with the fit behind it, what the data determine, and doubts.

    `starts` are the outcomes of all starts of the search; `notes` what was done to the records
    (samples masked, averaged), which is no doubt. `warnings` and `sentences` are both in words.
    `interrupted`: a keyboard interrupt ended the search, or what came after it.
    `noise_kinds` are those of every output of every record; `notes` say what to do about them.
    """

    model: Model
    fit: Fit
    determinacy: Determinacy
    doubts: tuple[Note | str, ...]
    starts: tuple[StartOutcome, ...] = ()
    notes: tuple[Note | str, ...] = ()
    interrupted: bool = False
    noise_kinds: tuple[NoiseFound, ...] = ()

    def __repr__(self) -> str:
        """Return the parameters with their standard errors, and what is left of the outputs."""
        return str(note("own_identification", identification=self))

    @property
    def experiments(self) -> tuple[Experiment, ...]:
        """The records as they were fitted."""
        return self.fit.experiments

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is to be doubted, in words."""
        return texts(self.doubts)

    @property
    def sentences(self) -> tuple[str, ...]:
        """What was done to the records, and their noise, in words."""
        return texts(self.notes)

    @property
    def errors(self) -> Mapping[str, float]:
        """The standard errors of the fitted parameters, in SI units."""
        return self.determinacy.standard_errors

    @property
    def undetermined(self) -> tuple[str, ...]:
        """The parameters that these records do not determine."""
        return self.determinacy.undetermined

    @cached_property
    def rms(self) -> Mapping[str, float]:
        """What is left of every measured output over all records (rms), in its unit."""
        return residual_rms(self.fit)

    @cached_property
    def noise(self) -> Mapping[str, float]:
        """The fast part of what is left of every measured output (rms), in its unit."""
        return {
            o.column: first_order_noise(o.residuals)[0] * noise_share(self.experiments, o.number)
            for o in self.fit.channels
        }

    def to_frame(self) -> Any:
        """Return the parameters as a pandas DataFrame.

        Value, standard error, 95 % interval, unit and meaning; nan where one was not fitted.
        """
        parameters, nan = self.model.structure.parameters, float("nan")
        intervals = [
            self.model.provenance.intervals.get(p.name, Interval(nan, nan)) for p in parameters
        ]
        columns = {
            "parameter": [p.name for p in parameters],
            "value": [self.model.values[p.name] for p in parameters],
            "error": [self.errors.get(p.name, nan) for p in parameters],
            "low": [i.low for i in intervals],
            "high": [i.high for i in intervals],
            "unit": [p.unit for p in parameters],
            "meaning": [p.description for p in parameters],
        }
        return frame(columns)

    def to_dict(self) -> dict[str, Any]:
        """Return the content of IDENTIFICATION.json."""
        table: dict[str, Any] = made("identification_file", self)
        return table

    def to_json(self) -> str:
        """Return the text of IDENTIFICATION.json."""
        return json_text(self.to_dict())


def residual_rms(fit: Fit) -> dict[str, float]:
    """Return what a fit leaves of every measured output over all records (rms), in its unit."""
    table = {}
    for o in fit.channels:
        rows = zip(o.records, o.parts, strict=True)
        left = np.concatenate([p * fit.experiments[k].share(o.number) for k, p in rows])
        table[o.column] = float(np.sqrt(np.mean(left**2)))
    return table


def doubts_of(
    fit: Fit,
    determinacy: Determinacy,
    starts: Sequence[StartOutcome],
    not_unique: Sequence[str] = (),
) -> list[Note]:
    """Return what of a fit is to be doubted: its end, its minimum, what is open or on a bound.

    `not_unique` names parameters that equally good fits differ in.
    """
    doubts = []
    if fit.interrupted or not fit.converged:
        doubts.append(note("interrupted" if fit.interrupted else "cut_off"))
    if not_unique:
        doubts.append(note("not_unique", names=not_unique))
    elif len(starts) > 1 and sum(bool(s.agrees) for s in starts) == 1:
        doubts.append(note("one_start", starts=len(starts)))
    doubts += [note("on_bound", name=name) for name in determinacy.on_bound]
    alone = [n for n in determinacy.undetermined if n not in not_unique]
    return [*doubts, note("undetermined", names=alone)] if alone else doubts


def with_origin(
    model: Model,
    records: Sequence[Record | Signals],
    free: Sequence[str],
    intervals: Mapping[str, Interval],
    **more: Any,
) -> Model:
    """Return a fitted model with its records and the intervals of its values as its provenance.

    `more` are other fields of `Provenance` by name.
    """
    provenance = Provenance(
        identified_from=tuple((r.name, r.sha256) for r in records),
        package_version=__version__,
        free=tuple(free),
        intervals=intervals,
        hold=records[0].hold,
        **more,
    )
    return replace(model, provenance=provenance, evidence=None)


def noise_found(fit: Fit, arguments: Sequence[Record | Signals] = ()) -> tuple[NoiseFound, ...]:
    """Return the kinds of noise in every output of every record, fitted and held-out samples.

    The noise is that of the samples as they were measured, not of averages or without outliers; the
    prediction is a straight line between those of the experiments' samples. The model is simulated
    once more. Raises SimulationError where it cannot be.
    """
    result = list[NoiseFound]()
    for e, predicted in zip(fit.experiments, fit.predicted_channels(), strict=True):
        times = e.record.time
        whole = next((r for r in arguments if _holds(r, e)), e.record)
        inside = (whole.time >= times[0]) & (whole.time <= times[-1])
        time = whole.time[inside]
        named = [c for n in fit.model.input_names if (c := whole.column(n)) is not None]
        moving = [u[inside] for u in named if np.isfinite(u).all() and np.ptp(u[inside]) > 0.0]
        near = np.searchsorted(0.5 * (times[1:] + times[:-1]), time)
        for j, channel in enumerate(e.channels):
            reading = whole.column(channel.column)
            if reading is None or not np.isfinite(predicted[:, j]).any():
                continue
            y = np.interp(time, times, predicted[:, j])
            inputs = sorted(moving, key=lambda u: -_correlation(u, y))
            used = _used(e, j)[near]
            kinds = noise_kinds(time, reading[inside], y, inputs, used)
            result.append(NoiseFound(e.record.name, channel.column, channel.unit, kinds))
    return tuple(result)


def _holds(record: Record | Signals, e: Experiment) -> bool:
    """Whether an experiment's record was made of a record: of its file, within its time."""
    starts, ends = e.record.time[0], e.record.time[-1]
    within = record.time[0] <= starts and ends <= record.time[-1]
    return bool(record.sha256 == e.record.sha256 and within)


def _used(e: Experiment, channel: int) -> BoolArray:
    """Return the samples (n,) that are fitted or judged, and outliers that are masked there."""
    used = e.at(channel, e.used | e.held_out)
    for start, stop in runs_of(~used):
        used[start:stop] = stop - start <= SPIKE
    return used


def _correlation(u: FloatArray, y: FloatArray) -> float:
    """Return the size of the correlation of an input with an output (n,), 0 where there is none."""
    return abs(float(np.corrcoef(u, y)[0, 1])) if np.ptp(y) > 0.0 and np.ptp(u) > 0.0 else 0.0


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
        errors = e.record.measured - y
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
    y = record.measured[kept]
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
