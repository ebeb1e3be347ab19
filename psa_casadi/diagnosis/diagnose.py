"""Diagnose: fit the base, screen the effects, fit the leading ones, choose, repeat, judge."""

from collections.abc import Sequence
from dataclasses import replace

from psa_casadi.component import Component
from psa_casadi.diagnosis.base_fit.retries import (
    BETTER_BASE,
    from_band,
    from_extension,
    from_mode,
    from_resonances,
    instead_of,
    rings,
)
from psa_casadi.diagnosis.held_out.errors import held_out_rms
from psa_casadi.diagnosis.noise.stuck_readings import without_stuck_readings
from psa_casadi.diagnosis.result import Diagnosis
from psa_casadi.diagnosis.search.backward import reconsidered
from psa_casadi.diagnosis.search.extension import extend_any
from psa_casadi.diagnosis.search.rounds import AFRESH, Round, decide, examine, search_cause
from psa_casadi.diagnosis.standing import is_open, left, missed, worth_searching
from psa_casadi.diagnosis.task import Method, Task
from psa_casadi.diagnosis.verdict import conclude
from psa_casadi.errors import PsaError
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.search.multistart import fit_base
from psa_casadi.identification.search.refitting import Progress, refit
from psa_casadi.identification.start.ordinary import chosen_start
from psa_casadi.model.compose import Model
from psa_casadi.model.own_effects import known_effects
from psa_casadi.records.quality.suspects import cleaned
from psa_casadi.records.record import Record
from psa_casadi.records.split import Experiment, divided, in_one_order
from psa_casadi.simulation.one_thread import one_thread_of_algebra
from psa_casadi.simulation.timings import stage

#: Most causes that are named for one set of records.
MOST_CAUSES = 3
#: A better base replaces an effect if it leaves at most this much more of the residual.
AS_GOOD = 1.005
#: So many further stuck readings are worth a second search.
MORE = 3
#: What is said of readings that a stuck sensor repeats.
STUCK_NOTE = "{} readings repeat the last one far from the model, as a stuck sensor does; masked."


@one_thread_of_algebra()
def diagnose(
    records: Sequence[Record],
    *,
    holdout: Sequence[Record] = (),
    model: Model | None = None,
    stiffness: float | None = None,
    effects: Sequence[Component] | None = None,
    method: Method | None = None,
    progress: Progress = lambda _: None,
) -> Diagnosis:
    """Find what the base model gets wrong on the records, name the cause, measure the gain.

    Held-out data are the records `holdout`, else a quarter of every record in blocks (see
    `divided`); they choose nothing but whether an extension may stay. `model` is where the base fit
    starts; `stiffness` [N/m] fixes the force scale; `effects` is the table to search; `method` can
    leave parts of the method out (for its negative controls). Raises InputError.
    """
    with stage("preparing"):
        table = list(effects if effects is not None else known_effects().values())
        records, holdout = in_one_order(records), in_one_order(holdout)
        experiments = divided([cleaned(r) for r in records], [cleaned(r) for r in holdout])
        start, scale_given = chosen_start(records, model, stiffness)
        start = start.without(c.name for c in table if c.gain is not None)
        there = {c.name for c in start.components}
        table = [e for e in table if set(e.needs) <= there and _recorded(e, experiments)]
    base = fit_base(start, experiments, progress=progress)
    experiments, stuck = without_stuck_readings(experiments, base)
    if stuck:
        base = fit_base(start, experiments, progress=progress)
    task = Task(experiments, tuple(table), method or Method(), progress)
    rounds = _search(base, task)
    fewer, more = without_stuck_readings(experiments, rounds[-1].fit)
    if more >= MORE and len(rounds) > 1:  # which the misfit of the base had hidden
        experiments, stuck = fewer, stuck + more
        base = fit_base(start, experiments, progress=progress)
        rounds = _search(base, replace(task, experiments=experiments))
    progress("judging")
    found = conclude(rounds, experiments, table, scale_given)
    return replace(found, notes=(*found.notes, STUCK_NOTE.format(stuck))) if stuck else found


def _recorded(effect: Component, experiments: Sequence[Experiment]) -> bool:
    """Whether a record has the columns that an effect follows (a temperature)."""
    return all(
        any(getattr(e.record, i.name, None) is not None for e in experiments) for i in effect.inputs
    )


def _search(base: Fit, task: Task) -> list[Round]:
    """Forward selection: add the best effect until nothing is seen or nothing helps."""
    rounds = _forward(base, task)
    tried = [rounds]
    if is_open(rounds) and not task.fast:
        better = from_resonances(rounds[0].fit, task.experiments, task.progress)
        if better is not None:
            tried.append(rounds := _forward(better, task))
    if rounds[-1].test.alarm or len(rounds) > 1:
        before = rounds[-1].fit
        resonant = from_band(rounds[0].fit, before, task.experiments, task.progress)
        if resonant is not None:
            rounds = min(rounds, _forward(resonant, task), key=missed)
    for earlier in tried:
        if is_open(rounds):
            rounds = min(rounds, _any(earlier, task), key=left)
    return _settle(reconsidered(rounds, task), task)


def _any(rounds: list[Round], task: Task) -> list[Round]:
    """Search on from the best of the effects that were not fitted afresh, if that leads further.

    Where the base is bent to a missing effect the screening may rank that one far behind.
    """
    first = replace(rounds[0], extensions=list(rounds[0].extensions))
    done = {e.effect.name for e in first.extensions[:AFRESH]}
    scores = [s for n, s in first.screening.best_by_effect().items() if n not in done]
    task.progress("cause 1: all other effects afresh")
    found = extend_any(first.fit, task.experiments, scores, first.screening.colour)
    if found is None:
        return rounds
    first.extensions = [e for e in first.extensions if e.effect is not found.effect] + [found]
    decide(first, 1, task)
    if first.chosen is None:
        return rounds
    other = _with_better_base([first], set(), task)
    if other is None:
        after = examine(first.chosen.fit, first.chosen.predicted, task, first.trials)
        other = _causes([first, after], task, retry=True)
    return min(rounds, other, key=left)


def _forward(base: Fit, task: Task) -> list[Round]:
    """Make sure of the base where something is missing, then add causes."""
    first = _round(base, task)
    if task.fast and first.test.alarm:
        resonant = from_resonances(first.fit, task.experiments, task.progress)
        first = first if resonant is None else _round(resonant, task)
    if first.test.alarm:
        resonant = from_band(first.fit, first.fit, task.experiments, task.progress)
        near = None if resonant is None else _round(resonant, task)
        if near is not None and not near.test.alarm and not worth_searching([near]):
            first = near
    return _causes([first], task, retry=True)


def _causes(rounds: list[Round], task: Task, *, retry: bool) -> list[Round]:
    """Add the best effect until nothing is seen or helps; `retry` the base from where it led."""
    tried = set[str]()
    while len(rounds) <= MOST_CAUSES and worth_searching(rounds):
        current = rounds[-1]
        first = rounds[0].chosen if len(rounds) > 1 else None
        search_cause(current, len(rounds), task, first)
        chosen = current.chosen
        if chosen is None:
            break
        other = _with_better_base(rounds, tried, task) if retry else None
        if other is not None:
            return other
        rounds.append(examine(chosen.fit, chosen.predicted, task, current.trials))
    return rounds


def _with_better_base(rounds: Sequence[Round], tried: set[str], task: Task) -> list[Round] | None:
    """Search from a better base, if one leaves no structure or hardly more than the last cause."""
    chosen = rounds[-1].chosen
    better = _retried(rounds, tried, task)
    if better is None or chosen is None:
        return None
    other = _causes([_round(better, task)], task, retry=False)
    good = not other[-1].test.alarm or other[-1].fit.rms < AS_GOOD * chosen.fit.rms
    return other if good else None


def _retried(rounds: Sequence[Round], tried: set[str], task: Task) -> Fit | None:
    """Fit the base from where the last round led, or with resonances; None if it is no better."""
    base, current = rounds[0].fit, rounds[-1]
    chosen = current.chosen
    if chosen is None:
        return None
    if rings(chosen) and "mode" not in tried:
        tried.add("mode")
        own = from_mode(base, current.fit, chosen, task.experiments, task.progress)
        if own is not None:
            return own
    if len(rounds) == 2 and "band" not in tried:
        tried.add("band")
        return from_band(base, current.fit, task.experiments, task.progress)
    if len(rounds) > 1 or "extension" in tried:
        return None
    tried.add("extension")
    task.progress("base fit, from the extension's parameters")
    again = from_extension(base, chosen, task.experiments)
    if again is not None and again.rms < BETTER_BASE * base.rms:
        return again
    return instead_of(base, chosen, task.experiments, task.progress)


def _round(base: Fit, task: Task) -> Round:
    return examine(base, tuple(base.predicted(task.experiments)), task)


@stage("causes together")
def _settle(rounds: list[Round], task: Task) -> list[Round]:
    """Where two causes or more leave structure, fit all their parameters together once more."""
    last = rounds[-1]
    if len(rounds) < 3 or not last.test.alarm:
        return rounds
    task.progress("all causes together, to the end")
    try:
        again = refit(last.fit, task.experiments, last.fit.unknowns.names)
    except PsaError:
        return rounds
    predicted = tuple(again.predicted(task.experiments))
    before = held_out_rms(task.experiments, last.predicted)
    if held_out_rms(task.experiments, predicted) < before:
        rounds[-1] = replace(last, fit=again, predicted=predicted)
    return rounds
