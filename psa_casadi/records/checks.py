"""What must hold for the numbers of a record before anything is computed from them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from psa_casadi.errors import Problems
from psa_casadi.units import FloatArray

#: Fewer samples than this describe no experiment, and judge none.
FEWEST_SAMPLES = 16
#: Larger numbers are no measured ones, in whatever unit; their squares would soon be infinite.
LARGEST = 1e100

#: Of mistakes of one kind in one column, this many are described, the others counted.
LISTED = 20


@dataclass(frozen=True)
class Located:
    """One column's values, where they stand, and which of them were reported already.

    Value k stands in `place` number `lines[k]` of the file: a "line" of text, a "row" of a table.
    """

    path: str
    name: str
    values: FloatArray
    lines: NDArray[np.int64]
    reported: NDArray[np.bool_]
    place: str = "line"

    def complain(self, at: NDArray[np.bool_], sentence: str, problems: Problems) -> None:
        """Add `sentence` for every sample that `at` marks.

        In the sentence {value} is the value found and {place} what holds it.
        """
        rows = np.flatnonzero(at & ~self.reported)
        for row in rows[:LISTED]:
            found = sentence.format(value=f"{self.values[row]:.6g}", place=self.place)
            where = f"{self.path}: {self.place} {self.lines[row]}, column '{self.name}'"
            problems.add(f"{where}: {found}")
        problems.add_uncounted(max(0, rows.size - LISTED))


def check_length(path: str, samples: int, problems: Problems) -> None:
    """Demand at least `FEWEST_SAMPLES` samples."""
    if samples >= FEWEST_SAMPLES:
        return
    more = "record for longer" if samples else "fill the rows below its header"
    problems.add(
        f"{path}: found {samples} samples, expected at least {FEWEST_SAMPLES}; {more}, or name the"
        " right file."
    )


def check_time(time: Located, problems: Problems) -> None:
    """Demand finite instants, each later than the one before it."""
    check_complete(time, problems)
    known = np.flatnonzero(np.isfinite(time.values))
    wrong = np.flatnonzero(np.diff(time.values[known]) <= 0)
    if wrong.size > LISTED:
        problems.add(_disorder(time, known[wrong], known[wrong + 1]))
        return
    for row, before in zip(known[wrong + 1], known[wrong], strict=True):
        now, last = time.values[row], time.values[before]
        what = "stands still" if now == last else "goes back"
        problems.add(
            f"{time.path}: {time.place} {time.lines[row]}, column 'time': time {what} (from "
            f"{last:.9g} in {time.place} {time.lines[before]} to {now:.9g}), expected a later "
            f"instant in every {time.place}; remove repeated {time.place}s or split the file where "
            f"a new record begins."
        )


def _disorder(time: Located, before: NDArray[np.intp], after: NDArray[np.intp]) -> str:
    """Say in one sentence what is wrong with the order of many rows."""
    first, still = after[0], time.values[after] == time.values[before]
    places = f"{time.place}s"
    where = (
        f"{time.path}: column 'time': {after.size} of {time.values.size} {places} are not later"
        f" than the one before, {time.place} {time.lines[first]} the first of them"
    )
    if np.all(still):
        return f"{where}: their time stands still; remove repeated {places}."
    return f"{where}: the {places} are not in the order of time; sort them by it."


def check_complete(column: Located, problems: Problems) -> None:
    """Demand a finite number in every row."""
    column.complain(
        np.isnan(column.values),
        "found no value, expected a number; fill the cell or remove the {place}.",
        problems,
    )
    check_finite(column, problems)


def check_displacement(column: Located, problems: Problems) -> None:
    """Demand finite numbers, of which enough are there; missing ones are allowed."""
    check_finite(column, problems)
    valid = int(np.isfinite(column.values).sum())
    if column.values.size >= FEWEST_SAMPLES > valid:
        problems.add(
            f"{column.path}: column 'displacement': found {valid or 'no'} valid values in "
            f"{column.values.size} rows, expected at least {FEWEST_SAMPLES}; check that the sensor "
            f"was recorded."
        )


def check_excitation(column: Located, problems: Problems) -> None:
    """Demand a voltage that changes."""
    finite = column.values[np.isfinite(column.values)]
    if finite.size and np.ptp(finite) <= 1e-12 * np.max(np.abs(finite)):
        problems.add(
            f"{column.path}: column 'voltage': found {finite[0]:.6g} in every row, expected a "
            f"voltage that changes; a fit needs a record in which the stack is driven."
        )


def check_finite(column: Located, problems: Problems) -> None:
    """Demand measured numbers where there are any."""
    column.complain(
        np.isinf(column.values),
        "found {value}, expected a finite number; correct the cell or remove the {place}.",
        problems,
    )
    column.complain(
        np.isfinite(column.values) & (np.abs(column.values) > LARGEST),
        f"found {{value}}, expected a measured number, below {LARGEST:g}; correct the cell or"
        " remove the {place}.",
        problems,
    )
