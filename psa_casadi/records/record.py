"""One experiment: its columns, what must hold for their numbers, and the record of them."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from psa_casadi.common.errors import InputError, Problems
from psa_casadi.common.units import BoolArray, FloatArray, IndexArray
from psa_casadi.records.signals import Hold, Signals, frozen

#: Fewer samples than this describe no experiment, and judge none.
FEWEST_SAMPLES = 16
#: Larger numbers are no measured ones, in whatever unit; their squares would soon be infinite.
LARGEST = 1e100

#: Of mistakes of one kind in one column, this many are described, the others counted.
LISTED = 20


@dataclass(frozen=True)
class Located:
    """One column's values, where they stand, and which of them were reported already.

    Value k is in `place` number `lines[k]` of the file: a "line" of text, a "row" of a table. What
    the checks find is added to `problems`.
    """

    path: str
    name: str
    values: FloatArray
    lines: IndexArray
    reported: BoolArray
    place: str
    problems: Problems

    def part(self, where: slice) -> "Located":
        """Return some of the values."""
        parts = {n: getattr(self, n)[where] for n in ("values", "lines", "reported")}
        return replace(self, **parts)

    def check_time(self) -> None:
        """Demand finite instants, each later than the one before it."""
        self.check_finite(complete=True)
        values, lines, place = self.values, self.lines, self.place
        known = np.flatnonzero(np.isfinite(values))
        wrong = np.flatnonzero(np.diff(values[known]) <= 0)
        if wrong.size > LISTED:
            first, repeats = known[wrong[0] + 1], values[known[wrong]] == values[known[wrong + 1]]
            what = f": the {place}s are not in the order of time; sort them by it."
            what = f": their time repeats; remove repeated {place}s." if repeats.all() else what
            self.problems.add(
                f"{self.path}: column 'time': {wrong.size} of {values.size} {place}s are not later"
                f" than the one before, {place} {lines[first]} the first of them{what}"
            )
            return
        for row, before in zip(known[wrong + 1], known[wrong], strict=True):
            now, last = values[row], values[before]
            what = "repeats" if now == last else "goes back"
            self.problems.add(
                f"{self.path}: {place} {lines[row]}, column 'time': time {what} (from {last:.9g} in"
                f" {place} {lines[before]} to {now:.9g}), expected a later instant in every"
                f" {place}; remove repeated {place}s or split the file where a new record starts."
            )

    def check_displacement(self) -> None:
        """Demand finite numbers, of which enough are there; missing ones are allowed."""
        self.check_finite()
        valid = int(np.isfinite(self.values).sum())
        if self.values.size >= FEWEST_SAMPLES > valid:
            self.problems.add(
                f"{self.path}: column 'displacement': found {valid or 'no'} valid values in"
                f" {self.values.size} rows, expected at least {FEWEST_SAMPLES}; check that the"
                " sensor was recorded."
            )

    def check_excitation(self) -> None:
        """Demand a voltage that changes."""
        finite = self.values[np.isfinite(self.values)]
        if finite.size and np.ptp(finite) <= 1e-12 * np.max(np.abs(finite)):
            self.problems.add(
                f"{self.path}: column 'voltage': found {finite[0]:.6g} in every row, expected a"
                " voltage that changes; a fit needs a record in which the stack is driven."
            )

    def check_finite(self, *, complete: bool = False) -> None:
        """Demand measured numbers where there are any, in every row if it is to be `complete`.

        What was reported already is not reported again.
        """
        values, place = self.values, self.place
        for at, text in (
            (np.isnan(values) & complete, "found no value, expected a number; fill"),
            (np.isinf(values), "found {}, expected a finite number; correct"),
            (
                np.isfinite(values) & (np.abs(values) > LARGEST),
                f"found {{}}, expected a measured number, below {LARGEST:g}; correct",
            ),
        ):
            rows = np.flatnonzero(at & ~self.reported)
            for row in rows[:LISTED]:
                self.problems.add(
                    f"{self.path}: {place} {self.lines[row]}, column '{self.name}':"
                    f" {text.format(f'{values[row]:.6g}')} the cell or remove the {place}."
                )
            self.problems.add_uncounted(max(0, rows.size - LISTED))


@dataclass(frozen=True)
class Column:
    """One kind of column: its SI unit, the quantities it may hold and a header as an example."""

    name: str
    unit: str
    quantities: tuple[str, ...]
    example: str


#: Every column a record may have, its time and voltage first; others in a file are left alone.
COLUMNS: dict[str, Column] = {
    column.name: column
    for column in (
        Column("time", "s", ("time",), "time [s]"),
        Column("voltage", "V", ("voltage",), "voltage [V]"),
        Column("displacement", "m", ("length", "sensor counts"), "displacement [um]"),
        Column("load_force", "N", ("force",), "load_force [N]"),
        Column("current", "A", ("current",), "current [mA]"),
        Column("temperature", "K", ("temperature",), "temperature [degC]"),
        Column("monitor_voltage", "V", ("voltage",), "monitor_voltage [V]"),
        Column("charge", "C", ("charge",), "charge [uC]"),
        Column("displacement_2", "m", ("length",), "displacement_2 [um]"),
        Column("strain", "1", ("ratio",), "strain [ppm]"),
    )
}
_OPTIONAL = tuple(COLUMNS)[2:]
#: Columns whose absence is hashed too: those of the first version, so that its hashes stay.
_HASHED = ("time", "voltage", "displacement", "load_force", "current", "temperature")


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Record(Signals):
    """Samples of one experiment in SI units; the arrays have shape (n,) and cannot be changed.

        Record(name="loop", time=t, voltage=v, displacement=1e-6 * x_um)

    `time` [s] increases strictly and need not be uniform; between samples `voltage` [V] is linear.
    `displacement` is in metres, or in `displacement_unit` "counts" where the sensor's scale is
    unknown; nan marks a missing sample. `load_force` [N], `current` [A], `temperature` [K],
    `monitor_voltage` [V], `charge` [C], `displacement_2` [m] and `strain` [1] are None where they
    were not recorded. `sha256` is that of the file at `source`, or of the arrays
    where there is no file. `notes` are sentences on what the reader took for what.

    Raises:
        InputError: an array is not one-dimensional or its length differs from that of `time`; the
            time does not increase, or a number is missing, not finite or beyond 1e100.

    `identify` and `diagnose` report units that no stack has (micrometres stated as metres).
    """

    columns: Mapping[str, FloatArray] = field(init=False)
    units: Mapping[str, str] = field(init=False)
    hold: Hold = field(default="linear", init=False)
    voltage: FloatArray
    displacement: FloatArray | None = None
    load_force: FloatArray | None = None
    current: FloatArray | None = None
    temperature: FloatArray | None = None
    displacement_unit: Literal["m", "counts"] = "m"
    monitor_voltage: FloatArray | None = None
    charge: FloatArray | None = None
    displacement_2: FloatArray | None = None
    strain: FloatArray | None = None

    def __post_init__(self) -> None:
        problems, where = Problems(), f"record '{self.name}'"
        for column in COLUMNS:
            inputs = getattr(self, column)
            if inputs is None and column in _OPTIONAL:
                continue
            array = frozen(inputs)
            object.__setattr__(self, column, array)
            if array.ndim != 1 or array.size != self.time.size:
                problems.add(
                    f"{where}: '{column}' has shape {array.shape}, but time has {self.time.size}"
                    " samples; give one value for each instant."
                )
        problems.raise_if_any()
        there = {c: getattr(self, c) for c in ("voltage", *_OPTIONAL)}
        columns = {name: values for name, values in there.items() if values is not None}
        units = {name: column.unit for name, column in COLUMNS.items()}
        object.__setattr__(self, "columns", columns)
        object.__setattr__(self, "units", {**units, "displacement": self.displacement_unit})
        numbers, unreported = np.arange(self.n, dtype=np.int64), np.zeros(self.n, dtype=np.bool_)
        for column, values in {"time": self.time, **columns}.items():
            located = Located(where, column, values, numbers, unreported, "sample", problems)
            if column == "time":
                located.check_time()
            else:
                located.check_finite(complete=column != "displacement")
        problems.raise_if_any()
        if not self.sha256:
            digest = hashlib.sha256()
            for column in COLUMNS:
                array = getattr(self, column)
                if array is not None or column in _HASHED:
                    digest.update(column.encode() + (b"-" if array is None else array.tobytes()))
            object.__setattr__(self, "sha256", digest.hexdigest())

    def __repr__(self) -> str:
        """Return name, size and range in one line."""
        low, high = float(self.voltage.min()), float(self.voltage.max())
        span = ""
        if self.mask.any():
            size, counts = self.range_m, self.displacement_unit == "counts"
            span = f", range {size:.4g} counts" if counts else f", range {1e6 * size:.4g} um"
        return (
            f"<Record '{self.name}': {self.n} samples in {self.duration:.4g} s, {low:.4g} to"
            f" {high:.4g} V{span}>"
        )

    @property
    def main_column(self) -> str:
        """The column to plot first: the displacement, or the voltage where there is none."""
        return "voltage" if self.displacement is None else "displacement"

    @property
    def mask(self) -> BoolArray:
        """True where a displacement was measured, shape (n,); all False without displacement."""
        if self.displacement is None:
            return np.zeros(self.n, dtype=np.bool_)
        return np.isfinite(self.displacement)

    @property
    def measured(self) -> FloatArray:
        """The measured displacement [m].

        Raises:
            InputError: no displacement was measured.
        """
        if self.displacement is None:
            raise InputError(f"Record '{self.name}' has no displacement; a fit compares with one.")
        return self.displacement

    @property
    def range_m(self) -> float:
        """Largest minus smallest displacement [m], or in counts where the record is in counts.

        Raises:
            InputError: no displacement was measured.
        """
        if self.displacement is None or not self.mask.any():
            raise InputError(
                f"record '{self.name}' has no displacement, so it has no range; use a record with "
                f"a displacement column."
            )
        return float(np.nanmax(self.displacement) - np.nanmin(self.displacement))

    def slice(self, start: int, stop: int) -> "Record":
        """Return the samples `start <= k < stop`, counted as Python counts; `sha256` is kept.

        Raises:
            InputError: fewer than two samples remain.
        """
        part = slice(start, stop)
        first, last, _ = part.indices(self.n)
        if last - first < 2:
            raise InputError(
                f"record '{self.name}': samples {start} to {stop} of {self.n} leave fewer than "
                f"two; choose a longer part."
            )
        arrays = {c: a[part] for c in _OPTIONAL if (a := getattr(self, c)) is not None}
        name = f"{self.name}[{first}:{last}]"
        return replace(self, name=name, time=self.time[part], voltage=self.voltage[part], **arrays)
