"""Files of one channel each, as oscilloscopes save them, as one record."""

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from psa_casadi.errors import InputError, Problems
from psa_casadi.records.read import table
from psa_casadi.records.read.choose import rises
from psa_casadi.records.read.columns import stated_unit
from psa_casadi.records.read.formats import Series, array_tables
from psa_casadi.records.read.samples import Outcome, Request, samples_of
from psa_casadi.records.read.table import Cells, Table
from psa_casadi.records.record import FEWEST_SAMPLES
from psa_casadi.units import FloatArray, to_si


def parts_of(path: str) -> list[str]:
    """Return the files that "a.csv+b.csv" names; the path itself where it is one file."""
    parts = path.split("+")
    return parts if not Path(path).exists() and all(Path(p).is_file() for p in parts) else [path]


def joined(
    files: Sequence[tuple[str, Sequence[Table], str]], request: Request, *, alone: bool = False
) -> tuple[Outcome, str]:
    """Return the samples of files that hold the channels of one record, and a hash of them all.

    Each file is given by its path, its tables and its SHA-256. The clock is that of the first;
    where another differs, its channels are interpolated at those instants that both have, and a
    note says so. A channel's name that several files have gets the file's in front. `alone` refuses
    files of several channels.

    Raises:
        InputError: a file is no table of a time and channels.
    """
    held = [(path, *_channels(path, tables)) for path, tables, _ in files]
    clocks = _clocks([(path, cells, unit) for path, cells, unit, _ in held])
    channels, resampled = [], []
    for (path, _, _, own), time in zip(held, clocks, strict=True):
        if alone and len(own) != 1:
            raise InputError(f"{path}: holds {len(own)} channels beside the time, expected one.")
        channels += [(path, name, unit, time, values) for name, unit, values in own]
    first = clocks[0]
    shared = (first >= max(t[0] for t in clocks)) & (first <= min(t[-1] for t in clocks))
    if shared.sum() < FEWEST_SAMPLES:
        raise InputError(
            f"{files[0][0]}: its clock and that of {files[1][0]} have no instants in common (begin:"
            f" {clocks[0][0]:.9g} and {clocks[1][0]:.9g} s); let both begin with the record."
        )
    names = [name for _, name, *_ in channels]
    found = [Series("time", int(shared.sum()), lambda: first[shared], "s")]
    for path, name, unit, time, values in channels:
        label = f"{Path(path).stem}.{name}" if names.count(name) > 1 else name
        same = np.array_equal(time, first)
        resampled += [] if same else [Path(path).name]
        kept = (values if same else np.interp(first, time, values))[shared]
        found.append(Series(label, kept.size, partial(np.asarray, kept), unit))
    together = "+".join(path for path, *_ in files)
    outcome = samples_of(together, array_tables(together, found)[:1], request)
    if outcome.samples is not None:
        notes = [f"the channels of {len(files)} files are one record."]
        if resampled:
            notes.append(
                f"{', '.join(resampled)} has another clock: it is interpolated at the instants of"
                f" {Path(files[0][0]).name}."
            )
        outcome.samples = replace(outcome.samples, notes=(*outcome.samples.notes, *notes))
    digest = hashlib.sha256("".join(sha for *_, sha in files).encode()).hexdigest()
    return outcome, digest


def _clocks(times: Sequence[tuple[str, Cells, str]]) -> list[FloatArray]:
    """Return the times of files, each given by path, cells and unit, on one clock [s].

    Dates and clock times are counted from the first of all files together.
    """
    texts = [[str(cell) for cell in cells] for _, cells, _ in times]
    are_stamps = [table.is_stamp(own[0]) for own in texts]
    together = table.seconds([cell for own in texts for cell in own]) if all(are_stamps) else None
    if together is not None:
        return np.split(together, np.cumsum([len(own) for own in texts])[:-1])
    if any(are_stamps):
        named = ", ".join(path for path, *_ in times)
        raise InputError(f"{named}: some have dates or clock times, others numbers; give all one.")
    return [to_si(_numbers(cells), unit) for _, cells, unit in times]


def _channels(
    path: str, tables: Sequence[Table]
) -> tuple[Cells, str, list[tuple[str, str | None, FloatArray]]]:
    """Return the times of a file with their unit, and its channels: name, unit, values."""
    table = tables[0] if tables else None
    at = next((k for k in range(len(table.header)) if rises(table, k)), None) if table else None
    if table is None or at is None:
        raise InputError(f"{path}: holds no time, which files to be joined need.")
    problems = Problems()
    columns = table.load(range(len(table.header)), None, problems)
    problems.raise_if_any()
    units = [stated_unit(text) for text in table.header]
    numbers = {k: _numbers(cells) for k, cells in enumerate(columns.cells) if k != at}
    own = [
        (table.labels[k], units[k], values)
        for k, values in numbers.items()
        if np.isfinite(values).any()
    ]
    return columns.cells[at], units[at] or "s", own


def _numbers(cells: Cells) -> FloatArray:
    if isinstance(cells, np.ndarray):
        return cells.astype(np.float64)
    return table.numbers(cells, table.decimal_sign(cells), "").values
