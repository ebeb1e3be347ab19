"""The part of a page whose model is alive: the records that it runs on, and how they began."""

from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from psa_casadi.diagnosis.result import Diagnosis
from psa_casadi.export.web.module import begun_module
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.fitting.shared_starts import shared_starts
from psa_casadi.identification.identify import Identification
from psa_casadi.model.compose import Model
from psa_casadi.records.split import Experiment
from psa_casadi.report.page.document import Document
from psa_casadi.report.page.live_data import doubles, live_data, singles
from psa_casadi.report.words.phrases import added, length_scale
from psa_casadi.report.words.series import Series, spans
from psa_casadi.simulation.compiler import INSTALL_ZIG, has_zig
from psa_casadi.simulation.exact.run import ALIKE

FloatArray = npt.NDArray[np.float64]
IndexArray = npt.NDArray[np.int64]

#: Samples of all records in a page, and records; of more, those that the model misses most.
_SAMPLES, _RECORDS = 12_000, 6
#: Left-out samples may be off the line between their neighbours by this share of the range.
_BENT = 5e-3

_LEGEND = [["--measured", "measured"], ["--model", "model"], ["--fitted", "as fitted"]]
_CAPTIONS = {
    "time": "Displacement over time",
    "loop": "Displacement over voltage",
    "residual": "Residual: measured minus model",
}


@dataclass(frozen=True, eq=False)
class LiveModel:
    """A model that a page is to hold, with the compilation of its module that has begun.

    `added` are what an unnamed correction adds to each record [m], empty without one.
    """

    model: Model
    fit: Fit
    experiments: Sequence[Experiment]
    series: Sequence[Series]
    base: Sequence[float]
    extended: bool
    correction: str
    added: Sequence[FloatArray]
    module: "Future[bytes | None]"


def live_diagnosis(d: Diagnosis, rows: Sequence[Series]) -> LiveModel:
    """Begin what makes the model of a diagnosis alive; `rows` are its `series_of`."""
    patch = d.patch
    return LiveModel(
        model=d.model,
        fit=d.extended_fit,
        experiments=d.experiments,
        series=rows,
        base=[_judged_rms(s, s.measured - s.curves[0].values) for s in rows],
        extended=added(d),
        correction="" if patch is None else f"{patch.name}, as it was found: it does not follow",
        added=(
            [p - x for p, x in zip(patch.predicted, d.extended, strict=True)]
            if patch is not None
            else []
        ),
        module=begun_module(d.model),
    )


def live_fit(found: Identification, rows: Sequence[Series]) -> LiveModel:
    """Begin what makes the model of an identification alive; `rows` are its `series_of_fit`."""
    return LiveModel(
        model=found.model, fit=found.fit, experiments=found.experiments, series=rows,
        base=[0.0] * len(rows), extended=False, correction="", added=[],
        module=begun_module(found.model),
    )  # fmt: skip


def add_live(page: Document, live: LiveModel) -> None:
    """Add sliders, switches and plots of the model, or why the page stays still."""
    page.section("Change the model and see")
    page.paragraph(
        "Sliders are the model's parameters (bar below: 95 % interval), switches its effects. The"
        " model runs in this page; nothing leaves it."
    )

    def told() -> dict[str, Any] | str:
        module = live.module.result()
        if module is not None:
            return _told(live, module)
        cure = "" if has_zig() else f" It takes a compiler: {INSTALL_ZIG}"
        return f"In this page the model does not run.{cure}"

    page.live(told)


def _told(live: LiveModel, module: bytes) -> dict[str, Any]:
    order = _worst(live.series)
    theta = shared_starts(live.model, live.fit.unknowns, live.fit.theta, live.experiments)[0]
    rows = [
        _record(live, k, live.fit.unknowns.start(theta, k), _SAMPLES // len(order)) for k in order
    ]
    first = live.series[order[0]]
    error = length_scale(
        max(float(np.nanmax(np.abs(live.series[k].residual(live.series[k].curves[-1]))))
            for k in order),
        counts=first.counts,
    )  # fmt: skip
    return {
        "kind": "report",
        **live_data(live.model, module),
        "records": rows,
        "time": {"unit": first.time_scale.unit, "factor": first.time_scale.factor},
        "length": {"unit": first.scale.unit, "factor": first.scale.factor},
        "error": {"unit": error.unit, "factor": error.factor},
        "extended": live.extended,
        "correction": live.correction,
        "legend": _LEGEND,
        "captions": _CAPTIONS,
    }


def _worst(series: Sequence[Series]) -> list[int]:
    """Return the records to show, the one that the model misses by the largest share first."""

    def miss(k: int) -> float:
        s = series[k]
        spread = float(np.nanstd(s.measured)) or 1.0
        return float(np.sqrt(np.nanmean(s.residual(s.curves[0]) ** 2))) / spread

    return sorted(range(len(series)), key=miss, reverse=True)[:_RECORDS]


def _judged_rms(s: Series, residual: FloatArray) -> float:
    """Return the rms of a residual over the samples held out, or all if none is."""
    counted = s.held_out if s.held_out.any() else np.ones(len(residual), dtype=bool)
    return float(np.sqrt(np.nanmean(residual[counted] ** 2)))


def _record(live: LiveModel, k: int, start: Mapping[str, float], limit: int) -> dict[str, Any]:
    """Return a record as a page holds it, in SI units, its time from its own first sample on."""
    s, record = live.series[k], live.experiments[k].record
    part, note = thinned(record.time, record.voltage, limit)
    t = record.time[part] - record.time[0]
    residual = s.residual(s.curves[-1])[part]
    fitted = np.isfinite(residual) & ~s.held_out[part]
    others = {n: getattr(record, n, None) for n in live.model.input_names if n != "voltage"}
    even = len(t) > 2 and np.ptp(np.diff(t)) <= ALIKE * t[1]
    return {
        "name": s.name,
        "note": note,
        **(
            {"n": len(t), "step": float(t[-1] / (len(t) - 1)), "t": None}
            if even
            else {"t": doubles(t)}
        ),
        "voltage": doubles(record.voltage[part]),
        "inputs": {n: doubles(v[part]) for n, v in others.items() if v is not None},
        "measured": singles(s.measured[part]),
        "held": spans(s.held_out[part]),
        "center": float(np.mean(residual[fitted])) if fitted.any() else 0.0,
        "deviation": dict(start),
        "noise": s.noise,
        "range": float(np.nanmax(s.measured) - np.nanmin(s.measured)),
        "base": live.base[k],
        "correction": singles(live.added[k][part]) if live.added else None,
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
