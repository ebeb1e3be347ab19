"""Records whose times no stack and no test has: their unit is another, or the record is unlike."""

from collections.abc import Sequence

import numpy as np

from psa_casadi.errors import InputError
from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.records.drive import reversals
from psa_casadi.records.record import Record

#: The largest mean speed of a stack's end [m/s]. A bar of length L has its first resonance at
#: c / 4L and moves by S L at most; back and forth there it covers 2 S L c / 4L = S c / 2. With the
#: largest strain of soft PZT, S = 1.5e-3 at 2 kV/mm, and its sound, c = 1 / sqrt(7800 kg/m3 *
#: 16e-12 m2/N) = 2800 m/s, that is 2.1 m/s; levers enlarge the stroke and lower the resonance.
FASTEST = 2.0
#: A mean speed [m/s] that few tests have: strokes of 10 um at 5 kHz.
_FAST = 0.1
#: Largest stroke that counts for that [m]: of more, the displacement's unit is wrong. Where the
#: sensor's scale is unknown, a chip's stroke [m/V] stands for it.
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
    said = _faster(records, FASTEST)
    if said:
        raise InputError(said)
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
        speed = pace * _stroke(record)
        if speed > limit:
            bound = "none can at more than" if limit == FASTEST else "few tests are above"
            return (
                f"Record '{record.name}': in {record.duration:.2g} s the voltage goes"
                f" {pace * record.duration:.2g} times through its range; a stack that follows"
                f" would move at {speed:.2g} m/s, and {bound} {limit:g} m/s."
                f" {_advice(pace, (3, 6, 9))}"
            )
    return ""


def _stroke(record: Record) -> float:
    if record.displacement_unit == "counts":
        return _CHIP * float(np.ptp(record.voltage))
    y = measured(record)[record.mask]
    return min(float(np.ptp(y)), _STROKE) if y.size else 0.0


def _paces(record: Record) -> tuple[float, float]:
    """Return how often in a second the voltage goes through its range: on average, at most."""
    v, t = record.voltage, record.time
    span = float(np.ptp(v))
    ends = np.unique(np.r_[0, reversals(v, 0.1 * span), record.n - 1])
    ways, times = np.abs(np.diff(v[ends])) / span, np.diff(t[ends])
    return float(np.sum(ways) / np.sum(times)), float(np.max(ways / times))


def _advice(pace: float, powers: Sequence[int]) -> str:
    """Return which unit of time, so many powers of ten from the given, makes a pace usual."""
    low, high = _USUAL
    power = next((p for p in powers if low <= pace / 10.0**p <= high), powers[-1])
    right, wrong = _UNITS[power]
    return (
        f"The time is probably in {right}, not {wrong} (or in units as far apart): correct the"
        f" header, or give --columns time=NAME:{right}."
    )
