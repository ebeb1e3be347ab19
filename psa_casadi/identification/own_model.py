"""Identify any model from its records.

Multiple shooting: records in parts where one simulation of the whole cannot be followed.

What a model misses grows with time where it is unstable or chaotic, and stays where it integrates:
no fit comes near the data from ordinary starts, and what is missing shows as a drift.
Each part starts with a free state, which is estimated with the parameters (Bock, Recent
advances in parameter identification techniques for ODE, 1983). Short parts are fitted from several
starts; then two become one, with the state that the first began with, as long as the model follows
them. Where it follows the whole records so, they are whole again, from a better start.

An FMU that is run as a whole starts in one state only: of it, records are fitted from their
beginning on, a part first, and then twice as much. Where the declared values lead to a fit that
follows the records, no others are tried, as each run is dear.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from psa_casadi.common.errors import PsaError
from psa_casadi.common.notes import Note, note
from psa_casadi.common.progress import Progress, silent
from psa_casadi.common.units import FloatArray
from psa_casadi.identification.determinacy import determinacy
from psa_casadi.identification.experiments import column_notes, experiments_of, given_to, undecided
from psa_casadi.identification.fitting.fit import Fit, fit
from psa_casadi.identification.inputs import read_like, read_otherwise
from psa_casadi.identification.multistart import (
    free_of,
    known_zeros,
    levelled,
    refuse_unfit,
    search_starts,
)
from psa_casadi.identification.refitting import POLISH, weighted
from psa_casadi.identification.result import (
    EXCESSIVE,
    Identification,
    StartOutcome,
    doubts_of,
    noise_found,
    with_origin,
)
from psa_casadi.model.compose import Model
from psa_casadi.records.noise import first_order_noise
from psa_casadi.records.noise_kinds import notes_of
from psa_casadi.records.signals import Hold, Signals
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.sizes import sized
from psa_casadi.simulation.stepper import SimulationError

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


#: A model follows an output where it misses less than this share of its standard deviation; one
#: that forgets its start is not lost where it comes so near; beyond the last it shows nothing.
_FOLLOWED, NEAR, _LOST = 0.05, 0.5, 0.7
#: Samples of a part at least, and parts at most; most of a model that starts in one state only.
_FEWEST, _MOST, _LEAST = 16, 128, 32
#: Lengths of short parts that are tried, over the shortest.
_SHORT = (4, 2, 1)
#: A model forgets where its outputs depend on the first states less than this at the end, over how
#: they do at the beginning; so large a share of a part is its beginning, and its end.
_FORGOTTEN, _END = 0.1, 0.1
#: Largest growth of an error from the beginning of a part within it.
_GROWTH = 1000.0

#: The experiments of records in parts of a number of samples, or whole (None).
Made = Callable[[int | None], tuple[Experiment, ...]]
#: A fit, the outcome of every start, and notes.
Fitted = tuple[Fit, tuple[StartOutcome, ...], tuple[Note, ...]]


def ways(
    model: Model,
    signals: Sequence[Signals],
    made: Made,
    free: Sequence[str],
    *,
    undecided: bool,
    starts: int,
    progress: Progress = silent,
) -> Iterator[Fitted]:
    """Yield the best fit of whole records, and that of parts where these may be better.

    `made` turns the records that were `signals` into experiments, `cut` into parts or not. Where it
    is `undecided` what inputs do between samples, it is what is likelier. Whole records are left
    out where they cannot be simulated, an error grows too much in them or the fit shows nothing of
    an output, but where parts are no better. Raises SimulationError where neither whole records
    nor parts can be simulated.
    """
    runs, lost, usable = made(None), None, False
    dear = begins_once(model)
    from_several = 1 if dear else starts
    try:
        best, outcomes = search_starts(
            sized(model, runs), runs, free, starts=from_several, progress=progress
        )
    except SimulationError as error:
        lost = error
    else:
        done = best.interrupted or settled(best)
        usable = done or (follows(best, _LOST) and not _grows(best))
        if usable:
            # what a model lacks may look like a delay of half a sample; the search decides again
            open_hold = undecided and (follows(best) or not dear)
            fit_read, notes = read_otherwise(best, undecided=open_hold)
            yield fit_read, outcomes, notes
        if done:
            return
    progress("fitting parts of the records")
    if dear and lost is None and follows(best, NEAR):
        starts = 1
    result = _in_parts(model, signals, made, free, undecided, starts, progress)
    if result is not None and (
        lost or len(result[0].experiments) > len(runs) or _nearer(result[0], best)
    ):
        yield result
    elif lost is not None:
        raise lost
    elif not usable:
        best, notes = read_otherwise(best, undecided=undecided)
        yield best, outcomes, notes


def _nearer(one: Fit, other: Fit) -> bool:
    """Whether a fit leaves less of the outputs than another one, in the geometric mean."""
    pairs = zip(one.channels, other.channels, strict=True)
    return sum(float(np.log(a.rms / max(b.rms, 1e-300))) for a, b in pairs if a.rms > 0) < 0.0


def follows(of: Fit, share: float = _FOLLOWED) -> bool:
    """Whether a model follows every output of the records, but for a small share or its noise."""
    for o in of.channels:
        measured = np.concatenate([e.measured(o.number)[e.at(o.number)] for e in of.experiments])
        noise = np.repeat([first_order_noise(p)[0] if p.size else 0.0 for p in o.parts], o.lengths)
        least = EXCESSIVE * float(np.sqrt(np.mean(noise**2)))
        if o.rms > max(share * float(np.std(measured)), least):
            return False
    return True


def _in_parts(
    model: Model, signals: Sequence[Signals], made: Made, free: Sequence[str], undecided: bool,
    starts: int, progress: Progress,
) -> Fitted | None:  # fmt: skip
    """Return the fit of the longest parts that a model follows, or of whole records.

    None where it follows none, and where it forgets how records started: whole ones then
    serve as well.
    """
    shortest = _shortest(model, signals, made, free, starts, progress)
    if shortest is None:
        return None
    (best, outcomes), length = shortest
    best, notes = read_otherwise(best, undecided=undecided)
    hold, longest = best.experiments[0].record.hold, max(s.n for s in signals)
    progress("fitting longer parts")
    best, reached = _longest(best, lambda n: read_like(made(n), hold, notes), length, longest)
    if reached is not None:
        if begins_once(model) or forgets(best):
            return None
        lasts = reached * float(np.median([s.sample_time for s in signals]))
        notes = (*notes, note("in_parts", parts=len(best.experiments), lasts=(lasts, "s")))
    return levelled(best), outcomes, notes


def _shortest(
    model: Model, signals: Sequence[Signals], made: Made, free: Sequence[str], starts: int,
    progress: Progress,
) -> tuple[tuple[Fit, tuple[StartOutcome, ...]], int] | None:  # fmt: skip
    """Return the search in short parts, shorter ones where a model does not follow, and samples."""
    most = _LEAST if begins_once(model) else _MOST
    finest = max(_FEWEST, -(-sum(s.n for s in signals) // most))
    for length in (k * finest for k in _SHORT):
        if 2 * length > max(s.n for s in signals):
            continue
        parts = made(length)
        try:
            result = search_starts(
                sized(model, parts), parts, free, starts=starts, progress=progress
            )
        except PsaError:
            continue
        if result[0].interrupted:
            return None
        if follows(result[0]):
            return result, length
    return None


def _longest(best: Fit, made: Made, length: int, longest: int) -> tuple[Fit, int | None]:
    """Return the fit of the longest parts that a model follows, and their samples; None: whole."""
    reached: int | None = length
    while reached is not None:
        double = 2 * reached if 4 * reached <= longest else None
        try:
            again = fit_longer_parts(best, made(double))
        except PsaError:
            break
        if again.interrupted or not follows(again) or _grows(again):
            break
        best, reached = again, double
    return best, reached


def begins_once(model: Model) -> bool:
    """Whether a model can begin in one state only, as an FMU that is run as a whole."""
    return model.structure.played is not None


def cut(model: Model, signals: Sequence[Signals], length: int | None) -> list[Signals]:
    """Return records in parts of `length` samples, the last one of up to half of them more.

    Only the first part of each for a model that starts in one state only.
    """
    if length is None:
        return list(signals)
    if begins_once(model):
        return [s.slice(0, min(length, s.n)) for s in signals]
    result = []
    for s in signals:
        edges = [a for a in range(0, s.n, length) if not a or a <= s.n - length // 2] + [s.n]
        result += [s.slice(a, b) for a, b in pairwise(edges)] if edges[2:] else [s]
    return result


def fit_longer_parts(of: Fit, longer: Sequence[Experiment]) -> Fit:
    """Fit longer parts from the end of a fit of shorter ones. Raises SimulationError."""
    known = {_place(e): start for e, start in zip(of.experiments, of.starts(), strict=True)}
    starts: list[Mapping[str, float]] = [known.get(_place(e), {}) for e in longer]
    sigma = [of.sigma[0]] * len(longer)
    return fit(
        of.model, weighted(of, longer), of.unknowns.names, sigma=sigma, start_states=starts,
        evaluations=POLISH, tolerance=1e-6,
    )  # fmt: skip


def _place(e: Experiment) -> tuple[str, float]:
    return e.record.sha256, float(e.record.time[0])


def _influences(of: Fit) -> Iterator[FloatArray]:
    """Yield what outputs depend on the first states of every part (3, outputs).

    The largest derivative by a usual size of any state, in the first tenth of the part, in all of
    it, and in its last tenth.
    """
    for k, p in enumerate(of.predictions(further=True)):
        starts = slice(of.unknowns.first(k), of.unknowns.first(k + 1) - 1)
        each = [p.further[o.channel.outputs[0]][1][:, starts] for o in of.channels]
        size = np.max(np.abs(each), axis=2, initial=0.0)
        n = max(1, int(_END * size.shape[1]))
        spans = size[:, :n], size, size[:, -n:]
        yield np.maximum([np.max(q, axis=1) for q in spans], 1e-300)


def settled(of: Fit) -> bool:
    """Whether a model follows the records, or comes near and forgets how they began."""
    return follows(of) or (follows(of, NEAR) and forgets(of))


def _grows(of: Fit) -> bool:
    """Whether an error at the beginning of a part grows too much in it."""
    return any(np.max(whole / first) > _GROWTH for first, whole, _ in _influences(of))


def forgets(of: Fit) -> bool:
    """Whether the outputs depend less and less on the states that records began with.

    What is left of the influence at the end of a record is the product of what is in its parts.
    """
    left = dict[str, float]()
    for e, (first, _, last) in zip(of.experiments, _influences(of), strict=True):
        change = float(np.log(np.max(last / first)))
        left[e.record.sha256] = left.get(e.record.sha256, 0.0) + change
    return max(left.values()) < float(np.log(_FORGOTTEN))
