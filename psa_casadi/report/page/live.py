"""A model that runs in a page: its module and variables, the records that it runs on."""

import base64
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from psa_casadi.component import Component
from psa_casadi.diagnosis.result import Diagnosis
from psa_casadi.effects.patches import GAIN
from psa_casadi.errors import InputError
from psa_casadi.export.web import begun_module
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.identify import Identification
from psa_casadi.model.compose import Model
from psa_casadi.model.model_file import dumps
from psa_casadi.records.split import Experiment
from psa_casadi.report.page.document import packed
from psa_casadi.report.words.fit_words import determined
from psa_casadi.report.words.phrases import added, handy_scale, length_scale, plain, shown_in
from psa_casadi.report.words.series import Series, spans, time_scale
from psa_casadi.simulation.compiler import INSTALL_ZIG, has_zig
from psa_casadi.simulation.exact.run import ALIKE
from psa_casadi.simulation.ways import output_of
from psa_casadi.units import convert
from psa_casadi.variables import Parameter

FloatArray = npt.NDArray[np.float64]
IndexArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

#: Samples of all records in a page, and records; of more, those that the model misses most.
_SAMPLES, _RECORDS = 12_000, 6
#: Left-out samples may be off the line between their neighbours by this share of the range.
_BENT = 5e-3
#: A parameter that spans decades is moved by this factor to both sides.
_DECADES = 10.0
#: A slider reaches so many half widths of the 95 % interval to both sides, at least.
_HALF_WIDTHS = 2.0
#: And from 0 so many ordinary changes.
_TYPICAL = 4.0
#: What stands for an infinite bound: JSON has none.
_NO_BOUND = 1e300


@dataclass(frozen=True, eq=False)
class LiveRecord:
    """A record that a model runs on, arrays (n,) in SI units: what it is compared with, and how.

    `deviation` holds the start of states off where the voltage puts them, `center` the residual of
    the model as it was fitted, `floor` the noise that errors are judged by (0: `noise`), `base` the
    base model's rms error, `correction` what an unnamed correction adds. It begins in motion, or
    at `rest`.
    """

    name: str
    time: FloatArray
    inputs: Mapping[str, FloatArray]
    measured: FloatArray
    held_out: BoolArray
    residual: FloatArray
    deviation: Mapping[str, float]
    noise: float
    floor: float = 0.0
    base: float = 0.0
    correction: FloatArray | None = None
    rest: bool = False


@dataclass(frozen=True, eq=False)
class LiveModel:
    """A model that a page is to hold, with the compilation of its module that has begun.

    `aim` is what it is compared with; a `design` has neither noise nor a sensor with an offset.
    """

    model: Model
    module: "Future[bytes | None]"
    records: Sequence[LiveRecord]
    aim: str = "measured"
    design: bool = False
    extended: bool = False
    correction: str = ""
    counts: bool = False

    def told(self) -> dict[str, Any] | None:
        """Return what live.js must know, once the module is there; None where there is none."""
        module = self.module.result()
        return None if module is None else _told(self, module)

    def cure(self) -> str:
        """Return what would make the model run in the page."""
        return "" if has_zig() else f"It takes a compiler: {INSTALL_ZIG}"


def live_diagnosis(d: Diagnosis, rows: Sequence[Series]) -> LiveModel:
    """Begin what makes the model of a diagnosis alive; `rows` are its `series_of`."""
    patch = d.patch
    beyond = (
        [] if patch is None else [p - x for p, x in zip(patch.predicted, d.extended, strict=True)]
    )
    # the page's other errors are judged by the noise of all records together
    share = d.noise_floor_rms_m / (float(np.sqrt(np.mean([s.noise**2 for s in rows]))) or 1.0)
    return LiveModel(
        model=d.model,
        module=begun_module(d.model),
        records=_fitted_records(d.model, d.extended_fit, d.experiments, rows, beyond, share),
        extended=added(d),
        correction="" if patch is None else f"{patch.name}, as it was found: it does not follow",
        counts=any(s.counts for s in rows),
    )


def live_fit(found: Identification, rows: Sequence[Series]) -> LiveModel:
    """Begin what makes the model of an identification alive; `rows` are its `series_of_fit`."""
    return LiveModel(
        model=found.model,
        module=begun_module(found.model),
        records=_fitted_records(found.model, found.fit, found.experiments, rows, []),
        counts=any(s.counts for s in rows),
    )


def live_design(
    model: Model,
    record: tuple[FloatArray, FloatArray, FloatArray],
    wanted: FloatArray | None = None,
    *,
    rest: bool = False,
) -> LiveModel:
    """Begin what lets a model run on a designed voltage.

    `record` is time [s], voltage [V] and the model's displacement [m]; `wanted` the path that it is
    to follow, where there is one. The model begins in motion, or at `rest`.
    """
    time, voltage, shown = record
    aim = shown if wanted is None else wanted
    row = LiveRecord(
        name="design", time=time, inputs={"voltage": voltage}, measured=aim,
        held_out=np.zeros(len(time), dtype=bool), residual=aim - shown, deviation={}, noise=0.0,
        rest=rest,
    )  # fmt: skip
    words = "design" if wanted is None else "path"
    return LiveModel(model, begun_module(model), [row], aim=words, design=True)


def _fitted_records(
    model: Model,
    fit: Fit,
    experiments: Sequence[Experiment],
    series: Sequence[Series],
    beyond: Sequence[FloatArray],
    share: float = 1.0,
) -> list[LiveRecord]:
    """Return the records of a fit; `beyond` is what an unnamed correction adds to each.

    `share` is what counts of each record's noise where errors are judged.
    """
    theta = fit.placed(experiments)
    rows = []
    for k, (e, s) in enumerate(zip(experiments, series, strict=True)):
        columns = {n: getattr(e.record, n, None) for n in model.input_names}
        rows.append(
            LiveRecord(
                name=s.name,
                time=s.time,
                inputs={n: v for n, v in columns.items() if v is not None},
                measured=s.measured,
                held_out=s.held_out,
                residual=s.residual(s.curves[-1]),
                deviation=fit.unknowns.start(theta, k),
                noise=s.noise,
                floor=share * s.noise,
                base=_judged_rms(s.residual(s.curves[0]), s.held_out),
                correction=beyond[k] if beyond else None,
            )
        )
    return rows


def _told(live: LiveModel, module: bytes) -> dict[str, Any]:
    shown = sorted(live.records, key=_miss, reverse=True)[:_RECORDS]
    first, counts = shown[0], live.counts
    time = time_scale(float(first.time[-1] - first.time[0]))
    length = handy_scale(_range(first), counts=counts)
    largest = max(float(np.nanmax(np.abs(r.residual))) for r in shown)
    error = length_scale(largest or 1e-2 * _range(first), counts=counts)
    legend = [["--measured", live.aim], ["--model", "model"], ["--fitted", "as it was"]]
    return {
        "kind": "report",
        **live_data(live.model, module),
        "records": [_record(r, _SAMPLES // len(shown)) for r in shown],
        **{
            name: {"unit": scale.unit, "factor": scale.factor}
            for name, scale in (("time", time), ("length", length), ("error", error))
        },
        "extended": live.extended,
        "design": live.design,
        "aim": live.aim,
        "correction": live.correction,
        "legend": legend,
        "captions": {
            "time": "Displacement over time",
            "loop": "Displacement over voltage",
            "residual": f"{live.aim} minus model".capitalize(),
        },
    }


def _miss(r: LiveRecord) -> float:
    """Return the error over the spread, by which records are chosen."""
    return float(np.sqrt(np.nanmean(r.residual**2))) / (float(np.nanstd(r.measured)) or 1.0)


def _range(r: LiveRecord) -> float:
    return float(np.nanmax(r.measured) - np.nanmin(r.measured))


def _judged_rms(residual: FloatArray, held_out: BoolArray) -> float:
    """Return the rms of a residual over the samples held out, or all if none is."""
    counted = held_out if held_out.any() else np.ones(len(residual), dtype=bool)
    return float(np.sqrt(np.nanmean(residual[counted] ** 2)))


def _record(r: LiveRecord, limit: int) -> dict[str, Any]:
    """Return a record as a page holds it, in SI units, its time from its own first sample on."""
    part, note = thinned(r.time, r.inputs["voltage"], limit)
    t = r.time[part] - r.time[0]
    residual = r.residual[part]
    fitted = np.isfinite(residual) & ~r.held_out[part]
    even = len(t) > 2 and float(np.ptp(np.diff(t))) <= ALIKE * float(t[1])
    return {
        "name": r.name,
        "note": note,
        "t": None if even else doubles(t),
        "n": len(t),
        "step": float(t[-1] / (len(t) - 1)),
        "inputs": {n: doubles(v[part]) for n, v in r.inputs.items()},
        "measured": singles(r.measured[part]),
        "held": spans(r.held_out[part]),
        "center": float(np.mean(residual[fitted])) if fitted.any() else 0.0,
        "deviation": dict(r.deviation),
        "noise": r.noise,
        "floor": r.floor or r.noise,
        "rest": r.rest,
        "range": _range(r),
        "base": r.base,
        "correction": None if r.correction is None else singles(r.correction[part]),
    }


def thinned(t: FloatArray, v: FloatArray, limit: int) -> tuple[IndexArray, str]:
    """Return at most `limit` samples of a record and what must be said of them.

    Every so-manieth one if the voltage is straight between them, else those of the beginning: a
    model's answer to a voltage with its corners cut is that to another voltage.
    """
    n = len(t)
    if n <= limit:
        return np.arange(n), ""
    every = -(-n // limit)
    part = np.arange(0, n, every)
    last = part[-1] + 1
    off = np.abs(np.interp(t[:last], t[part], v[part]) - v[:last])
    if float(np.max(off)) <= _BENT * float(np.ptp(v)):
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

    Each parameter has `unit`, in which a page shows it, with `factor` and `shift`: shown = factor *
    value + shift; and the ends of its slider.
    """
    shown = output_of(model)
    outputs = model.output_names
    s, known = model.structure, determined(model)
    return {
        "name": model.name,
        "wasm": packed(module),
        "parameters": [_parameter(model, p, p.name in known) for p in s.parameters],
        "effects": [_effect(model, c) for c in model.effects],
        "inputs": [{"name": i.name, "unit": i.unit, "start": i.start} for i in s.inputs],
        "outputs": [_variable(o.name, o.unit, o.display_unit, o.description) for o in s.outputs],
        "states": [
            {**_variable(q.name, q.unit, q.display_unit, q.description), "start": q.start}
            for q in s.states
        ],
        "nominals": model.state_nominals().tolist(),
        "error_sizes": model.error_sizes().tolist(),
        "shown": shown,
        "shown_nominal": (
            0.0 if shown is None else float(model.output_nominals()[outputs.index(shown)])
        ),
        "starts_itself": model.starts_itself,
        "file": _file(model),
    }


def _file(model: Model) -> str | None:
    """Return MODEL.json, None for a model that no file holds."""
    try:
        return dumps(model)
    except InputError:
        return None


def _variable(name: str, unit: str, display: str | None, description: str) -> dict[str, Any]:
    shown = display or unit
    return {"name": name, "description": description, "si": unit, **_scale(unit, shown)}


def _scale(unit: str, display: str) -> dict[str, Any]:
    shift = convert(0.0, unit, display)
    return {"unit": display, "factor": convert(1.0, unit, display) - shift, "shift": shift}


def _parameter(model: Model, p: Parameter, known: bool) -> dict[str, Any]:
    unit, display = shown_in(model, p.name)
    interval = model.provenance.intervals.get(p.name)
    sure = [interval.low, interval.high] if interval is not None else []
    ends = _ends(model, p)
    return {
        "name": p.name,
        "description": p.description,
        **_scale(unit, display),
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
