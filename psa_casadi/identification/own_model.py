"""Identify any model from its records."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from psa_casadi.common.notes import Note, note
from psa_casadi.common.progress import Progress, silent
from psa_casadi.identification.determinacy import determinacy
from psa_casadi.identification.experiments import (
    column_notes,
    experiments_of,
    given_to,
    undecided,
)
from psa_casadi.identification.multistart import free_of, known_zeros, refuse_unfit
from psa_casadi.identification.parts import cut, ways
from psa_casadi.identification.result import (
    EXCESSIVE,
    Identification,
    doubts_of,
    noise_found,
    with_origin,
)
from psa_casadi.model.compose import Model
from psa_casadi.records.noise_kinds import notes_of
from psa_casadi.records.signals import Hold

#: A fit that leaves this share of an output's standard deviation explains nothing of it.
_ALL = 0.8


def identify_ode(
    model: Model,
    records: Any,
    *,
    free: Sequence[str] | None = None,
    starts: int = 8,
    zeros: Sequence[str] = (),
    known_start: bool = False,
    hold: Hold | None = None,
    progress: Progress = silent,
) -> Identification:
    """Fit the parameters of a model to all samples of all its records.

    `records` are `Signals`, tables with a column `time`, or CSV files, whose columns bear the names
    of the model's inputs and outputs. Between samples inputs are straight lines, or constant with
    `hold="zero"`. Maximum likelihood over all outputs, each with the noise level that it leaves,
    and if the noise of records differs, each with its level; the parameters stay within their
    bounds. `free` names the parameters to fit, all that are `fitted` by default. The initial state
    of every record is estimated too, unless it is known to be the declared one (`known_start`).
    `zeros` names outputs whose zero is unknown in each record. The search starts at the declared
    values and at `starts` - 1 random ones within the bounds, and follows the best two to their end.
    `progress` gets what is done in words, by default a terminal.

    Raises InputError for records or names that do not fit, SimulationError where the model cannot
    be simulated at its values.
    """
    refuse_unfit(model)
    signals = given_to(model, records, hold)
    shifted = known_zeros(model, zeros)
    progress("fitting from several starts")
    *_, (best, outcomes, notes) = ways(
        model, signals,
        lambda length: experiments_of(
            model, cut(model, signals, length), judged=False, zeros=shifted, known_start=known_start
        ),
        free_of(model, free), undecided=undecided(records, hold), starts=starts, progress=progress,
    )  # fmt: skip
    determined = determinacy(best)
    result = Identification(
        model=with_origin(
            best.model, [e.record for e in best.experiments], determined.names,
            determined.intervals, force_scale="given", interrupted=best.interrupted,
        ),
        fit=best,
        determinacy=determined,
        doubts=(),
        starts=outcomes,
        interrupted=best.interrupted,
    )  # fmt: skip
    doubts = (
        *doubts_of(best, determined, outcomes),
        *_of_outputs(result),
        *column_notes(model, best.experiments),
    )
    noise = () if best.interrupted else noise_found(best, signals)
    return replace(result, doubts=doubts, notes=(*notes, *notes_of(noise)), noise_kinds=noise)


def _of_outputs(identification: Identification) -> list[Note]:
    """Return notes on outputs that exceed the noise, or that the model does not follow."""
    notes, rms = [], identification.rms
    for o in identification.fit.channels:
        left, noise = rms[o.column], identification.noise[o.column]
        parts = [e.measured(o.number)[e.at(o.number)] for e in identification.experiments]
        share = left / float(np.std(np.concatenate(parts)))
        if noise > 0 and left > EXCESSIVE * noise:
            notes.append(note("output_missed", output=o.column, ratio=left / noise))
        if share > _ALL:
            notes.append(note("output_not_followed", output=o.column, share=share))
    return notes
