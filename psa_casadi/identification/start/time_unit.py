"""Records whose times no stack and no test has: their unit is another, or the record is unlike."""

from collections.abc import Sequence

import numpy as np

from psa_casadi.errors import InputError
from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.records.record import Record
from psa_casadi.records.turns import reversals

#: The largest mean speed of a stack's end [m/s]. A bar of length L has its first resonance at
#: c / 4L and moves by S L at most; back and forth there it covers 2 S L c / 4L = S c / 2. With the
#: largest strain of soft PZT, S = 1.5e-3 at 2 kV/mm, and its sound, c = 1 / sqrt(7800 kg/m3 *
#: 16e-12 m2/N) = 2800 m/s, that is 2.1 m/s; levers enlarge the stroke and lower the resonance.
FASTEST = 2.0
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
    driven = [r for r in records if np.ptp(r.voltage) > 0.0]
    paces = [_paces(r) for r in driven]
    for record, (mean, _) in zip(driven, paces, strict=True):
        speed = mean * _stroke(record)
        if speed > FASTEST:
            raise InputError(
                f"Record '{record.name}': in {record.duration:.2g} s the voltage goes"
                f" {mean * record.duration:.2g} times through its range; a stack that follows would"
                f" move at {speed:.2g} m/s, and none can at more than {FASTEST:g} m/s."
                f" {_advice(mean)}"
            )
    fastest = max((peak for _, peak in paces), default=1.0)
    if fastest < 1.0 / SLOWEST:
        raise InputError(
            f"The voltage takes {1.0 / fastest:.2g} s for its range where it is fastest; what takes"
            f" more than {SLOWEST:.0f} s counts as held. {_advice(fastest)}"
        )


def doubtful_time(records: Sequence[Record]) -> str:
    """Say that samples are further apart, or closer together, than records of stacks have them."""
    low, high = _SAMPLE_TIMES
    step = next((r.sample_time for r in records if not low <= r.sample_time <= high), None)
    if step is None:
        return ""
    unit = "ms" if step > high else "s"
    return (
        f"Samples are {step:.2g} s apart: the unit of time is probably another; correct it in the"
        f" header, or say which it is (--columns time=NAME:{unit})."
    )


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


def _advice(pace: float) -> str:
    """Return what unit of time makes a pace usual, and what to type."""
    low, high = _USUAL
    powers = (3, 6, 9) if pace > high else (-3, -6, -9)
    power = next((p for p in powers if low <= pace / 10.0**p <= high), powers[-1])
    right, wrong = _UNITS[power]
    return (
        f"The time is probably in {right}, not {wrong} (or in units as far apart): correct the"
        f" header, or give --columns time=NAME:{right}."
    )
