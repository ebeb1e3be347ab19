"""What every file is read to: its bytes, and tables whose cells are numbers, texts or times."""

import calendar
import gzip
import hashlib
import io
import math
import os
import re
import zlib
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import date
from decimal import Decimal
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psa_casadi.common.errors import InputError, Problems
from psa_casadi.common.units import BoolArray, FloatArray, IndexArray, parse_unit, to_si
from psa_casadi.records.read.columns import MARKS, unit_named
from psa_casadi.records.record import FEWEST_SAMPLES

#: The most bytes that a record may have, in its file or unpacked in memory.
MOST_BYTES = 2**30
_BLOCK = 2**20
#: Bytes in memory of the fewest columns that a record has: a time and one number.
_LEAST_ON_A_LINE = 16


def check_there(path: str | os.PathLike[str]) -> None:
    """Refuse what is no file that can be read and holds something.

    Raises:
        InputError: the file is missing, a directory, unreadable or empty.
    """
    try:
        with Path(path).open("rb") as stream:
            is_empty = not stream.read(_BLOCK).strip()
    except FileNotFoundError:
        raise InputError(
            f"{path}: there is no such file; check the name and the directory it is in."
        ) from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a directory; name the CSV files in it.") from None
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); check that you may read it."
        ) from error
    if is_empty:
        raise InputError(f"{path}: the file is empty; export the record again.")


def read_text(path: str | os.PathLike[str]) -> tuple[bytes, str]:
    """Return the content of a file of text, unpacked where it is gzipped, and the file's SHA-256.

    Raises:
        InputError: it is larger than `MOST_BYTES`, or damaged.
    """
    with Path(path).open("rb") as stream:
        data = content = _most(stream.read)
    check_size(path, len(data), "holds")
    if data.startswith(b"\x1f\x8b"):
        try:
            with gzip.GzipFile(fileobj=io.BytesIO(data)) as unpacked:
                content = _most(unpacked.read)
        except (OSError, EOFError, zlib.error) as error:
            raise InputError(f"{path}: is a damaged gzip file ({error}); pack it again.") from error
        check_size(path, len(content), "holds")
    lines = max(content.count(b"\n"), content.count(b"\r"))
    check_size(path, _LEAST_ON_A_LINE * lines, "its lines need")
    return content, hashlib.sha256(data).hexdigest()


def _most(read: Callable[[int], bytes]) -> bytes:
    """Return the content that is read, or more than `MOST_BYTES` of it; takes no more memory."""
    blocks, size = [], 0
    while size <= MOST_BYTES and (block := read(_BLOCK)):
        blocks.append(block)
        size += len(block)
    return b"".join(blocks)


def check_size(path: str | os.PathLike[str], size: int, what: str) -> None:
    """Refuse more than `MOST_BYTES`; `what` starts the sentence, such as "its columns hold".

    Raises:
        InputError: `size` is larger.
    """
    if size > MOST_BYTES:
        raise InputError(
            f"{path}: {what} more than {MOST_BYTES / 2**30:.3g} GiB, the most that is read as one "
            f"record; leave out arrays that are not needed, or split the record."
        )


#: The cells of one column: numbers or instants (n,), or texts.
Cells = NDArray[Any] | Sequence[str]
#: Rows that are looked at to see what a column is.
GLANCE = 2000


@dataclass(frozen=True, eq=False)
class Columns:
    """Some columns of a table, one value for each row, and the number of each row in the file."""

    cells: Sequence[Cells]
    lines: IndexArray


#: What gives the columns of a table by their indices, at most the first rows of them. It adds rows
#: that are of another length to the problems.
Loader = Callable[[Sequence[int], int | None, Problems], Columns]


@dataclass(frozen=True, eq=False)
class Table:
    """One table of a file: the names of its columns with their units, and its cells on demand.

    `header` holds texts such as "voltage [V]"; `labels` are the names that `--columns` takes for
    them. `where` (file and line) starts the sentences about the header, `place` is what holds one
    sample: a "line", a "row", a "sample". `sizes` are the lengths of the columns where they differ.
    `step` [s] is the time between samples that the file states outside of its columns. `headless`
    has the first numbers of a table without a header, whose columns are counted from 1.
    """

    path: str
    name: str
    header: Sequence[str]
    labels: Sequence[str]
    where: str
    place: str
    load: Loader
    step: float | None = None
    sizes: Sequence[int] = ()
    headless: str = ""

    @cached_property
    def glance(self) -> Sequence[Cells]:
        """The first rows of all columns."""
        content = self.load(range(len(self.header)), GLANCE, Problems())
        return [cells[:GLANCE] for cells in content.cells]

    def part(self, name: str, columns: Sequence[int]) -> "Table":
        """Return the table of some of the columns."""

        def load(numbers: Sequence[int], most: int | None, problems: Problems) -> Columns:
            return self.load([columns[k] for k in numbers], most, problems)

        header, labels = ([item[k] for k in columns] for item in (self.header, self.labels))
        sizes = [self.sizes[k] for k in columns] if self.sizes else ()
        return replace(self, name=name, header=header, labels=labels, sizes=sizes, load=load)


def parts_of_file(tables: Sequence[Table]) -> dict[str, Table]:
    """Return the tables of a file by what chooses them: the name, if `--columns` can say it.

    All arrays of a file together, which come first, are no part of it.
    """
    parts = tables[1:] if tables[0].sizes and len(tables) > 1 else tables
    names = [t.name if t.name and not MARKS.search(t.name) else "" for t in parts]
    return {name or str(k): t for k, (name, t) in enumerate(zip(names, parts, strict=True), 1)}


#: What instruments and programs write where there is no reading, in lower case: Keysight's OVLD and
#: OL, PicoScope's infinity, Keyence's -FFFFFFF, MATLAB's and Excel's words, runs of one mark.
_MISSING = re.compile(
    r"""[+-]?(nan|n/?a|n\.a\.|\#n/?a|null|none|nil|missing|invalid|error|err|bad|no\ ?data|
        out\ of\ range|over|ovr|ovf|ovld|ovrng|overflow|overload|overrange|over\ range|under|
        underflow|underrange|o\.?l\.?|∞|infinity|f{4,}|1\.\#(inf|qnan|snan|ind)(00)?|\#(value!|div/0!|num!|null!|name\?))|
        [-+.*?_~\#–—]+""",
    re.I | re.X,
)
#: What SCPI instruments send for an overload and for no number.
_SCPI = (9.9e37, 9.91e37)
_NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)(e[+-]?\d+)?", re.I)
_FORTRAN = re.compile(r"(?<=[\d.])[dD](?=[+-]?\d+$)")
_GROUPS = re.compile(
    r"[+-]?[1-9]\d{0,2}(?P<mark>[ ,.'’\u00a0\u202f])\d{3}(?:(?P=mark)\d{3})*(?=\D|$)"
)
_WITH_UNIT = re.compile(r"(?P<number>[+-]?[\d.,]+(?:[eE][+-]?\d+)?)\s*(?P<unit>[^\d\s.,].*)")
SWAPPED = str.maketrans(".,", ",.")


def is_number(text: str) -> bool:
    """Whether a text is a number as it may stand in a table, or an empty cell's word."""
    text = text.strip().strip('"').strip().lower()
    return text in ("nan", "inf", "-inf") or bool(_NUMBER.fullmatch(_FORTRAN.sub("e", text)))


def is_missing(text: str) -> bool:
    """Whether a text marks a missing reading."""
    return not text.strip() or _MISSING.fullmatch(text.strip()) is not None


def unit_in(cells: Sequence[str]) -> str | None:
    """Return the unit in the first cell that is a number with a unit, else None."""
    for cell in cells[:50]:
        if (match := _WITH_UNIT.fullmatch(cell.strip())) and not _FORTRAN.search(cell):
            return unit_named(match["unit"], common=False)
        if not is_missing(cell):
            return None
    return None


def decimal_sign(cells: Iterable[str]) -> str:
    """Return the decimal sign of cells: of the first that has one sign only, not between groups.

    Of two signs in one cell the last is the decimal one.
    """
    for cell in cells:
        bare = cell.strip()
        point, comma = bare.rfind("."), bare.rfind(",")
        if point >= 0 and comma >= 0:
            return "." if point > comma else ","
        if max(point, comma) >= 0 and is_number(bare):
            return "." if point >= 0 else ","
    return "."


def without_overload(values: FloatArray) -> FloatArray:
    """Return numbers, nan where an instrument sent that there is no reading."""
    over = np.isin(np.abs(values), _SCPI)
    return np.where(over, math.nan, values) if over.any() else values


def numbers_in(cells: Sequence[str], point: str, unit: str) -> tuple[FloatArray, BoolArray]:
    """Return the numbers in texts, nan where there is none, and which texts are no numbers.

    A word for a missing reading is no such text. The decimal sign is `point`; a cell's unit is
    converted to `unit`.
    """
    plain = cells if point == "." else [c.translate(SWAPPED) for c in cells]
    with suppress(ValueError):
        values = np.array([float(cell or "nan") for cell in plain])
        if "_" not in "".join(cells):
            return without_overload(values), np.zeros(values.size, dtype=np.bool_)
    known = {cell: _number(cell, point, unit) for cell in set(cells)}
    parsed = [known[cell] for cell in cells]
    numbers = np.array([math.nan if v is None else v for v in parsed])
    return without_overload(numbers), np.array([v is None for v in parsed], dtype=np.bool_)


def as_numbers(cells: Cells, unit: str = "") -> FloatArray:
    """Return the numbers in cells (n,) in a unit, nan where there is none."""
    if isinstance(cells, np.ndarray):
        return cells.astype(np.float64)
    return numbers_in(cells, decimal_sign(cells), unit)[0]


def _number(cell: str, point: str, unit: str) -> float | None:
    """Return the number of a cell, nan if it marks a missing one, else None."""
    text = _FORTRAN.sub("e", cell.strip())
    if is_missing(text):
        return math.nan
    if (groups := _GROUPS.match(text)) and groups["mark"] != point:
        text = groups[0].replace(groups["mark"], "") + text[groups.end() :]
    plain = text.translate(SWAPPED) if point == "," else text
    try:
        return None if "_" in text else float(plain)
    except ValueError:
        match = _WITH_UNIT.fullmatch(text)
    stated = unit_named(match["unit"], common=False) if match else None
    number = _number(match["number"], point, unit) if match and stated else None
    if number is None or stated is None:
        return None
    try:
        one, other = parse_unit(stated), parse_unit(unit)
    except InputError:
        return None
    if one == other:
        return number
    return number * float(one.ratio / other.ratio) if one.dimension == other.dimension else None


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
    return _stamp(cell) is not None


def _stamp(cell: str) -> re.Match[str] | None:
    """Return the parts of a date, a clock time or both; None if a text is none."""
    match = _STAMP.fullmatch(cell.strip().strip('"'))
    return match if match and (match["h"] or match["a"]) else None


def unit_of_times(times: FloatArray) -> str | None:
    """Return the unit that the size of the first times implies, None if it implies none.

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


def seconds_of(cells: Sequence[str]) -> FloatArray | None:
    """Return dates and clock times as seconds from the first (n,); None where a cell is neither.

    Of 3/4/2024 the day is what makes the record the shorter one; a clock that goes back by more
    than half a day has passed midnight.
    """
    stamps = [stamp for cell in cells if (stamp := _stamp(cell))]
    if not stamps or len(stamps) < len(cells):
        return None
    exact = [_clock(m) for m in stamps]
    clock = np.array([float(t - exact[0]) for t in exact])
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


def _days(stamps: Sequence[re.Match[str]], *, day_first: bool) -> FloatArray | None:
    """Return the days from the first date, None where there is no such date."""
    known: dict[tuple[str, str, str], int] = {}
    try:
        for key in {(m["a"], m["b"], m["c"]) for m in stamps}:
            a, b, c = key
            month = None if b.isdecimal() else _MONTHS[b[:3].lower()]
            if len(a) == 4:
                year, middle, day = int(a), month or int(b), int(c)
            else:
                year = int(c) + 2000 * (len(c) < 3)
                day, middle = (int(a), month or int(b)) if day_first or month else (int(b), int(a))
            known[key] = date(year, middle, day).toordinal()
    except (ValueError, KeyError):
        return None
    days = np.array([float(known[m["a"], m["b"], m["c"]]) for m in stamps])
    return np.asarray(days - days[0])


def as_times(cells: Cells, unit: str) -> FloatArray | None:
    """Return instants, clock times and large numbers as times from the first, in a unit.

    A float would lose the last digits of large numbers. None for all others.
    """
    if not isinstance(cells, np.ndarray):
        stamps = seconds_of(cells)
        if stamps is not None:
            return stamps / float(to_si(1.0, unit))
        texts = [c.strip().strip('"').replace(",", ".") for c in cells]
        with suppress(ValueError, ArithmeticError):
            if texts and abs(float(texts[0])) > _LARGE:
                exact = [Decimal(text) for text in texts]
                return np.array([float(one - exact[0]) for one in exact])
        return None
    if cells.dtype.kind in "mM":
        since = (cells - cells[:1]).astype("timedelta64[ns]").astype(np.int64)
        return np.asarray(since / 1e9 / float(to_si(1.0, unit)))
    if cells.dtype.kind in "iu" or (
        np.abs(cells[:1]).max(initial=0.0) > _LARGE and np.isfinite(cells).all()
    ):
        return np.asarray((cells - cells[:1]).astype(np.float64))
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


def starts_of(time: FloatArray) -> IndexArray:
    """Return the indices at which the time restarts, the first sample among them."""
    with np.errstate(invalid="ignore"):
        return np.flatnonzero(np.r_[True, np.diff(time) < 0.0])
