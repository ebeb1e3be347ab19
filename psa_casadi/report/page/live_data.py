"""What a page must know of a model to run it: its module, its variables, and its file."""

import base64
from typing import Any

import numpy as np
import numpy.typing as npt

from psa_casadi.component import Component
from psa_casadi.effects.patches import GAIN
from psa_casadi.errors import InputError
from psa_casadi.model.compose import Model
from psa_casadi.model.model_file import dumps
from psa_casadi.report.page.packed import packed
from psa_casadi.report.words.fit_words import determined
from psa_casadi.report.words.phrases import plain, shown_in
from psa_casadi.simulation.ways import output_of
from psa_casadi.units import convert
from psa_casadi.variables import Parameter

#: A parameter that spans decades is moved by this factor to both sides.
_DECADES = 10.0
#: A slider reaches so many half widths of the 95 % interval to both sides, at least.
_HALF_WIDTHS = 2.0
#: And from 0 so many ordinary changes.
_TYPICAL = 4.0
#: What stands for an infinite bound: JSON has none.
_NO_BOUND = 1e300


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
