"""The experiments of any model: its records, what is used and what is held out of them."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from psa_casadi.errors import InputError, Problems
from psa_casadi.model.compose import Model
from psa_casadi.notes import Note, note
from psa_casadi.records.record import Record
from psa_casadi.records.signals import Signals, stairs, unit_hint
from psa_casadi.records.split import Channel, Experiment, divided, whole

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

#: Share of an output's range below which no difference between a device and a model is told.
STRAIGHT = 2e-5
#: Noise level to begin with, over an output's standard deviation.
_FIRST_LEVEL = 0.1


def noise_share(experiments: Sequence[Experiment], channel: int) -> float:
    """Return the rms of a channel's `noise` over the samples that judge, else over the fitted."""
    counts = [int(c.sum()) for c in counted(experiments, channel)]
    squares = [e.share(channel) ** 2 for e in experiments]
    return float(np.sqrt(np.average(squares, weights=counts)))


def missed_rms(
    experiments: Sequence[Experiment], shown: Sequence[FloatArray], channel: int
) -> float:
    """Return the rms of measured minus predicted of a channel, in its unit, over these samples."""
    rows = zip(experiments, shown, counted(experiments, channel), strict=True)
    errors = np.concatenate([(e.measured(channel) - y[:, channel])[c] for e, y, c in rows])
    return float(np.sqrt(np.mean(errors**2)))


def counted(experiments: Sequence[Experiment], channel: int) -> list[BoolArray]:
    """Return the samples of a channel that judge, the fitted ones where none does."""
    judged = [e.at(channel, e.held_out) for e in experiments]
    some = any(j.any() for j in judged)
    return judged if some else [e.at(channel) for e in experiments]


def runs_of(
    model: Model,
    given: Sequence[Signals],
    holdout: Sequence[Signals] = (),
    *,
    judged: bool = True,
    zeros: Sequence[str] = (),
    known_start: bool = False,
) -> tuple[Experiment, ...]:
    """Return the experiments of a model; some samples of them are held out if they are `judged`.

    Those of `holdout`, but for the tenth that finds their state; without such a record a quarter of
    every one in blocks, as `split` chooses them along the input that moves most. Their channels are
    the outputs that move; those of `zeros` have an offset of their own in every record.

    Raises InputError for inputs that are missing or have gaps, and where no output was measured.
    """
    problems = Problems()
    fitted = {s.sha256: s.name for s in given}
    for s in (*given, *holdout):
        _check(model, s, problems)
    for s in [s for s in holdout if s.sha256 in fitted]:
        problems.add(
            f"signals '{s.name}' of `holdout` are those of '{fitted[s.sha256]}', which is"
            " fitted; held-out samples must be others."
        )
    problems.raise_if_any()
    shadows = [[_shadow(model, s) for s in part] for part in (given, holdout)]
    split = divided(*shadows) if judged else tuple(whole(r) for r in shadows[0])
    records = cast("Sequence[Any]", (*given, *holdout))
    found = [
        replace(e, record=r, known_start=known_start) for e, r in zip(split, records, strict=True)
    ]
    channels = []
    for o in model.structure.outputs:
        channel = Channel(
            o.name, o.unit, (o.name,), straight=STRAIGHT, offset=o.name in zeros, factors=False
        )
        own = [replace(e, channels=(channel,)) for e in found]
        parts = [e.measured(0)[e.at(0)] for e in own]
        spread = float(np.std(np.concatenate(parts))) if any(p.size for p in parts) else 0.0
        if spread > 0.0:
            channels.append(replace(channel, level=_FIRST_LEVEL * spread))
    if not channels:
        raise InputError("No output moves in these records; there is nothing to fit.")
    return tuple(replace(e, channels=tuple(channels)) for e in found)


def varied(model: Model, e: Experiment) -> str | None:
    """Return the input that moves most, over its own size; None where none does."""
    spans = {n: _moves(e.record.column(n)) for n in model.input_names}
    most = max(spans, key=lambda n: spans[n], default=None)
    return most if most is not None and spans[most] > 0 else None


def told_of_columns(model: Model, experiments: Sequence[Experiment]) -> tuple[Note, ...]:
    """Return which inputs look held between samples and are read as lines, which outputs lack."""
    records = cast("Sequence[Any]", [e.record for e in experiments])
    lines = [r for r in records if r.hold == "linear"]
    held = {n: tuple(s.name for s in lines if n in stairs(s, (n,))) for n in model.input_names}
    absent = [n for n in model.output_names if all(r.column(n) is None for r in records)]
    return (
        *(note("stairs", input=n, records=records) for n, records in held.items() if records),
        *(note("no_column", output=n) for n in absent),
    )


def _check(model: Model, s: Signals, problems: Problems) -> None:
    for name in model.input_names:
        if name not in s.columns:
            problems.add(
                f"signals '{s.name}' lack the input '{name}' of the model '{model.name}'; they have"
                f" {sorted(s.columns)}. Name the column so.{unit_hint(s.columns)}"
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
            f" more; the model's are {model.output_names}.{unit_hint(s.columns)}"
        )


def _outputs(model: Model, s: Signals) -> FloatArray:
    missing = np.full(s.n, np.nan)
    return np.column_stack([s.columns.get(n, missing) for n in model.output_names])


def _shadow(model: Model, s: Signals) -> Record:
    """Return the record of one input and of what was measured, along which samples are held out."""
    moving = max(model.input_names, key=lambda n: _moves(s.columns[n]), default=None)
    there = np.isfinite(_outputs(model, s)).any(axis=1)
    return Record(
        name=s.name,
        time=s.time,
        voltage=np.zeros(s.n) if moving is None else s.columns[moving],
        displacement=np.where(there, 0.0, np.nan),
    )


def _moves(column: FloatArray | None) -> float:
    if column is None:
        return 0.0
    return float(np.ptp(column)) / max(float(np.max(np.abs(column))), 1e-300)
