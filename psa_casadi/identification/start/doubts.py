"""Records that no stack makes: another quantity, unit, sign or time, or too few readings."""

from collections.abc import Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray

from psa_casadi.common.errors import InputError
from psa_casadi.common.units import BoolArray, FloatArray
from psa_casadi.records.drive import reversals
from psa_casadi.records.record import FEWEST_SAMPLES, Record

#: Numbers whose squares would overflow.
_LARGEST = 1e30


def refuse_unreadable(records: Sequence[Record]) -> None:
    """Raise InputError for a displacement that is still or wraps, or a time in another unit."""
    refuse_still(records)
    refuse_wrapped(records)
    refuse_other_time(records)


def refuse_stuck(records: Sequence[Record]) -> None:
    """Raise InputError where no displacement that counts changes."""
    if not any(r.mask.any() and r.range_m > 0.0 for r in records):
        raise InputError(
            "But for stuck readings, the displacement is one value: the sensor is out of its range,"
            " or another column holds its readings (--columns displacement=...)."
        )


def refuse_still(records: Sequence[Record]) -> None:
    """Raise InputError where displacements, as they were read, have one or two values."""
    for name, columns in (
        ("displacement", [r.measured[r.mask] for r in records]),
        ("voltage", [r.voltage for r in records]),
    ):
        largest = max(float(np.max(np.abs(c), initial=0.0)) for c in columns)
        if largest > _LARGEST:
            raise InputError(
                f"The {name} reaches {largest:.2g}: that is no reading; correct the column."
            )
    values = [np.unique(r.measured[r.mask]) for r in records]
    if all(v.size <= 1 for v in values):
        raise InputError(
            f"The displacement is {values[0][0]:.6g} m throughout: the sensor is out of its range"
            " or was not connected, or another column holds its readings"
            " (--columns displacement=...)."
        )
    if all(v.size <= 2 for v in values):
        low, high = max(values, key=np.ptp)
        raise InputError(
            f"The displacement has two values only, {low:.6g} and {high:.6g} m: that is a switch,"
            " or a sensor whose step is as large as the motion, and nothing of a stack can be"
            " identified from it. Record it with a finer sensor, or name another column"
            " (--columns displacement=...)."
        )


def refuse_few(inputs: Sequence[Record], kept: Sequence[Record], texts: Sequence[str]) -> None:
    """Raise InputError where masking left hardly a reading; `texts` is what it was done for."""
    before, after = (sum(int(r.mask.sum()) for r in records) for records in (inputs, kept))
    if after < min(before, FEWEST_SAMPLES):
        few = (
            f"Only {after} of {before} readings of the displacement count, too few for a fit, which"
            f" needs {FEWEST_SAMPLES}; record again, with the sensor in its range throughout."
        )
        raise InputError([*texts, few])
    uniques = [np.unique(r.measured[r.mask], return_counts=True) for r in kept if r.mask.any()]
    others = after - sum(int(counts.max()) for _, counts in uniques)
    if others < min(after, FEWEST_SAMPLES):
        values, counts = max(uniques, key=lambda u: int(u[1].max()))
        few = (
            f"Only {others} readings of the displacement differ from"
            f" {float(values[np.argmax(counts)]):.6g} m, too few for a fit, which needs"
            f" {FEWEST_SAMPLES}: the sensor is out of its range nearly throughout. Record again,"
            " with the sensor in its range."
        )
        raise InputError([*texts, few])


#: The largest mean speed of a stack's end [m/s]. A bar of length L has its first resonance at
#: c / 4L and moves by S L at most; back and forth there it covers 2 S L c / 4L = S c / 2. With the
#: largest strain of soft PZT, S = 1.5e-3 at 2 kV/mm, and its sound, c = 1 / sqrt(7800 kg/m3 *
#: 16e-12 m2/N) = 2800 m/s, that is 2.1 m/s; levers enlarge the stroke and lower the resonance.
FASTEST = 2.0
#: A mean speed [m/s] that few tests have: strokes of 10 um at 5 kHz.
_FAST = 0.1
#: Largest stroke that counts for that [m]: of more, the displacement's unit is wrong. If the
#: sensor's scale is unknown, a chip's stroke [m/V] is taken.
_STROKE, _CHIP = 2e-3, 1e-8
#: Time [s] for the whole range of the voltage that counts as held: see `hold_rate`.
SLOWEST = 1000.0
#: Time between samples [s] that records of stacks have.
_SAMPLE_TIMES = (1e-8, 3600.0)
#: Ways through the range of the voltage in a second that tests have.
_USUAL = (1e-2, 1e3)
#: The unit that a time is probably in and the one it is taken for, by the power of ten between.
_UNITS = {3: ("s", "ms"), 6: ("s", "us"), 9: ("s", "ns"),
          -3: ("ms", "s"), -6: ("us", "s"), -9: ("ns", "s")}  # fmt: skip


def refuse_other_time(records: Sequence[Record]) -> None:
    """Raise InputError where a stack would move faster than sound lets it, or never but creep."""
    reason = _faster(records, FASTEST)
    if reason:
        raise InputError(reason)
    fastest = max((_paces(r)[1] for r in records if np.ptp(r.voltage) > 0.0), default=1.0)
    if fastest < 1.0 / SLOWEST:
        raise InputError(
            f"The voltage takes {1.0 / fastest:.2g} s for its range where it is fastest; what takes"
            f" more than {SLOWEST:.0f} s counts as held. {_advice(fastest, (-3, -6, -9))}"
        )


def doubtful_time(records: Sequence[Record]) -> str:
    """Say that samples are further apart, or closer together, than records of stacks have them.

    Or that the stack moves faster than in nearly all tests.
    """
    low, high = _SAMPLE_TIMES
    step = next((r.sample_time for r in records if not low <= r.sample_time <= high), None)
    if step is None:
        return _faster(records, _FAST)
    unit = "ms" if step > high else "s"
    return (
        f"Samples are {step:.2g} s apart: the unit of time is probably another; correct it in the"
        f" header, or say which it is (--columns time=NAME:{unit})."
    )


def _faster(records: Sequence[Record], limit: float) -> str:
    """Say that a stack which follows the voltage of a record would be faster than a limit [m/s]."""
    for record in records:
        if np.ptp(record.voltage) == 0.0:
            continue
        pace, _ = _paces(record)
        y = record.measured[record.mask]
        if record.displacement_unit == "counts":
            stroke = _CHIP * float(np.ptp(record.voltage))
        else:
            stroke = min(float(np.ptp(y)), _STROKE) if y.size else 0.0
        speed = pace * stroke
        if speed > limit:
            bound = "none can at more than" if limit == FASTEST else "few tests are above"
            return (
                f"Record '{record.name}': in {record.duration:.2g} s the voltage goes"
                f" {pace * record.duration:.2g} times through its range; a stack that follows"
                f" would move at {speed:.2g} m/s, and {bound} {limit:g} m/s."
                f" {_advice(pace, (3, 6, 9))}"
            )
    return ""


def _paces(record: Record) -> tuple[float, float]:
    """Return how often in a second the voltage goes through its range: on average, at most."""
    v, t = record.voltage, record.time
    span = float(np.ptp(v))
    ends = np.unique(np.r_[0, reversals(v, 0.1 * span), record.n - 1])
    ways, times = np.abs(np.diff(v[ends])) / span, np.diff(t[ends])
    return float(np.sum(ways) / np.sum(times)), float(np.max(ways / times))


def _advice(pace: float, powers: Sequence[int]) -> str:
    """Return which unit of time, by one of the powers of ten, makes a pace usual."""
    low, high = _USUAL
    power = next((p for p in powers if low <= pace / 10.0**p <= high), powers[-1])
    right, wrong = _UNITS[power]
    return (
        f"The time is probably in {right}, not {wrong} (or in units as far apart): correct the"
        f" header, or give --columns time=NAME:{right}."
    )


#: Correlation with the voltage from which on a column holds what is correlated.
_FOLLOWS = 0.95
#: A step over the range, between two samples, that is a wrap, and by how much wraps may differ.
_STEP, _ALIKE = 0.5, 0.2
#: Shares of the readings below whose voltage the sign is turned.
_TURNS = np.arange(0.02, 0.99, 0.02)
#: Fewest wraps.
_WRAPS = 2


def refuse_wrapped(records: Sequence[Record]) -> None:
    """Raise InputError if a displacement wraps round at the end of the sensor's range."""
    problems = [s for r in records if (s := _wrapped(r))]
    if problems:
        raise InputError(problems)


def _wrapped(record: Record) -> str:
    """Return a sentence if a displacement without its large, equal steps follows the voltage."""
    y, v = _readings(record)
    steps = np.diff(y)
    large = np.abs(steps) > _STEP * np.ptp(y)
    if np.count_nonzero(large) < _WRAPS:
        return ""
    period = float(np.median(np.abs(steps[large])))
    if np.any(np.abs(np.abs(steps[large]) - period) > _ALIKE * period):
        return ""
    turns = np.r_[0, np.cumsum(np.where(large, -np.sign(steps), 0.0))].astype(int)
    if y.size - np.max(np.unique(turns, return_counts=True)[1]) < FEWEST_SAMPLES:  # a stray reading
        return ""
    added = period * turns
    if abs(_correlation(y + added, v)) < _FOLLOWS or abs(_correlation(y, v)) > _FOLLOWS:
        return ""
    scale, unit = (1e6, "um") if record.displacement_unit == "m" else (1.0, "counts")
    return (
        f"Record '{record.name}': the displacement jumps {np.count_nonzero(large)} times by"
        f" {scale * period:.4g} {unit}, up or down, and follows the voltage without these jumps:"
        " the sensor, or its counter, restarts at the end of its range. Add the jumps up"
        f" (numpy.unwrap with period={scale * period:.4g}), or record with a larger range."
    )


def doubtful_quantity(records: Sequence[Record]) -> str:
    """Say that a rate, an integral, or the sign turned below a voltage follows it better; else "".

    A stack behind a lag that is long compared with the voltage's changes looks so too. "" for a
    record of which less than half is read: that part may follow the rate by itself.
    """
    for record in records:
        y, v = _readings(record)
        if 2 * y.size < record.n or abs(plain := _correlation(y, v)) > _FOLLOWS:
            continue
        step = np.diff(record.time[record.mask])
        rate = _correlation(np.diff(y) / step, 0.5 * (v[1:] + v[:-1]))
        line = np.column_stack([np.ones(step.size), np.cumsum(step)])
        both = np.column_stack([np.cumsum(0.5 * (y[1:] + y[:-1]) * step), v[1:]])
        summed, moved = (both - line @ np.linalg.lstsq(line, both, rcond=None)[0]).T
        integral = _correlation(summed, moved)
        for other, what, holds in (
            (rate, "rate of", "an integral of"), (integral, "integral of", "the rate of"),
        ):  # fmt: skip
            if abs(other) > _FOLLOWS:
                return (
                    f"Record '{record.name}': the {what} the displacement follows the voltage"
                    f" (correlation {other:.3f}), the displacement itself does not ({plain:.3f}):"
                    f" the column may hold {holds} it."
                )
        turns = np.quantile(v, _TURNS)
        turned, at = max((abs(_correlation(np.where(v < u, -y, y), v)), u) for u in turns)
        if turned > _FOLLOWS:
            return (
                f"Record '{record.name}': with its sign turned below {at:.4g} V the displacement"
                f" follows the voltage (correlation {turned:.3f}), as it is it does not"
                f" ({plain:.3f}): it may be rectified."
            )
    return ""


def _readings(record: Record) -> tuple[FloatArray, FloatArray]:
    mask: BoolArray = record.mask
    return record.measured[mask], record.voltage[mask]


def _correlation(a: FloatArray, b: FloatArray) -> float:
    a, b = a - np.mean(a), b - np.mean(b)
    power = float(a @ a) * float(b @ b)
    return float(a @ b) / power**0.5 if power > 0.0 else 0.0


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
_LENGTHS = {-3: "um, not mm, or in nm, not um", -6: "um, not m", -9: "nm, not m",
            3: "um, not nm, or in mm, not um", 6: "um, not pm", 9: "mm, not pm"}  # fmt: skip
_VOLTAGES = {-3: "mV, not V", -6: "uV, not V", -9: "uV, not kV",
             3: "kV, not V", 6: "kV, not mV", 9: "kV, not uV"}  # fmt: skip


def refuse_unusable(records: Sequence[Record]) -> None:
    """Raise InputError, with the likely cause, for records from which no fit can start."""
    span = max(float(np.ptp(r.voltage)) for r in records)
    if span == 0.0:
        raise InputError(
            f"The voltage is {records[0].voltage[0]:g} V throughout: a stack shows itself only"
            " where its voltage changes. Give a record in which it does, or name its column"
            " (--columns voltage=...)."
        )
    refuse_stuck(records)
    top = max(float(np.max(np.abs(r.voltage))) for r in records)
    stroke = max(r.range_m for r in records)
    counts = any(r.displacement_unit == "counts" for r in records)
    low, high = _USABLE_SPANS
    texts = stray(records)
    if not low <= max(span, top) <= high or span < 1e-9 * top or span < low:
        other = _suggestion(stroke, span) if top < _OFFSET * span else ""
        about = (
            f"changes by {span:.2g} V only: that drives no stack. Its unit is probably another, or"
            " the column holds something else"
        )
        if top > high:
            about = (
                f"reaches {top:.2g} V, and changes by {span:.2g} V: no stack bears that. Its unit"
                " is probably another, it has an offset, or the column holds something else"
            )
        raise InputError(texts or [f"The voltage {about}{other}."])
    low, high = _USABLE_STROKES
    if not counts and not low <= stroke <= high:
        side = "more" if stroke > high else "less"
        strange = (
            f"The displacement changes by {stroke:.2g} m, {side} than a stack with any sensor: its"
            f" unit is probably another{_suggestion(stroke, span)}."
        )
        raise InputError(texts or [strange])


def stray(records: Sequence[Record]) -> list[str]:
    """Name the few samples of a record that lie far from all others, in voltage or displacement."""
    sentences = []
    for r in records:
        columns = [("voltage", "V", r.voltage), ("displacement", "m", r.measured)]
        for name, unit, column in columns:
            far = _far(column)
            if not far.size:
                continue
            rest = np.delete(column, far)
            where = ", ".join(f"{column[k]:.3g} {unit} at {r.time[k]:.6g} s" for k in far)
            sentences.append(
                f"Record '{r.name}': the {name} is {where}, and all others lie within"
                f" {np.nanmin(rest):.3g} to {np.nanmax(rest):.3g} {unit}: correct or remove"
                f" {'this sample' if far.size == 1 else 'these samples'}."
            )
    return sentences


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
        y = record.measured[valid]
        top += float(v @ (y - np.mean(y)))
        bottom += float(v @ v)
    return top / bottom if bottom > 0 else 0.0


def correlation(records: Sequence[Record]) -> float:
    """Correlation of displacement and voltage over all records, -1 to 1."""
    spread = [float(np.nanvar(r.measured)) * r.n for r in records]
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
        max(float(of) for of in result)
        for result in ((r.range_m for r in records), (np.ptp(r.voltage) for r in records))
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
        " cannot be determined from these."
    )


def doubtful_sign(records: Sequence[Record]) -> str:
    """Say that the displacement falls while the voltage rises; "" where it does not."""
    value = correlation(records)
    if value > _FALLING:
        return ""
    return (
        f"The displacement falls while the voltage rises (correlation {value:.2f}): the sensor or"
        " the voltage is probably connected the other way round; change the sign of one column."
    )


def _suggestion(stroke: float, span: float) -> str:
    """Say which column would be ordinary in which other unit; "" where no single change helps."""
    fits = [
        (length, voltage)
        for length, voltage in product(_POWERS, _POWERS)
        if _STROKES[0] <= (x := stroke * 10.0**length) <= _STROKES[1]
        and _SPANS[0] <= (v := span * 10.0**voltage) <= _SPANS[1]
        and ORDINARY_STROKE[0] <= x / v <= ORDINARY_STROKE[1]
    ]
    power = min(fits, key=lambda p: abs(p[0]) + abs(p[1]), default=(0, 0))
    changes = [
        f"the {name} is in {units[p]} (or in units as far apart): correct the header, or give the"
        f" right one, as --columns {name}=NAME:{units[p].split(',')[0]}"
        for name, p, units in (
            ("displacement", power[0], _LENGTHS), ("voltage", power[1], _VOLTAGES),
        )
        if p
    ]  # fmt: skip
    return f". Perhaps {' and '.join(changes)}" if changes else ""


def doubtful(records: Sequence[Record]) -> list[str]:
    """Say what of records is unlike a stack's: unit, voltage, time, sign, quantity."""
    every = doubtful_unit, doubtful_voltage, doubtful_time, doubtful_sign, doubtful_quantity
    return [sentence for doubt in every if (sentence := doubt(records))]
