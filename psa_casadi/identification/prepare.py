"""What is done to records before they are fitted: masks, one clock, averages, further columns."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from psa_casadi.common.errors import InputError
from psa_casadi.common.notes import Note, note
from psa_casadi.identification.start.doubts import static_slope
from psa_casadi.identification.start.ordinary import capacitance_of
from psa_casadi.identification.start.two_clocks import on_one_clock
from psa_casadi.model.component import Component
from psa_casadi.model.components.outputs import monitor, second_sensor, strain_gauge
from psa_casadi.model.compose import Model
from psa_casadi.records.decimate import decimated
from psa_casadi.records.noise import fast_noise
from psa_casadi.records.record import Record
from psa_casadi.records.split import MOST, Channel, Experiment
from psa_casadi.records.suspects import cleaned, suspects

#: The columns of a stack that are fitted with its displacement, by name. The charge on a stack is
#: that of its capacitance and, by reciprocity, a share of the displacement; the current is its
#: rate, which lags faster than the sampling move most.
COLUMNS: Mapping[str, Channel] = {
    c.column: c
    for c in (
        Channel("monitor_voltage", "V", ("monitor_voltage",), scale="monitor_scale"),
        Channel("charge", "C", ("charge", "displacement"), straight=1e-2),
        Channel("current", "A", ("current", "velocity"), straight=5e-2),
        Channel("displacement_2", "m", ("displacement_2",), scale="sensor_2_scale"),
        Channel("strain", "1", ("strain",), scale="strain_scale"),
    )
}
#: The sensor that a model gets for a column.
SENSORS: Mapping[str, Component] = {
    "monitor_voltage": monitor, "displacement_2": second_sensor, "strain": strain_gauge
}  # fmt: skip


def as_read(record: Record) -> Record:
    """Return the record with suspect samples masked and its readings on one clock."""
    return on_one_clock(cleaned(record))[0]


def prepared(record: Record) -> tuple[Record, tuple[Note | str, ...]]:
    """Return the record to fit, and what was done to it.

    Outliers, drop-outs and a stuck sensor are masked; where the sampling is so fast that block
    averages lose nothing, they take the samples' place.
    """
    result = suspects(record)
    clean, clocks = on_one_clock(cleaned(record, result))
    notes: tuple[Note | str, ...] = (*result.notes(record.name), *clocks)
    shorter, averages = _averaged(clean)
    return shorter, (*notes, *averages)


def averaged(records: Sequence[Record]) -> tuple[list[Record], list[Note]]:
    """Return records with block averages where these lose nothing, and notes on it.

    As they are where all of their samples can be fitted.
    """
    if sum(r.n for r in records) <= MOST:
        return list(records), []
    ready = [_averaged(r) for r in records]
    return [r for r, _ in ready], [s for _, notes in ready for s in notes]


def _averaged(record: Record) -> tuple[Record, tuple[Note, ...]]:
    """Return a record of block averages, where they lose nothing, and a note on it."""
    y = record.measured
    noise, slope = fast_noise(y[np.isfinite(y)]), static_slope([record])
    if noise <= 0 or slope == 0:
        return record, ()
    shorter, factor = decimated(record, noise, slope)
    if factor == 1:
        return record, ()
    return shorter, (note("averaged", record=record.name, samples=record.n, block=factor),)


#: Noise level of a column before a fit, over the standard deviation of the column.
_FIRST_LEVEL = 1e-2


@dataclass(frozen=True, eq=False)
class Columns:
    """The model with what shows the further columns, their names, and what was left out and why."""

    model: Model
    fitted: tuple[str, ...]
    left_out: tuple[Note, ...] = ()


def columns_of(model: Model, records: Sequence[Record]) -> Columns:
    """Return the further columns to fit. A column that does not depend on a stack is left out.

    Raises InputError for a column that the model cannot give, or that has samples missing.
    """
    fitted, notes, problems = [], [], []
    for column, channel in COLUMNS.items():
        having = [r for r in records if getattr(r, column) is not None]
        if not having:
            continue
        wider, sensor = model, SENSORS.get(column)
        if sensor is not None and sensor.name not in (c.name for c in model.components):
            with suppress(InputError):  # where that finds nothing to show
                wider = model.with_components((*model.components, sensor))
        missing = [o for o in channel.outputs if o not in wider.output_names]
        if missing:
            problems.append(
                f"The records have the column '{column}', but the model '{model.name}' does not"
                f" give it (it has no {missing[0]}); leave the column out, or give a model with it."
            )
        elif why := _useless(column, having):
            notes.append(note(why, column=column))
        else:
            model = wider
            fitted.append(column)
    if problems:
        raise InputError(problems)
    return Columns(model, tuple(fitted), tuple(notes))


def with_levels(
    experiments: Sequence[Experiment], columns: Sequence[str]
) -> tuple[Experiment, ...]:
    """Return the experiments with first noise levels of the columns that are fitted."""
    levels = []
    for column in columns:
        having = [e for e in experiments if e.record.column(column) is not None and e.used.any()]
        values = [getattr(e.record, column)[e.used] for e in having]
        if values:
            noise = max(fast_noise(v) for v in values)
            spread = max(float(np.std(v)) for v in values)
            level = max(noise, _FIRST_LEVEL * spread)
            levels.append(replace(COLUMNS[column], level=level))
    return tuple(e.with_further(levels) for e in experiments)


def _useless(column: str, records: Sequence[Record]) -> str:
    """Return why a column is no use, as the code of a note, "" where it is."""
    if all(float(np.ptp(getattr(r, column))) == 0.0 for r in records):
        return "still_column"
    return "stray_current" if column == "current" and capacitance_of(records) is None else ""
