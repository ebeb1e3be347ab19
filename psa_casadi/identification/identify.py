"""Identify a stack from records: a search from several starts, and what the records determine."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from psa_casadi.common.display import made
from psa_casadi.common.interruption import current_work, interruptible_work
from psa_casadi.common.notes import Note, note, texts
from psa_casadi.common.progress import Progress, silent
from psa_casadi.identification.advice import Advice, advice
from psa_casadi.identification.determinacy import (
    Combination,
    Determinacy,
    assumed_ratio,
    determinacy,
    free_combinations,
)
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.inputs import even_clock
from psa_casadi.identification.prepare import columns_of, prepared, with_levels
from psa_casadi.identification.refitting import record_rms, refit, relevelled
from psa_casadi.identification.result import (
    EXCESSIVE,
    Identification,
    doubts_of,
    evidence_of,
    noise_found,
    with_origin,
)
from psa_casadi.identification.search import loads_as_curves, search_forms
from psa_casadi.identification.start.doubts import doubtful, refuse_few, refuse_unreadable
from psa_casadi.identification.start.ordinary import (
    Hysteresis,
    capacitance_of,
    chosen_start,
    forms_of,
)
from psa_casadi.identification.start.starting_points import LinearCandidate, linear_start
from psa_casadi.model.compose import Model
from psa_casadi.model.evidence import Evidence
from psa_casadi.records.noise import high_frequency_noise
from psa_casadi.records.noise_kinds import NoiseFound, notes_of
from psa_casadi.records.read.reading import Records, records_given
from psa_casadi.records.record import Record
from psa_casadi.records.split import excerpts, whole, without_gaps
from psa_casadi.simulation.side_by_side import one_thread_of_algebra

#: Rounds of fitting with every record's residual as its noise level.
_LEVEL_ROUNDS = 2

FORCE_NOTE = note("force_assumed")
INTERRUPTED = note("interrupted")


@dataclass(frozen=True, eq=False, repr=False)
class StackIdentification(Identification):
    """The identification of a stack.

    `combinations` holds what is known of parameters that trade off; `advice` the further records
    that would determine what is open. `read_off` names parameters that are estimated without a fit
    (the paper's method).
    """

    combinations: tuple[Combination, ...] = ()
    advice: tuple[Advice, ...] = ()
    read_off: tuple[str, ...] = ()

    def __repr__(self) -> str:
        """Return the result in one line."""
        return str(made("line", self))


@interruptible_work()
@one_thread_of_algebra()
def identify(
    records: Records,
    *,
    model: Model | None = None,
    stiffness: float | None = None,
    hysteresis: Hysteresis | None = None,
    progress: Progress = silent,
) -> StackIdentification:
    """Fit the base model, or `model`, to all samples of all records.

    `records` are those of one device: a record, the path of a file, a data frame or a mapping of
    arrays (see `record_from`), or several of these.
    Maximum likelihood over all records together: every record has a noise level (its residual's),
    an initial state and an offset. `stiffness` is the free stack's stiffness [N/m] from a
    data sheet; without it forces keep the scale of an assumed stiffness, which the model notes.
    `hysteresis` is its form: `bouc-wen` (as in the base model), a `spectrum` of elements (see
    `memory_spectrum`), or the `best` of them by Schwarz's criterion. A keyboard interrupt ends the
    search with the best fit so far, with a warning. Raises InputError, SimulationError.
    """
    given_records = records_given(records)
    refuse_unreadable(given_records)
    parts, cut = without_gaps(given_records)
    ready = [prepared(r) for r in parts]
    every = [r for r, _ in ready]
    fitted, long = excerpts(every)
    known = {r.sha256: r for r in parts}
    notes = [*cut, *(s for _, done in ready for s in done), *long]
    refuse_few(given_records, fitted, texts(tuple(notes)))
    start, inputs = chosen_start(every, model, stiffness)
    columns = columns_of(start, fitted)
    forms = forms_of(columns.model, hysteresis)
    start = forms[0]
    experiments = with_levels([whole(r) for r in fitted], columns.fitted)
    experiments = loads_as_curves(start, experiments, progress)
    linear: tuple[LinearCandidate, ...] = ()
    if model is None:
        progress("starting values from the records")
        linear = linear_start(fitted, start.values)
    result, preferred = search_forms(
        forms, experiments, linear=linear, thorough=True, progress=progress
    )
    best = _on_even_clock(relevelled(result.best), notes)
    best = _with_record_levels(best, progress)
    if best.interrupted:
        current_work().wrap_up()
    determined = determinacy(best, not_unique=result.not_unique, assumed=assumed_ratio(best))
    open_ones = free_combinations(best.model, determined, force_scale_given=inputs)
    advised: tuple[Advice, ...] | None = None
    evidence: Evidence | None = None
    noise: tuple[NoiseFound, ...] = ()
    if not best.interrupted:
        try:
            sampled = [known[r.sha256] for r in fitted]
            evidence = evidence_of(
                best, determined, best.predicted(), by="psa identify", sampled=sampled
            )
            noise = noise_found(best, parts)
            progress("what further records would determine")
            advised = advice(best, determined, force_scale_given=inputs)
        except KeyboardInterrupt:
            current_work().wrap_up()
    return StackIdentification(
        model=with_provenance(
            best.model, determined, given_records, inputs,
            interrupted=best.interrupted, evidence=evidence,
        ),
        fit=best,
        determinacy=determined,
        doubts=(
            *doubtful(fitted),
            *doubts_of(best, determined, result.starts, result.not_unique),
            *_excess_notes(best),
        ),
        starts=result.starts,
        notes=(
            *notes,
            *((preferred,) if preferred else ()),
            *columns.left_out,
            *(" ".join(texts(f.notes)) for f in best.further),
            *notes_of(noise),
        ),
        combinations=open_ones,
        advice=advised or (),
        interrupted=advised is None,
        noise_kinds=noise,
    )  # fmt: skip


def with_provenance(
    model: Model,
    result: Determinacy,
    records: Sequence[Record],
    stiffness_given: bool,
    *,
    interrupted: bool = False,
    evidence: Evidence | None = None,
) -> Model:
    """Return a fitted model with its records, intervals and notes as its provenance."""
    c_p = model.values.get("C_p", 0.0)
    current = capacitance_of(records)
    fits = current is not None and current.source == "current" and current.is_that_of(c_p)
    measured = {"C_p": current.interval} if current is not None and fits else {}
    return replace(
        with_origin(
            model, records, result.names, {**measured, **result.intervals},
            force_scale="given" if stiffness_given else "assumed",
            interrupted=interrupted,
            notes=(
                *((str(INTERRUPTED),) if interrupted else ()),
                *(() if stiffness_given else (str(FORCE_NOTE),)),
                *((current.sentence(c_p),) if current is not None else ()),
            ),
        ),
        evidence=evidence,
    )  # fmt: skip


def unfinished(best: Fit, records: Sequence[Record], stiffness_given: bool) -> Model:
    """Return the model of the best fit so far, marked as that of a search that was interrupted."""
    return with_origin(
        best.model, records, best.unknowns.names, {},
        force_scale="given" if stiffness_given else "assumed",
        notes=(str(INTERRUPTED), *(() if stiffness_given else (str(FORCE_NOTE),))),
        interrupted=True,
    )  # fmt: skip


def _on_even_clock(best: Fit, notes: list[Note | str]) -> Fit:
    """Fit samples at even times where the data say that the stamps jitter."""
    even = None if best.interrupted else even_clock(best)
    if even is not None:
        again = refit(best, others=even[0])
        if again.rms < best.rms:
            notes.append(even[1])
            return again
    return best


def _with_record_levels(best: Fit, progress: Progress) -> Fit:
    """Fit again with every record's residual as its noise level: its maximum-likelihood estimate.

    One record alone needs no second fit, since a common factor moves nothing but the weak priors.
    """
    for _ in range(_LEVEL_ROUNDS if len(best.experiments) > 1 else 0):
        levels = record_rms(best)
        change = np.max(np.abs(np.log(np.array(levels) / np.array(best.sigma))))
        if best.interrupted or change < 0.02:
            break
        progress("base fit with each record's noise level")
        try:
            best = refit(best, sigma=levels)
        except KeyboardInterrupt:
            return replace(best, interrupted=True, converged=False)
    return best


def _excess_notes(best: Fit) -> list[Note]:
    """Return notes on the records whose residual exceeds their noise."""
    notes = []
    for e, residual in zip(best.experiments, best.record_residuals, strict=True):
        if len(residual) < 8:
            continue
        rms, noise = float(np.sqrt(np.mean(residual**2))), high_frequency_noise(residual)
        if noise > 0 and rms > EXCESSIVE * noise:
            notes.append(note("missed", record=e.record.name, times=rms / noise))
    return notes
