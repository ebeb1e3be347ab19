"""The samples of one experiment on any model: a time and columns by name."""

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from psa_casadi.common.display import Plotted, frame, with_units
from psa_casadi.common.errors import Problems
from psa_casadi.common.units import BoolArray, FloatArray

#: What an input does between two samples.
Hold = Literal["linear", "zero"]
#: Jumps, and their share of all moves, from which on a signal is a staircase.
_JUMPS, _NEARLY_ALL = 2, 0.8


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Signals(Plotted):
    """Samples of one experiment on any model; the arrays have shape (n,) and cannot be changed.

        Signals(name="sweep", time=t, columns={"voltage": u, "speed": w}, units={"speed": "rpm"})

    `time` [s] increases strictly and need not be uniform. `columns` are inputs and outputs by the
    names that the model gives them, in `units`, where one is missing in the model's; nan marks a
    missing sample of an output. Between samples the inputs are linear (`hold="linear"`) or constant
    (`hold="zero"`). `sha256` is that of the file at `source`, or of the arrays where there is no
    file. `notes` are sentences on what the reader took for what, `unread` the names of the file's
    other columns where one that the model has is missing.

    Raises:
        InputError: fewer than eight samples; a time that does not increase; a column of
            another length, or one that holds infinite numbers.
    """

    name: str
    time: FloatArray
    columns: Mapping[str, FloatArray]
    units: Mapping[str, str] = field(default_factory=dict)
    hold: Hold = "linear"
    sha256: str = ""
    source: str = ""
    notes: tuple[str, ...] = ()
    unread: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        time = frozen(self.time)
        columns = {str(n): frozen(v) for n, v in self.columns.items()}
        object.__setattr__(self, "time", time)
        object.__setattr__(self, "columns", columns)
        problems, where = Problems(), f"signals '{self.name}'"
        if time.ndim != 1 or time.size < 8 or not np.isfinite(time).all():
            problems.add(f"{where}: the time has shape {time.shape}; give eight or more times.")
        elif not np.all(np.diff(time) > 0):
            problems.add(f"{where}: the time does not strictly increase; sort it.")
        if self.hold not in ("linear", "zero"):
            problems.add(f"{where}: the hold '{self.hold}' does not exist; use 'linear' or 'zero'.")
        for name, values in columns.items():
            if values.shape != time.shape:
                problems.add(
                    f"{where}: '{name}' has shape {values.shape}, but time has {time.size}"
                    " samples; give one value for each instant."
                )
            elif np.isinf(values).any():
                problems.add(f"{where}: '{name}' holds infinite numbers; mark missing ones as nan.")
        problems.raise_if_any()
        if not self.sha256:
            digest = hashlib.sha256(time.tobytes())
            for name, values in sorted(columns.items()):
                digest.update(name.encode() + values.tobytes())
            object.__setattr__(self, "sha256", digest.hexdigest())

    def __repr__(self) -> str:
        """Return name, size and columns in one line."""
        names = ", ".join(self.columns)
        return f"<Signals '{self.name}': {self.n} samples in {self.duration:.4g} s of {names}>"

    @property
    def n(self) -> int:
        """Number of samples."""
        return self.time.size

    @property
    def duration(self) -> float:
        """Time from the first to the last sample [s]."""
        return float(self.time[-1] - self.time[0])

    @cached_property
    def sample_time(self) -> float:
        """Median distance between samples [s]."""
        return float(np.median(np.diff(self.time)))

    @property
    def mask(self) -> BoolArray:
        """True for every sample, shape (n,); missing readings of an output are nan."""
        return np.ones(self.n, dtype=np.bool_)

    def column(self, name: str) -> FloatArray | None:
        """Return the samples (n,) of a column by its name, None where it was not recorded."""
        return self.columns.get(name)

    def slice(self, start: int, stop: int) -> "Signals":
        """Return the samples `start <= k < stop`, eight at least; `sha256` is kept."""
        part = slice(start, stop)
        columns = {n: values[part] for n, values in self.columns.items()}
        name = f"{self.name}[{start}:{stop}]"
        return replace(self, name=name, time=self.time[part], columns=columns)

    @property
    def main_column(self) -> str:
        """The column to plot first: the last one."""
        return [*self.columns][-1]

    def to_frame(self) -> Any:
        """Return the columns as a pandas DataFrame, `time [s]` first, each with its unit."""
        return frame(with_units({"time": self.time, **self.columns}, {"time": "s", **self.units}))


def stairs(signals: Signals, names: Iterable[str]) -> tuple[str, ...]:
    """Return the columns that stand still between jumps, each within one sampling interval.

    Nearly all their moves are such jumps, of which a straight line makes a ramp. An edge drawn by
    two samples close together is none.
    """
    steps = np.diff(signals.time)
    wide, staircases = steps > 0.5 * float(np.median(steps)), []
    for name in names:
        moves = np.diff(signals.columns[name]) != 0.0
        alone = (moves & wide)[1:-1] & ~moves[:-2] & ~moves[2:]
        jumps = int(np.count_nonzero(alone))
        if jumps >= _JUMPS and jumps >= _NEARLY_ALL * np.count_nonzero(moves):
            staircases.append(name)
    return tuple(staircases)


def in_parts(records: Iterable[Any]) -> list[tuple[str, list[Any]]]:
    """Return the parts of every record (`slice`), each by the name of the whole."""
    parts: dict[tuple[str, str], list[Any]] = {}
    for r in records:
        parts.setdefault((r.name.partition("[")[0], r.sha256), []).append(r)
    return [(name if slices[1:] else slices[0].name, slices) for (name, _), slices in parts.items()]


def frozen(values: npt.ArrayLike) -> FloatArray:
    """Return numbers that cannot be changed, copied where they could."""
    array = np.asarray(values, dtype=np.float64)
    if array.flags.writeable or not array.flags.c_contiguous:
        array = array.copy()
        array.flags.writeable = False
    return array
