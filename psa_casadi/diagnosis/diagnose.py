"""Diagnose: fit the base, search for causes, judge."""

from collections.abc import Callable, Sequence
from dataclasses import replace

from psa_casadi.component import Component
from psa_casadi.diagnosis.base_fit.between_samples import smooth_between
from psa_casadi.diagnosis.columns import decisions
from psa_casadi.diagnosis.driven import driven
from psa_casadi.diagnosis.noise.stuck_readings import without_stuck_readings
from psa_casadi.diagnosis.result import Diagnosis, DiagnosisInterrupted
from psa_casadi.diagnosis.search.best_first import best_first
from psa_casadi.diagnosis.search.steps import Step, steps_of, unsearched
from psa_casadi.diagnosis.task import Method, Task, Tried
from psa_casadi.diagnosis.thresholds import using
from psa_casadi.diagnosis.verdict import conclude
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.identify import unfinished
from psa_casadi.identification.prepare import averaged, columns_of, with_levels
from psa_casadi.identification.refitting import Progress, relevelled
from psa_casadi.identification.search import (
    LOAD,
    fit_base,
    is_measured,
    loads_as_curves,
    search_forms,
)
from psa_casadi.identification.start.doubts import (
    refuse_few,
    refuse_other_time,
    refuse_still,
    refuse_stuck,
    refuse_wrapped,
)
from psa_casadi.identification.start.ordinary import Hysteresis, chosen_start, forms_of
from psa_casadi.identification.start.two_clocks import on_one_clock
from psa_casadi.interruption import interruptible_work
from psa_casadi.model.compose import Model
from psa_casadi.model.own_effects import known_effects
from psa_casadi.records.excerpts import excerpts
from psa_casadi.records.quality.gaps import without_gaps
from psa_casadi.records.quality.suspects import cleaned, masked, suspects
from psa_casadi.records.read.reading import Records, records_given
from psa_casadi.records.record import Record
from psa_casadi.records.split import Experiment, divided, in_one_order
from psa_casadi.shown import sentences
from psa_casadi.simulation.ahead import compiled_ahead
from psa_casadi.simulation.one_thread import one_thread_of_algebra
from psa_casadi.simulation.timings import stage

#: So many further stuck readings are worth a second search.
MORE = 3
#: Steps of a sensor over a record's range below which it is coarse, and what is said then.
COARSE = 32
COARSE_NOTE = (
    "{}: the sensor resolves {:.0f} steps over the whole range. They make up the model's error:"
    " nothing smaller can be distinguished from them."
)
#: What is said of readings that a stuck sensor repeats.
STUCK_NOTE = "{} readings repeat the last one far from the model, as a stuck sensor does; masked."


@interruptible_work()
@one_thread_of_algebra()
def diagnose(
    records: Records,
    *,
    holdout: Records = (),
    model: Model | None = None,
    stiffness: float | None = None,
    hysteresis: Hysteresis | None = None,
    effects: Sequence[Component] | None = None,
    method: Method | None = None,
    progress: Progress = lambda _: None,
    watch: Callable[[Tried], None] = lambda _: None,
) -> Diagnosis:
    """Find what the base model gets wrong on the records, name the cause, measure the gain.

    `records` are those of one device: a record, the path of a file, a data frame or a mapping of
    arrays (see `record_from`), or several of these. Held-out data are the records `holdout`, else a
    quarter of every record in blocks (see `divided`). No fit uses them; they may reject an
    extension, and blocks help to choose between fitted models.

    `model` is where the base fit starts; `stiffness` [N/m] fixes the force scale; `hysteresis` is
    the form of the base's (see `identify`); `effects` is the table to search; `method` can leave
    parts of the method out (for its ablation). `progress` gets what is done in words, `watch` every
    hypothesis of the search (`Tried`). Raises InputError, and DiagnosisInterrupted with the best
    model so far at a keyboard interrupt once there is one.
    """
    method = method or Method()
    given, kept = records_given(records), records_given(holdout)
    with using(method.thresholds):
        with stage("preparing"):
            table = list(effects if effects is not None else known_effects().values())
            (whole, cut), (held, cut_too) = without_gaps(given), without_gaps(kept)
            ordered, apart = in_one_order(whole), in_one_order(held)
            clean, said, hidden = _cleaned(ordered)
            said += [*cut, *cut_too]
            judged = [cleaned(r) for r in apart]
            if "one clock" not in method.without:
                clean, judged = _on_one_clock(clean, said), _on_one_clock(judged, said)
            (clean, means), (judged, means_too) = averaged(clean), averaged(judged)
            start, scale_given = chosen_start(clean, model, stiffness)
            (clean, long), (judged, long_too) = excerpts(clean), excerpts(judged)
            said += [*sentences((*means, *means_too)), *long, *long_too]
            experiments = divided(clean, judged)
            columns = columns_of(start, [e.record for e in experiments])
            experiments = with_levels(experiments, columns.fitted)
            start, preferred = _in_form(columns.model, hysteresis, experiments, progress)
            refuse_stuck([e.record for e in experiments])
            known = {e.name for e in table}
            searched = (*table, *(c for c in start.effects if c.more_of in known))
            start = start.without(c.name for c in searched if c.gain is not None)
            there = {c.name for c in start.components}
            table = [e for e in table if set(e.needs) <= there and _recorded(e, experiments)]
            said += [*sentences(columns.left_out), *preferred]
        so_far: list[Fit] = []
        task = Task(
            experiments, tuple(table), method, progress, so_far.append, watch, hidden=hidden
        )
        try:
            # from the end: the screening begins at the front
            with compiled_ahead(start.with_effect(e) for e in reversed(table)):
                found = _diagnose(start, task, scale_given)
            return replace(found, notes=(*found.notes, *said))
        except KeyboardInterrupt:
            if not so_far:
                raise
            raise DiagnosisInterrupted(unfinished(so_far[-1], ordered, scale_given)) from None


def _in_form(
    start: Model,
    hysteresis: Hysteresis | None,
    experiments: Sequence[Experiment],
    progress: Progress,
) -> tuple[Model, tuple[str, ...]]:
    """Return where the base fit starts, in the form that is asked for; and why it is the best."""
    forms = forms_of(start, hysteresis)
    if len(forms) == 1:
        return forms[0], ()
    found, why = search_forms(forms, experiments, progress=progress)
    preferred = () if why is None else (why.sentence,)
    return next(m for m in forms if m.components == found.best.model.components), preferred


def _cleaned(records: Sequence[Record]) -> tuple[list[Record], list[str], float]:
    """Return the records without suspect samples, and where a sensor was saturated or coarse.

    And the share of the readings that a saturated sensor has made.

    Raises InputError where hardly a sample is left.
    """
    refuse_still(records)
    refuse_wrapped(records)
    refuse_other_time(records)
    found = [suspects(r) for r in records]
    clean = [masked(r, s) for r, s in zip(records, found, strict=True)]
    said = [s for r, own in zip(records, found, strict=True) for s in own.saturation(r.name)]
    refuse_few(records, clean, said)
    for r, own in zip(records, found, strict=True):
        if own.quantum is not None and r.range_m < COARSE * own.quantum:
            said.append(COARSE_NOTE.format(r.name, r.range_m / own.quantum))
    saturated = sum(own.counts["saturated"] for own in found)
    return clean, said, saturated / max(1, sum(int(r.mask.sum()) for r in records))


def _on_one_clock(records: Sequence[Record], said: list[str]) -> list[Record]:
    """Return the records with their readings on one clock; what is done to them goes to `said`."""
    done = [on_one_clock(r) for r in records]
    said += [s for _, own in done for s in own]
    return [r for r, _ in done]


def _diagnose(start: Model, task: Task, scale_given: bool) -> Diagnosis:
    """Diagnose from where the base fit starts; the task's `keep` gets the best fit so far."""
    experiments, table, progress = task.experiments, task.table, task.progress
    every = table
    if is_measured(experiments):
        table = tuple(e for e in table if e.measured_by != LOAD)
        experiments = loads_as_curves(start, experiments, progress)
        task = replace(task, table=table, experiments=experiments)
    base, task = _base(start, task)
    experiments, stuck = without_stuck_readings(task.experiments, base)
    if stuck:
        refuse_stuck([e.record for e in experiments])
        base, task = _base(start, replace(task, experiments=experiments))
    experiments = task.experiments
    seen = driven(base, start, experiments, progress)
    if not seen.follows:
        steps = unsearched(base, task)
        found = conclude(
            steps, experiments, table, scale_given, driven=seen.filtered, hidden=task.hidden
        )
        return replace(found, notes=(*found.notes, *seen.notes))
    steps = _search(base, task)
    fewer, more = without_stuck_readings(experiments, steps[-1].fit)
    if more >= MORE and len(steps) > 1:  # which the misfit of the base had hidden
        stuck += more
        steps, task = _searched(start, replace(task, experiments=fewer))
        experiments = task.experiments
    steps, task, between = _with_smooth_voltage(start, steps, task)
    experiments = task.experiments
    progress("judging")
    found = conclude(steps, experiments, table, scale_given, hidden=task.hidden)
    decided = decisions(steps, task, every, lambda other: _searched(start, other)[0], found.verdict)
    found = replace(found, columns=decided)
    turned = sentences([note for f in steps[0].fit.further for note in f.turned])
    notes = (*seen.notes, *between, *([STUCK_NOTE.format(stuck)] if stuck else []), *turned)
    return replace(found, notes=(*found.notes, *notes))


def _with_smooth_voltage(
    start: Model, steps: list[Step], task: Task
) -> tuple[list[Step], Task, tuple[str, ...]]:
    """Search again where the voltage is smooth between its samples; return what holds, and notes.

    As it is where the base's error shows none of it, or is no less with it.
    """
    if "between samples" not in task.method.without:
        between = smooth_between(steps[0].fit, task.experiments)
        if between is not None:
            again, other = _searched(start, replace(task, experiments=between[0]))
            if again[0].fit.rms < steps[0].fit.rms:
                return again, other, (between[1],)
    return steps, task, ()


def _base(start: Model, task: Task) -> tuple[Fit, Task]:
    """Fit the base model and keep it; return it with the task, further columns at their levels.

    Raises KeyboardInterrupt after a fit that was interrupted.
    """
    base = fit_base(start, task.experiments, progress=task.progress)
    base, experiments = relevelled(base, task.experiments)
    task.keep(base)
    if base.interrupted:
        raise KeyboardInterrupt
    return base, replace(task, experiments=experiments)


def _searched(start: Model, task: Task) -> tuple[list[Step], Task]:
    """Fit the base and search; return the steps, and the task with its columns' levels."""
    base, task = _base(start, task)
    return _search(base, task), task


def _search(base: Fit, task: Task) -> list[Step]:
    steps = steps_of(best_first(base, task), task)
    task.keep(steps[-1].fit)
    return steps


def _recorded(effect: Component, experiments: Sequence[Experiment]) -> bool:
    """Whether a record has the columns that an effect follows (a temperature) or needs."""
    columns = [n for n in effect.needs_column if any(n == q.column for q in experiments[0].further)]
    return bool(columns or not effect.needs_column) and all(
        any(getattr(e.record, i.name, None) is not None for e in experiments) for i in effect.inputs
    )
