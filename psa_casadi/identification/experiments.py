"""The experiments of any model: its records, what is used and what is held out of them."""

from collections.abc import Sequence
from dataclasses import replace
from difflib import get_close_matches
from typing import Any, cast

import numpy as np

from psa_casadi.common.errors import InputError, Problems, quoted
from psa_casadi.common.notes import Note, note
from psa_casadi.common.units import FloatArray, convert, parse_unit, si_unit
from psa_casadi.model.compose import Model
from psa_casadi.records.read.reading import signals_given
from psa_casadi.records.record import Record
from psa_casadi.records.signals import Hold, Signals, in_parts, stairs
from psa_casadi.records.split import Channel, Experiment, divided, whole, without_gaps
from psa_casadi.records.suspects import suspects_of

#: Share of an output's range below which a difference of device and model does not count.
STRAIGHT = 2e-5
#: Noise level to begin with, over an output's standard deviation.
_FIRST_LEVEL = 0.1


def given_to(model: Model, records: Any, hold: Hold | None, first: int = 1) -> list[Signals]:
    """Return the records that a user gave to a model (`signals_given`). Raises InputError."""
    return signals_given(records, model.input_names, model.output_names, hold=hold, first=first)


def undecided(records: Any, hold: Hold | None) -> bool:
    """Whether it is open what inputs do between samples.

    No `hold` and no `Signals` state it. Those that were read from a file do where they are no
    longer linear, as every one is at first.
    """
    inputs = records if isinstance(records, list | tuple) else [records]
    stated = (r for r in inputs if isinstance(r, Signals))
    return hold is None and not any(not r.source or r.hold != "linear" for r in stated)


def experiments_of(
    model: Model,
    signals: Sequence[Signals],
    holdout: Sequence[Signals] = (),
    *,
    judged: bool = True,
    zeros: Sequence[str] = (),
    known_start: bool = False,
) -> tuple[Experiment, ...]:
    """Return the experiments of a model; some samples of them are held out if they are `judged`.

    Those of `holdout`, but for the tenth that finds their state; without such a record a quarter of
    every one in blocks, as `split` chooses them along the input that moves most. Columns are
    converted to the model's units; samples that an output's sensor has made are masked. Channels
    are the outputs that move; those of `zeros` have an offset in every record.

    Raises InputError for inputs that are missing or have gaps, for units that measure something
    else, and where no output was measured.
    """
    problems = Problems()
    fitted = {s.sha256: s.name for s in signals}
    parts = [[in_units(model, s, problems) for s in part] for part in (signals, holdout)]
    for s in (s for part in parts for s in part):
        _check(model, s, problems)
    for s in [s for s in holdout if s.sha256 in fitted]:
        problems.add(
            f"signals '{s.name}' of `holdout` are those of '{fitted[s.sha256]}', which is"
            " fitted; held-out samples must be others."
        )
    problems.raise_if_any()
    clean = [[_cleaned(model, s) for s in part] for part in parts]
    clean = [[pair for s in part for pair in _cut(model, *s)] for part in clean]
    shadows = [[_shadow(model, s) for s, _ in part] for part in clean]
    split = divided(*shadows) if judged else tuple(whole(r) for r in shadows[0])
    records = cast("Sequence[Any]", [pair for part in clean for pair in part])
    values: dict[str, float] = {}  # first instants: a part of a record may start later
    for s, _ in records:
        values[s.sha256] = min(s.time[0], values.get(s.sha256, np.inf))
    result = [
        replace(e, record=s, known_start=known_start and not later, later_part=later, remarks=notes)
        for e, (s, notes) in zip(split, records, strict=True)
        for later in [s.time[0] > values[s.sha256]]
    ]
    channels = []
    for o in model.structure.outputs:
        channel = Channel(
            o.name, o.unit, (o.name,), straight=STRAIGHT, offset=o.name in zeros, factors=False
        )
        alone = [replace(e, channels=(channel,)) for e in result]
        readings = np.concatenate([e.measured(0)[e.at(0)] for e in alone])
        if readings.size and np.ptp(readings) > 0.0:
            level = _FIRST_LEVEL * float(np.std(readings))
            channels.append(replace(channel, level=level))
    if not channels:
        raise InputError("No output moves in these records; there is nothing to fit.")
    return tuple(replace(e, channels=tuple(channels)) for e in result)


def _cut(
    model: Model, s: Signals, notes: tuple[Note | str, ...]
) -> list[tuple[Signals, tuple[Note | str, ...]]]:
    """Return the parts of signals between gaps that hide a motion of an input that is no stairs."""
    parts, cut = without_gaps([s], model.input_names if s.hold == "linear" else ())
    return [(p, () if k else (*notes, *cut)) for k, p in enumerate(parts)]


def _cleaned(model: Model, s: Signals) -> tuple[Signals, tuple[Note | str, ...]]:
    """Return signals without the samples that an output's sensor has made, and what these are."""
    inputs = {n: s.columns[n] for n in model.input_names}
    columns, notes = dict(s.columns), list[Note]()
    for o in model.structure.outputs:
        if o.name in columns:
            suspects = suspects_of(o.name, columns[o.name], o.unit, inputs)
            columns[o.name] = np.where(suspects.mask, np.nan, columns[o.name])
            notes += suspects.notes(f"{o.name} of {s.name}")
    return replace(s, columns=columns), tuple(notes)


def varied(model: Model, e: Experiment) -> str | None:
    """Return the input that moves most, over its size; None if none moves."""
    spans = {n: _moves(e.record.column(n)) for n in model.input_names}
    most = max(spans, key=lambda n: spans[n], default=None)
    return most if most is not None and spans[most] > 0 else None


def column_notes(model: Model, experiments: Sequence[Experiment]) -> tuple[Note | str, ...]:
    """Return which inputs look held between samples and are read as lines, which outputs lack.

    And what units were not stated, and which samples are masked.
    """
    records = cast("Sequence[Any]", [e.record for e in experiments])
    lines = [r for r in records if r.hold == "linear"]
    held = {
        n: tuple(name for name, item in in_parts(lines) if n in stairs(item[0], (n,)))
        for n in model.input_names
    }
    absent = [n for n in model.output_names if all(r.column(n) is None for r in records)]
    spare = {n for r in records for n in (*r.columns, *r.unread)} - set(_units(model))
    stated, units = [n for n, unit in _units(model).items() if unit != "1"], list[Note]()
    for name, (r, *_) in in_parts(records):
        bare = tuple(n for n in stated if r.units.get(n) == "")
        units += [note("no_unit", record=name, names=bare)] if bare else []
    return (
        *(note("stairs", input=n, records=names) for n, names in held.items() if names),
        *(
            note("no_column", output=n, near=tuple(get_close_matches(n, sorted(spare))))
            for n in absent
        ),
        *units,
        *(remark for e in experiments for remark in e.remarks),
    )


def _units(model: Model) -> dict[str, str]:
    inputs, outputs = model.structure.inputs, model.structure.outputs
    return {v.name: v.unit for v in inputs} | {v.name: v.unit for v in outputs}


def in_units(model: Model, s: Signals, problems: Problems) -> Signals:
    """Return the same samples in the units of a model; where that states none, in SI units."""
    columns, units, where = dict(s.columns), dict(s.units), s.source or s.name
    for name, target in _units(model).items():
        unit = s.units.get(name)
        if not unit or name not in columns:
            continue
        try:
            read = parse_unit(unit)
            if target != "1" or read.dimension == parse_unit(target).dimension:
                columns[name], units[name] = convert(columns[name], unit, target), target
            elif read.ratio != 1 or read.offset:
                problems.add(
                    f"{where}: column '{name}' is in '{unit}', of which the model '{model.name}'"
                    f" states no unit; {_declare(model, name, si_unit(unit))}"
                    "give the column without a unit, in the model's."
                )
        except InputError as error:
            problems.add(
                f"{where}: column '{name}': {error} The model '{model.name}' has it in '{target}'."
            )
    return replace(s, columns=columns, units=units)


def _declare(model: Model, name: str, unit: str) -> str:
    """Return how a unit is declared; that of an FMU is in its description."""
    kind = "Input" if name in model.input_names else "Output"
    return (
        "" if model.structure.foreign else f"declare it, as psa.{kind}('{name}', '{unit}', ''), or "
    )


def _check(model: Model, s: Signals, problems: Problems) -> None:
    for name in model.input_names:
        if name not in s.columns:
            problems.add(
                f"signals '{s.name}' lack the input '{name}' of the model '{model.name}'; they have"
                f" {quoted(sorted(s.columns))}. Name the column so."
            )
        elif not np.isfinite(s.columns[name]).all():
            problems.add(
                f"signals '{s.name}': the input '{name}' has missing samples; an input must be"
                " known throughout. Fill them, or cut the record there."
            )
    there = [n for n in model.output_names if n in s.columns]
    if not any(np.isfinite(s.columns[n]).sum() >= 8 for n in there):
        problems.add(
            f"signals '{s.name}' have no output of the model '{model.name}' with eight samples or"
            f" more; the model's are {quoted(model.output_names)}."
        )


def _shadow(model: Model, s: Signals) -> Record:
    """Return the record of one input and of what was measured, along which samples are held out."""
    moving = max(model.input_names, key=lambda n: _moves(s.columns[n]), default=None)
    there = [np.isfinite(s.columns[n]) for n in model.output_names if n in s.columns]
    return Record(
        name=s.name,
        time=s.time,
        voltage=np.zeros(s.n) if moving is None else s.columns[moving],
        displacement=np.where(np.any(there, axis=0), 0.0, np.nan),
    )


def _moves(column: FloatArray | None) -> float:
    if column is None:
        return 0.0
    return float(np.ptp(column)) / max(float(np.max(np.abs(column))), 1e-300)
