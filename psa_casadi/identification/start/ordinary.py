"""Where a fit starts: a stack of the size that the records show, and a few shapes of loop."""

from collections.abc import Mapping, Sequence

import numpy as np

from psa_casadi.components import BASE
from psa_casadi.errors import InputError
from psa_casadi.identification.fitting.unknowns import static_compliance
from psa_casadi.identification.start.doubts import (
    doubtful_unit,
    refuse_unusable,
    static_slope,
    stray,
)
from psa_casadi.identification.start.electrical import capacitance_of
from psa_casadi.model.compose import Model, compose
from psa_casadi.records.record import Record

#: Stiffness assumed where none is given [N/m]: displacement then is right, forces are not.
ASSUMED_STIFFNESS = 5e7
#: Stiffness of the wafers over that of the bonding layers, assumed.
_WAFER_RATIO = 5.0
#: Capacitance assumed [F] where no current was measured: only R_s C_p shows in a displacement.
_CAPACITANCE = 1.6e-6
#: Typical ratio of the peak hysteresis force to the linear force.
_HYSTERESIS_SHARE = 0.1

#: Shapes of loop to start from: A, beta, gamma over k_L, and n. The second saturates early, far
#: within the range; from the others a fit of such a loop ends with a steep A and no bend.
LOOP_SHAPES: tuple[Mapping[str, float], ...] = (
    {"A": -0.3, "beta": 0.3, "gamma": 0.1, "n": 1.3},
    {"A": -0.35, "beta": 0.6, "gamma": 0.02, "n": 1.4},
    {"A": -0.15, "beta": 0.05, "gamma": 0.05, "n": 1.1},
    {"A": -0.3, "beta": 0.1, "gamma": 0.1, "n": 1.05},
)


def starting_model(records: Sequence[Record], stiffness: float | None = None) -> Model:
    """Return the base model scaled to the records' voltage span, stroke and sampling.

    In the one-way cascade a load meets the bonding layers only, so the stiffness [N/m] that a data
    sheet measures is k_B; it is `ASSUMED_STIFFNESS` where none is given, since voltage and
    displacement do not determine forces. k_P = 5 k_B is assumed; k_L (1/k_P + 1/k_B) is the
    regression slope of displacement on voltage (paper, eq. 14). C_p is that of the measured current
    (`capacitance_of`), else assumed. Raises InputError where that is
    far from what any stack does, or where no voltage or no displacement changes.
    """
    refuse_unusable(records)
    doubt = doubtful_unit(records)
    k_b = stiffness or ASSUMED_STIFFNESS
    k_p = _WAFER_RATIO * k_b
    span = max(float(np.ptp(r.voltage)) for r in records)
    top = max(float(np.max(np.abs(r.voltage))) for r in records)
    sample_time = min(r.sample_time for r in records)
    k_l = max(abs(static_slope(records)), 1e-12) / (1.0 / k_p + 1.0 / k_b)
    told = capacitance_of(records)
    values = {
        "u_rated": max(span, top),
        "k_L": k_l,
        "h_ref": _HYSTERESIS_SHARE * k_l * span,
        "hold_rate": 1e-3 * span,
        "C_p": _CAPACITANCE if told is None else told.value,
        "k_P": k_p,
        "k_B": k_b,
        **{name: share * k_l for name, share in LOOP_SHAPES[0].items() if name != "n"},
        "n": LOOP_SHAPES[0]["n"],
    }
    try:
        return compose(BASE, {**values, **_within(_lags(values, sample_time))})
    except InputError as error:
        raise InputError(stray(records) or [doubt]) if doubt else error from None


def _within(lags: Mapping[str, float]) -> dict[str, float]:
    """Return lags within the bounds of their parameters, however slow or fast the sampling is."""
    bounds = {p.name: p.bounds for c in BASE for p in c.parameters}
    return {name: float(np.clip(value, *bounds[name])) for name, value in lags.items()}


def chosen_start(
    records: Sequence[Record], model: Model | None, stiffness: float | None
) -> tuple[Model, bool]:
    """Return where a fit starts, and whether its force scale is known.

    A `model` is taken as it is, but for start values of its own, which belong to its parameters; a
    `stiffness` [N/m] beside it changes its force scale.
    """
    if model is None:
        return starting_model(records, stiffness), stiffness is not None
    model = model.with_declared_starts()
    if stiffness is None:
        return model, model.provenance.force_scale == "given"
    return with_stiffness(model, stiffness), True


def with_stiffness(model: Model, stiffness: float) -> Model:
    """Return a model of the same displacement whose free stiffness [N/m] is the one given.

    All forces, stiffnesses, dampings and masses are multiplied by one factor, which displacements
    do not show.
    """
    own = next(model.values[name] for name in ("k_B", "k") if name in model.values)
    forces = [p for p in model.structure.parameters if p.unit == "kg" or p.unit[:1] == "N"]
    return model.with_values({p.name: model.values[p.name] * stiffness / own for p in forces})


def loop_starts(model: Model) -> list[dict[str, float]]:
    """Return starting values for the hysteresis, scaled to the model's k_L."""
    k_l = model.values["k_L"]
    return [
        {name: value if name == "n" else value * k_l for name, value in shape.items()}
        for shape in LOOP_SHAPES
    ]


def ordinary_values(model: Model, records: Sequence[Record]) -> dict[str, float]:
    """Return an ordinary loop, some 12 % wide, and lags below the sampling, to the records' size.

    k_L comes from the regression of displacement on voltage: that of a fitted model may be far off
    it, since a steep loop trades k_L for A.
    """
    k_l = max(abs(static_slope(records)), 1e-12) / static_compliance(model.values)
    loop = {"A": -0.15 * k_l, "beta": 0.1 * k_l, "gamma": 0.0, "delta": 0.0, "n": 1.2}
    shape = loop if has_loop(model) else {}
    return {"k_L": k_l, **shape, **_lags(model.values, min(r.sample_time for r in records))}


def has_loop(model: Model) -> bool:
    """Whether the model's hysteresis is Bouc-Wen's, whose shapes of loop are known."""
    return "A" in model.values


def _lags(values: Mapping[str, float], sample_time: float) -> dict[str, float]:
    """Return lags somewhat below the sampling interval; what is much faster cannot be told."""
    lags = {
        "tau": float(np.clip(0.7 * sample_time, 1e-6, 0.5)),
        "R_s": 0.3 * sample_time / values["C_p"],
    }
    lags |= {f"c_{m}": 0.05 * sample_time * values[f"k_{m}"] for m in "PB" if f"k_{m}" in values}
    return lags
