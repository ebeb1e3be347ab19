"""Times as instruments write them: dates, clock times, epochs, too few digits, several starts."""

import calendar
import re
from collections.abc import Sequence
from datetime import date
from decimal import Decimal
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from psa_casadi.records.read.table import Cells
from psa_casadi.records.record import FEWEST_SAMPLES
from psa_casadi.units import FloatArray, to_si

_DAY = 86400.0
_MONTHS = {name.lower(): k for k, name in enumerate(calendar.month_abbr) if name} | {
    "mär": 3, "mai": 5, "okt": 10, "dez": 12,
}  # fmt: skip
_STAMP = re.compile(
    r"""(?:(?P<a>\d{1,4})[-./\ ](?P<b>\d{1,2}|[^\W\d_]{3,9})\.?[-./\ ](?P<c>\d{1,4}),?
        (?:[T\s;]+|$))?
        (?:(?P<h>\d{1,2}):(?P<m>\d{2})(?::(?P<s>\d{2}))?(?:[.,:](?P<f>\d+))?)?\s*
        (?P<half>[AaPp]\.?[Mm]\.?)?\s*(?:(?P<zone>[+-]\d{2}:?\d{2})|Z|UTC|GMT|CES?T|[A-Z]{3,4})?""",
    re.X,
)
#: Times beyond this keep less than 15 ns in a float of seconds.
_LARGE = 1e8
#: The powers of ten of which 1e9 to 4e9 (the years 2001 to 2096) count the seconds since 1970.
_EPOCHS = {"s": 0, "ms": 3, "us": 6, "ns": 9}


def is_stamp(cell: str) -> bool:
    """Whether a text is a date, a clock time or both."""
    found = _STAMP.fullmatch(cell.strip().strip('"'))
    return found is not None and (found["h"] is not None or found["a"] is not None)


def unit_of_times(times: FloatArray) -> str | None:
    """Return the unit that the size of the first times tells, None where it tells none.

    They are counted from 1970; or they are days since the year 0, as MATLAB counts them: seconds of
    that size would be samples of 500 kHz after nine days.
    """
    if times.size < 2 or not np.isfinite(times).all():
        return None
    for unit, power in _EPOCHS.items():
        if 1e9 <= times[0] / 10**power < 4e9:
            return unit
    step = float(np.median(np.diff(times)))
    return "d" if 7.2e5 <= times[0] < 7.7e5 and 0.0 < step < 2e-6 else None


def seconds(cells: Sequence[str]) -> FloatArray | None:
    """Return dates and clock times as seconds from the first (n,); None where a cell is neither.

    Of 3/4/2024 the day is what makes the record the shorter one; a clock that goes back by more
    than half a day has passed midnight.
    """
    found = [_STAMP.fullmatch(cell.strip().strip('"')) for cell in cells]
    if not found or any(m is None or (m["h"] is None and m["a"] is None) for m in found):
        return None
    stamps = [m for m in found if m is not None]
    clock = _since_first([_clock(m) for m in stamps])
    if stamps[0]["a"] is None:
        back = np.diff(clock, prepend=clock[0])
        return clock + _DAY * np.cumsum((back < -0.5 * _DAY).astype(float))
    days = [d for first in (True, False) if (d := _days(stamps, day_first=first)) is not None]
    whole = [clock + _DAY * d for d in days]
    return min(whole, key=lambda t: (bool((np.diff(t) < 0.0).any()), np.ptp(t)), default=None)


def _clock(stamp: re.Match[str]) -> Fraction:
    """Return the time of day [s]; with two numbers and a fraction these are minutes and seconds."""
    h, m, s = (int(stamp[k] or 0) for k in "hms")
    if stamp["s"] is None and stamp["f"] is not None:
        h, m, s = 0, h, m
    if stamp["half"]:
        h = h % 12 + 12 * (stamp["half"][0] in "pP")
    zone = (stamp["zone"] or "+0000").replace(":", "")
    shift = int(zone[0] + "1") * (60 * int(zone[1:3]) + int(zone[3:5]))
    digits = stamp["f"] or "0"
    return 3600 * h + 60 * (m - shift) + s + Fraction(int(digits), 10 ** len(digits))


def _since_first(times: Sequence[Fraction]) -> FloatArray:
    return np.array([float(t - times[0]) for t in times])


def _days(stamps: Sequence[re.Match[str]], *, day_first: bool) -> FloatArray | None:
    """Return the days from the first date, None where there is no such date."""
    known: dict[tuple[str, str, str], int] = {}
    try:
        for key in {(m["a"], m["b"], m["c"]) for m in stamps}:
            a, b, c = key
            month = None if b.isdecimal() else _MONTHS[b[:3].lower()]
            if len(a) == 4:
                year, middle, last = int(a), month or int(b), int(c)
                known[key] = date(year, middle, last).toordinal()
            else:
                year = int(c) + 2000 * (len(c) < 3)
                day, middle = (int(a), month or int(b)) if day_first or month else (int(b), int(a))
                known[key] = date(year, middle, day).toordinal()
    except (ValueError, KeyError):
        return None
    days = np.array([float(known[m["a"], m["b"], m["c"]]) for m in stamps])
    return np.asarray(days - days[0])


def times(cells: Cells, unit: str) -> FloatArray | None:
    """Return instants, clock times and large numbers as times from the first, in a unit.

    A float would lose the last digits of large numbers. None for all others.
    """
    if not isinstance(cells, np.ndarray):
        stamps = seconds(cells)
        return _large(cells) if stamps is None else stamps / float(to_si(1.0, unit))
    if cells.dtype.kind in "mM":
        since = (cells - cells[:1]).astype("timedelta64[ns]").astype(np.int64)
        return np.asarray(since / 1e9 / float(to_si(1.0, unit)))
    if cells.dtype.kind in "iu" or (
        np.abs(cells[:1]).max(initial=0.0) > _LARGE and np.isfinite(cells).all()
    ):
        return np.asarray((cells - cells[:1]).astype(np.float64))
    return None


def _large(cells: Sequence[str]) -> FloatArray | None:
    texts = [c.strip().strip('"').replace(",", ".") for c in cells]
    try:
        if not texts or abs(float(texts[0])) <= _LARGE:
            return None
        exact = [Decimal(text) for text in texts]
        return np.array([float(one - exact[0]) for one in exact])
    except (ValueError, ArithmeticError):
        return None


def evened(time: FloatArray) -> tuple[FloatArray, float] | None:
    """Return an even time and its step for one that was written with too few digits, else None.

    It repeats and never goes back; an even time between its first and last instants, rounded to its
    steps, is the same.
    """
    steps = np.diff(time)
    if time.size < FEWEST_SAMPLES or (steps < 0.0).any() or not (steps == 0.0).any():
        return None
    if not (steps > 0.0).any():
        return None
    quantum = float(steps[steps > 0.0].min())
    k = np.arange(time.size)
    step = float(np.polyfit(k, time - time[0], 1)[0])
    for even in (*(float(f"{step:.{digits}g}") for digits in range(1, 7)), step):
        if 0.0 < even <= 0.9 * quantum and np.ptp(time - even * k) <= 1.01 * quantum:
            return time[0] + even * k, even
    return None


def starts(time: FloatArray) -> NDArray[np.int64]:
    """Return the indices at which the time begins anew, the first sample among them."""
    with np.errstate(invalid="ignore"):
        return np.flatnonzero(np.r_[True, np.diff(time) < 0.0])
