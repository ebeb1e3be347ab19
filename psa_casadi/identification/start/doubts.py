"""Records that no stack makes: another unit, another sign, a stray sample, nothing to identify."""

from collections.abc import Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray

from psa_casadi.errors import InputError
from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.identification.start.readings import refuse_stuck
from psa_casadi.records.record import Record
from psa_casadi.units import FloatArray

#: Displacement per volt [m/V] of stacks, from a chip of 2 um at 120 V to a lever of 1 mm at 100 V,
#: with a margin of ten.
ORDINARY_STROKE = (1e-9, 1e-4)
#: Ordinary ranges of displacement [m] and voltage [V]: what a suggested unit must lead to.
_STROKES, _SPANS = (2e-7, 2e-3), (5.0, 2000.0)
#: Displacements [m] and voltages [V] that a model can start from.
_USABLE_STROKES, _USABLE_SPANS = (1e-13, 0.1), (1e-3, 1e5)
#: So few samples are stray where all others are this much closer together.
_STRAY, _APART = 3, 30.0
#: A voltage this many times as large as its changes is an offset, whatever its unit.
_OFFSET = 100.0
#: Correlation of displacement and voltage below which the sign is doubtful.
_FALLING = -0.5
_POWERS = (0, -3, 3, -6, 6, -9, 9)
#: The unit that a column is probably in and the one it is taken for, by the power of ten between.
_LENGTHS = {-3: "um, not mm", -6: "um, not m", -9: "nm, not m",
            3: "um, not nm", 6: "um, not pm", 9: "mm, not pm"}  # fmt: skip
_VOLTAGES = {-3: "mV, not V", -6: "uV, not V", -9: "uV, not kV",
             3: "kV, not V", 6: "kV, not mV", 9: "kV, not uV"}  # fmt: skip

_CONSTANT = (
    "The voltage is {:g} V throughout: a stack shows itself only where its voltage changes. Give a"
    " record in which it does, or name its column (--columns voltage=...)."
)


def refuse_unusable(records: Sequence[Record]) -> None:
    """Raise InputError, with the likely cause, for records from which no fit can start."""
    span = max(float(np.ptp(r.voltage)) for r in records)
    if span == 0.0:
        raise InputError([_CONSTANT.format(records[0].voltage[0])])
    refuse_stuck(records)
    top = max(float(np.max(np.abs(r.voltage))) for r in records)
    stroke = max(r.range_m for r in records)
    counts = any(r.displacement_unit == "counts" for r in records)
    low, high = _USABLE_SPANS
    if not low <= max(span, top) <= high or span < 1e-9 * top or span < low:
        said = stray(records)
        other = _suggestion(stroke, span) if top < _OFFSET * span else ""
        raise InputError(said or [f"{_voltage(span, top)}{other}."])
    low, high = _USABLE_STROKES
    if not counts and not low <= stroke <= high:
        side = "more" if stroke > high else "less"
        said = stray(records)
        raise InputError(
            said
            or [
                f"The displacement changes by {stroke:.2g} m, {side} than a stack with any sensor:"
                f" its unit is probably another{_suggestion(stroke, span)}."
            ]
        )


def _voltage(span: float, top: float) -> str:
    if top > _USABLE_SPANS[1]:
        return (
            f"The voltage reaches {top:.2g} V, and changes by {span:.2g} V: no stack bears that."
            " Its unit is probably another, it has an offset, or the column holds something else"
        )
    return (
        f"The voltage changes by {span:.2g} V only: that drives no stack. Its unit is probably"
        " another, or the column holds something else"
    )


def stray(records: Sequence[Record]) -> list[str]:
    """Name the few samples of a record that lie far from all others, in voltage or displacement."""
    said = []
    for r in records:
        columns = [("voltage", "V", r.voltage), ("displacement", "m", measured(r))]
        for name, unit, column in columns:
            far = _far(column)
            if not far.size:
                continue
            rest = np.delete(column, far)
            where = ", ".join(f"{column[k]:.3g} {unit} at {r.time[k]:.6g} s" for k in far)
            said.append(
                f"Record '{r.name}': the {name} is {where}, and all others lie within"
                f" {np.nanmin(rest):.3g} to {np.nanmax(rest):.3g} {unit}: correct or remove"
                f" {'this sample' if far.size == 1 else 'these samples'}."
            )
    return said


def _far(column: FloatArray) -> NDArray[np.intp]:
    """Return the places of at most three samples that lie far from all others; else none."""
    finite = np.flatnonzero(np.isfinite(column))
    by_distance = finite[np.argsort(np.abs(column[finite] - np.median(column[finite])))]
    for count in range(1, _STRAY + 1):
        rest, far = by_distance[:-count], by_distance[-count:]
        reach = float(np.max(column[rest]) - np.min(column[rest]))
        centre = float(np.median(column[rest]))
        if 0.0 < _APART * reach < float(np.min(np.abs(column[far] - centre))):
            return np.sort(far)
    return by_distance[:0]


def static_slope(records: Sequence[Record]) -> float:
    """Regression slope of displacement on voltage, records centred each [m/V]."""
    top = bottom = 0.0
    for record in records:
        valid = record.mask
        v = record.voltage[valid] - np.mean(record.voltage[valid])
        y = measured(record)[valid]
        top += float(v @ (y - np.mean(y)))
        bottom += float(v @ v)
    return top / bottom if bottom > 0 else 0.0


def correlation(records: Sequence[Record]) -> float:
    """Correlation of displacement and voltage over all records, -1 to 1."""
    spread = [float(np.nanvar(measured(r))) * r.n for r in records]
    drive = [float(np.var(r.voltage)) * r.n for r in records]
    return static_slope(records) * float(np.sqrt(sum(drive) / max(sum(spread), 1e-300)))


def doubtful_unit(records: Sequence[Record]) -> str:
    """Say that displacement per volt is not what stacks do; "" where it is, or is in counts."""
    slope = abs(static_slope(records))
    low, high = ORDINARY_STROKE
    counts = any(r.displacement_unit == "counts" for r in records)
    if counts or slope == 0.0 or low <= slope <= high:
        return ""
    side = "more" if slope > high else "less"
    stroke, span = (
        max(float(of) for of in found)
        for found in ((r.range_m for r in records), (np.ptp(r.voltage) for r in records))
    )
    return (
        f"The displacement changes by {slope:.1e} m per volt, {side} than piezoelectric stacks do"
        f" ({low:.0e} to {high:.0e} m/V): its unit, or that of the voltage, is probably another"
        f"{_suggestion(stroke, span)}."
    )


def doubtful_voltage(records: Sequence[Record]) -> str:
    """Say that the voltage is higher than stacks bear, and its unit is in no doubt; else ""."""
    top = max(float(np.max(np.abs(r.voltage))) for r in records)
    if top <= _SPANS[1] or doubtful_unit(records):
        return ""
    return (
        f"The voltage reaches {top:.5g} V, and no stack bears more than {_SPANS[1]:.0f} V: it"
        " probably is in millivolts, or holds the counts of a converter or an offset. Give it in"
        " volts, or its unit (--columns voltage=NAME:mV); what depends on the level of the voltage"
        " cannot be told so."
    )


def doubtful_sign(records: Sequence[Record]) -> str:
    """Say that the displacement falls while the voltage rises; "" where it does not."""
    found = correlation(records)
    if found > _FALLING:
        return ""
    return (
        f"The displacement falls while the voltage rises (correlation {found:.2f}): the sensor or"
        " the voltage is probably connected the other way round; change the sign of one column."
    )


def _suggestion(stroke: float, span: float) -> str:
    """Say which column would be ordinary in which other unit; "" where no single change helps."""
    fits = []
    for length, voltage in product(_POWERS, _POWERS):
        x, v = stroke * 10.0**length, span * 10.0**voltage
        ordinary = _STROKES[0] <= x <= _STROKES[1] and _SPANS[0] <= v <= _SPANS[1]
        if ordinary and ORDINARY_STROKE[0] <= x / v <= ORDINARY_STROKE[1]:
            fits.append((length, voltage))
    power = min(fits, key=lambda p: abs(p[0]) + abs(p[1]), default=(0, 0))
    told = [
        f"the {name} is in {units[p]} (or in units as far apart): correct the header, or give"
        f" --columns {name}=NAME:{units[p].split(',')[0]}"
        for name, p, units in (
            ("displacement", power[0], _LENGTHS), ("voltage", power[1], _VOLTAGES),
        )
        if p
    ]  # fmt: skip
    return f". Perhaps {' and '.join(told)}" if told else ""
