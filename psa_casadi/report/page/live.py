"""A model that runs in a page: its module and variables, the records that it runs on."""

import base64
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from psa_casadi.common.errors import InputError
from psa_casadi.common.units import FloatArray, IndexArray, convert
from psa_casadi.diagnosis.result import Diagnosis, StackDiagnosis
from psa_casadi.export.web import future_module
from psa_casadi.identification.experiments import varied
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.fitting.prediction import record_start
from psa_casadi.identification.grades import determined
from psa_casadi.identification.result import Identification
from psa_casadi.model.component import Component
from psa_casadi.model.compose import Model
from psa_casadi.model.effects.patches import GAIN
from psa_casadi.model.model_file import dumps
from psa_casadi.model.variables import Output, Parameter, State
from psa_casadi.records.signals import Hold, Signals
from psa_casadi.report.page.document import packed
from psa_casadi.report.words import colours
from psa_casadi.report.words.phrases import added, handy_scale, in_brackets, length_scale, plain
from psa_casadi.report.words.series import Curve, Series, spans
from psa_casadi.simulation.compiler import INSTALL_ZIG, has_zig
from psa_casadi.simulation.exact.run import EQUAL_STEPS
from psa_casadi.simulation.simulate import input_samples, output_of
from psa_casadi.simulation.start import is_stack
from psa_casadi.simulation.stepper import run

#: Samples of all records in a page, and records; of more, those that the model misses most.
_SAMPLES, _RECORDS = 12_000, 6
#: Left-out samples may be off the line between their neighbours by this share of the range.
_BENT = 5e-3
#: A parameter that spans decades is moved by this factor to both sides.
_DECADES = 10.0
#: Reach of a slider to both sides, at least, in half widths of the 95 % interval.
_HALF_WIDTHS = 2.0
#: Reach of a slider from a value of 0, in ordinary changes.
_TYPICAL = 4.0
#: The number for an infinite bound: JSON has none.
_NO_BOUND = 1e300


@dataclass(frozen=True, eq=False)
class LiveRecord:
    """An output of a record that a model runs on, with the model's curve, as fitted, as its last.

    `inputs` are arrays (n,) in SI units by name, between samples by `hold`; a loop is drawn
    over the one `along`. `deviation` holds the start of states off where a stack's voltage puts
    them, any other model starts at the states `start` (nx,). A sensor with an `offset` has it
    estimated again. `floor` is the noise that errors are judged by, `correction` what an unnamed
    correction adds. It starts in motion, or at `rest`.
    """

    series: Series
    inputs: Mapping[str, FloatArray]
    deviation: Mapping[str, float] = field(default_factory=dict)
    floor: float = 0.0
    correction: FloatArray | None = None
    rest: bool = False
    output: str = ""
    along: str = "voltage"
    start: FloatArray | None = None
    hold: Hold = "linear"
    offset: bool = True

    @property
    def residual(self) -> FloatArray:
        """The residual of the fitted model."""
        return self.series.residual(self.series.curves[-1])


@dataclass(frozen=True, eq=False)
class LiveModel:
    """A model for a page, with its module, which is being compiled.

    `aim` is what it is compared with; a `design` has neither noise nor a sensor with an offset.
    """

    model: Model
    module: "Future[bytes | None]"
    records: Sequence[LiveRecord]
    aim: str = "measured"
    design: bool = False
    extended: bool = False
    correction: str = ""

    def page_data(self) -> dict[str, Any] | None:
        """Return the data for live.js, once the module is compiled; None without a module."""
        module = self.module.result()
        if module is None:
            return None
        records = sorted(self.records, key=lambda r: r.series.miss(-1), reverse=True)[:_RECORDS]
        first, counts = records[0].series, any(r.series.counts for r in self.records)
        largest = max(float(np.nanmax(np.abs(r.residual))) for r in records)
        length = handy_scale(first.span, counts=counts)
        error = length_scale(largest or 1e-2 * first.span, counts=counts)
        limit, rows = _SAMPLES // len(records), []
        for r in records:
            s = r.series  # of a stack all records have the same units
            units = (s.scale, s.residual_scale) if s.unit else (length, error)
            over = f"{s.title} over {r.along}" if r.along else ""
            labels = map(in_brackets, (s.quantity, "difference"), (q.unit for q in units))
            row = _record(r, limit, self.design)
            row |= {n: asdict(q) for n, q in zip(("length", "error"), units, strict=True)}
            difference = f"{self.aim} minus model".capitalize()
            row["captions"] = [f"{s.title} over time", over, difference]
            row["labels"] = [next(labels), s.against, next(labels)]
            rows.append(row)
        return {
            "kind": "report",
            **live_data(self.model, module),
            "records": rows,
            "time": asdict(first.time_scale),
            **{n: getattr(self, n) for n in ("extended", "design", "aim", "correction")},
            "legend": [["--measured", self.aim], ["--model", "model"], ["--fitted", "as it was"]],
        }

    def cure(self) -> str:
        """Return why the model does not run in the page, and the remedy."""
        if self.model.structure.foreign:
            return "It is an imported FMU, of which a page has no equations."
        if self.model.sampled_names:
            return "It has sampled states, which no page runs."
        return "" if has_zig() else f"It takes a compiler: {INSTALL_ZIG}"


def live_diagnosis(d: StackDiagnosis | Diagnosis, rows: Sequence[Series]) -> LiveModel:
    """Start to compile the model of a diagnosis for its page; `rows` are its series."""
    module, beyond, share, text = future_module(d.model), list[FloatArray](), 1.0, ""
    if isinstance(d, StackDiagnosis):
        # the page's other errors are judged by the noise of all records together
        share = d.noise_floor_rms_m / (float(np.sqrt(np.mean([s.noise**2 for s in rows]))) or 1.0)
        if d.patch is not None:
            beyond = [p - x for p, x in zip(d.patch.predicted, d.extended, strict=True)]
            text = f"{d.patch.name}, as it was fitted: it does not follow"
    records = _fitted_records(d, d.extended_fit, rows, beyond, share)
    return LiveModel(d.model, module, records, extended=added(d), correction=text)


def live_fit(identification: Identification, rows: Sequence[Series]) -> LiveModel:
    """Start to compile the model of an identification for its page; `rows` are its series."""
    records = _fitted_records(identification, identification.fit, rows)
    return LiveModel(identification.model, future_module(identification.model), records)


def live_design(
    model: Model,
    record: tuple[FloatArray, FloatArray, FloatArray],
    wanted: FloatArray | None = None,
    *,
    rest: bool = False,
) -> LiveModel:
    """Start to compile a model that runs on a designed voltage.

    `record` is time [s], voltage [V] and the model's displacement [m]; `wanted` the path that it is
    to follow, where there is one. The model starts in motion, or at `rest`.
    """
    time, voltage, displacement = record
    aim, words = (displacement, "design") if wanted is None else (wanted, "path")
    curve, none = Curve("model", colours.EXTENDED, displacement), np.zeros(len(time), dtype=bool)
    series = Series("design", time, voltage, aim, (curve,), none, noise=0.0, counts=False)
    row = LiveRecord(series, {"voltage": voltage}, rest=rest)
    return LiveModel(model, future_module(model), [row], aim=words, design=True)


def live_experiment(model: Model, record: Signals) -> LiveModel:
    """Start to compile any model but a stack that runs on a designed record."""
    s, time = model.structure, record.time - record.time[0]
    start = np.array([q.start for q in s.states])
    u = input_samples(model, record.n, record.columns)
    outputs = run(model, time, u, start, hold=record.hold).y.T
    along, none = next(iter(record.columns)), np.zeros(record.n, dtype=bool)
    live_record = partial(LiveRecord, along=along, start=start, hold=record.hold)
    rows = []
    for output, y in zip(s.outputs, outputs, strict=True):
        series = Series(
            output.name, time, record.columns[along], y, (Curve("model", colours.EXTENDED, y),),
            none, noise=0.0, counts=False, quantity=output.name, unit=output.unit,
            against=in_brackets(along, record.units[along]),
        )  # fmt: skip
        rows.append(live_record(series, record.columns, output=output.name))
    return LiveModel(model, future_module(model), rows, aim="design", design=True)


def _fitted_records(
    result: Diagnosis | Identification,
    fit: Fit,
    series: Sequence[Series],
    beyond: Sequence[FloatArray] = (),
    share: float = 1.0,
) -> list[LiveRecord]:
    """Return the records of a fit; `beyond` is what an unnamed correction adds to each.

    `share` is what counts of each record's noise where errors are judged.
    """
    model, experiments, rows = result.model, result.experiments, []
    theta, stack = fit.placed(), is_stack(model)
    for s in series:
        k, j = s.place
        e, channel = experiments[k], experiments[k].channels[j]
        columns = {i: e.record.column(i) for i in model.input_names}
        inputs = {i: v for i, v in columns.items() if v is not None}
        deviation = fit.unknowns.start(theta, k)
        row = LiveRecord(s, inputs, deviation, share * s.noise, beyond[k] if beyond else None)
        if not stack:
            row = replace(
                row, deviation={}, start=record_start(model, e.record, deviation),
                output=channel.outputs[0], along=varied(model, e) or "", hold=e.record.hold,
                offset=channel.offset,
            )  # fmt: skip
        rows.append(row)
    return rows


def _record(r: LiveRecord, limit: int, design: bool) -> dict[str, Any]:
    """Return a record as a page holds it, in SI units, its time from its first sample on."""
    s = r.series
    part, note = thinned(s.time, [*r.inputs.values()], limit)
    t = s.time[part] - s.time[0]
    residual = r.residual[part]
    fitted = np.isfinite(residual) & ~s.held_out[part]
    even = len(t) > 2 and float(np.ptp(np.diff(t))) <= EQUAL_STEPS * float(t[1])
    return {
        "name": s.name,
        "note": note,
        "t": None if even else doubles(t),
        "n": len(t),
        "step": float(t[-1] / (len(t) - 1)),
        "inputs": {n: doubles(v[part]) for n, v in r.inputs.items()},
        "measured": singles(s.measured[part]),
        "held": spans(s.held_out[part]),
        "center": float(np.mean(residual[fitted])) if fitted.any() else 0.0,
        "deviation": dict(r.deviation),
        "start": None if r.start is None else r.start.tolist(),
        "hold": r.hold,
        "output": r.output,
        "along": r.along,
        "offset": r.offset and not design,
        "noise": s.noise,
        "floor": r.floor or s.noise,
        "rest": r.rest,
        "range": s.span,
        "base": 0.0 if design else s.judged_rms(s.curves[0]),
        "correction": None if r.correction is None else singles(r.correction[part]),
    }


def thinned(t: FloatArray, inputs: Sequence[FloatArray], limit: int) -> tuple[IndexArray, str]:
    """Return at most `limit` samples of a record, and a note on their choice.

    They are evenly spaced if the inputs are straight between them, else the first ones: the
    response to a voltage with its corners cut is that to another voltage.
    """
    n = len(t)
    if n <= limit:
        return np.arange(n), ""
    every = -(-n // limit)
    part = np.arange(0, n, every)
    last = part[-1] + 1
    off = [np.max(np.abs(np.interp(t[:last], t[part], v[part]) - v[:last])) for v in inputs]
    if all(most <= _BENT * float(np.ptp(v)) for most, v in zip(off, inputs, strict=True)):
        return part, f"Of {n} samples each {every}th is here; the model runs on these."
    return np.arange(limit), f"Of {n} samples these are the first {limit}."


def doubles(values: npt.ArrayLike) -> str:
    """Return numbers as a page holds them, without any loss."""
    return base64.b64encode(np.asarray(values, dtype="<f8").tobytes()).decode("ascii")


def singles(values: npt.ArrayLike) -> str:
    """Return numbers in single precision, nan where missing."""
    return base64.b64encode(np.asarray(values, dtype="<f4").tobytes()).decode("ascii")


def live_data(model: Model, module: bytes) -> dict[str, Any]:
    """Return a model for `psaLive.load`, all values in SI units.

    Each parameter has `unit`, in which a page shows it, with `factor` and `shift`: displayed =
    factor * value + shift; and the ends of its slider.
    """
    try:
        file = dumps(model)
    except InputError:  # no file holds such a model
        file = None
    main, s, known = output_of(model), model.structure, determined(model)
    nominals = dict(zip(model.output_names, model.output_nominals(), strict=True))
    return {
        "name": model.name,
        "wasm": packed(module),
        "parameters": [_parameter(model, p, p.name in known) for p in s.parameters],
        "effects": [_effect(model, c) for c in model.effects],
        "inputs": [{"name": i.name, "unit": i.unit, "start": i.start} for i in s.inputs],
        "outputs": [_variable(o) for o in s.outputs],
        "states": [{**_variable(q), "start": q.start} for q in s.states],
        "nominals": model.state_nominals().tolist(),
        "error_sizes": model.error_sizes().tolist(),
        "shown": main,
        "shown_nominal": 0.0 if main is None else float(nominals[main]),
        "starts_itself": model.starts_itself,
        "file": file,
    }


def _variable(v: State | Output) -> dict[str, Any]:
    return {"name": v.name, "description": v.description, "si": v.unit, **_scale(v)}


def _scale(v: State | Output | Parameter) -> dict[str, Any]:
    unit = v.display_unit or v.unit
    shift = convert(0.0, v.unit, unit)
    return {"unit": unit, "factor": convert(1.0, v.unit, unit) - shift, "shift": shift}


def _parameter(model: Model, p: Parameter, known: bool) -> dict[str, Any]:
    interval = model.provenance.intervals.get(p.name)
    sure = [interval.low, interval.high] if interval is not None else []
    ends = _ends(model, p)
    return {
        "name": p.name,
        "description": p.description,
        **_scale(p),
        "value": model.values[p.name],
        "bounds": np.clip(p.bounds, -_NO_BOUND, _NO_BOUND).tolist(),
        "ends": list(ends),
        "log": p.log and ends[0] > 0.0,
        "interval": sure if np.isfinite(sure).all() and sure else None,
        "determined": known,
    }


def _ends(model: Model, p: Parameter) -> tuple[float, float]:
    """Return the ends of a parameter's slider: within its bounds, well beyond its interval."""
    value, (low, high) = model.values[p.name], p.bounds
    if p.log and value > 0.0:
        return max(low, value / _DECADES), min(high, value * _DECADES)
    interval = model.provenance.intervals.get(p.name)
    half = 0.5 * (interval.high - interval.low) if interval is not None else 0.0
    wide = _HALF_WIDTHS * half if np.isfinite(half) else 0.0
    reach = max(abs(value), min(wide, 10.0 * abs(value)))
    if value == 0.0:
        reach = max(reach, _TYPICAL * p.typical({**model.values, p.name: 0.0}))
    return max(low, value - reach), min(high, value + reach)


def _effect(model: Model, effect: Component) -> dict[str, Any]:
    gain = model.parameter(effect.gain or "")
    value = model.values[gain.name]
    ordinary = gain.typical({**model.values, gain.name: 0.0})
    return {
        "name": effect.name,
        "title": "unnamed correction" if effect.gain == GAIN else plain(effect.name),
        "description": effect.looks_like or effect.description,
        "gain": gain.name,
        "on": value if value != 0.0 else float(np.clip(ordinary, *gain.bounds)),
        "parameters": [p.name for p in effect.parameters],
    }
