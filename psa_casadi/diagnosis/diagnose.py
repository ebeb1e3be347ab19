"""Diagnose: fit the base, ask whether it is driven, search for causes, judge, weigh columns."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from psa_casadi.common.errors import InputError, PsaError, quoted
from psa_casadi.common.interruption import interruptible_work
from psa_casadi.common.notes import Note, note, texts
from psa_casadi.common.progress import Progress, silent
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.base_fit import from_resonances
from psa_casadi.diagnosis.judgement import NAMING, indistinguishable
from psa_casadi.diagnosis.noise import without_stuck_readings
from psa_casadi.diagnosis.pack import STACK, Task
from psa_casadi.diagnosis.probes import laws_of, screened_with
from psa_casadi.diagnosis.reference import Healthy
from psa_casadi.diagnosis.result import Decision, DiagnosisInterrupted, StackDiagnosis, Verdict
from psa_casadi.diagnosis.screening import further_gains
from psa_casadi.diagnosis.search.best_first import best_first
from psa_casadi.diagnosis.search.state import Step, steps_of, unsearched
from psa_casadi.diagnosis.task import Method, Thresholds, Tried
from psa_casadi.diagnosis.verdict import StackJudge
from psa_casadi.identification.fitting.fit import Fit, fit
from psa_casadi.identification.identify import identify, unfinished
from psa_casadi.identification.inputs import even_clock, smooth_between
from psa_casadi.identification.prepare import COLUMNS, averaged, columns_of, with_levels
from psa_casadi.identification.refitting import noise_levels, relevelled
from psa_casadi.identification.result import noise_found
from psa_casadi.identification.search import (
    LOAD,
    fit_base,
    is_measured,
    loads_as_curves,
    search_forms,
    without_column,
)
from psa_casadi.identification.start import doubts
from psa_casadi.identification.start.ordinary import (
    Hysteresis,
    chosen_start,
    forms_of,
    starting_model,
    stuck_values,
)
from psa_casadi.identification.start.two_clocks import on_one_clock
from psa_casadi.model.component import Component
from psa_casadi.model.compose import Model
from psa_casadi.model.user_effects import known_effects
from psa_casadi.records.noise_kinds import NoiseFound
from psa_casadi.records.read.reading import Records, records_given
from psa_casadi.records.record import Record
from psa_casadi.records.split import Experiment, divided, excerpts, in_one_order, without_gaps
from psa_casadi.records.suspects import cleaned, suspects
from psa_casadi.simulation.side_by_side import compiled_ahead, one_thread_of_algebra
from psa_casadi.simulation.timings import stage

#: A voltage with less of its variance about a parabola over time is not separated from a drift.
_TREND = 0.05
#: Samples that a linear filter of the voltage looks back, and that it needs for each of them.
_TAPS, _EACH = 128, 8


@dataclass(frozen=True)
class Driven:
    """Whether a displacement follows the voltage, and what of sign and unit is wrong.

    `filtered`: it does not follow by the base model, but by another linear one.
    """

    follows: bool
    notes: tuple[Note | str, ...]
    filtered: bool = False


def driven(base: Fit, model: Model, task: Task) -> Driven:
    """Return whether the `base` fit explains the displacement; else what the other sign explains.

    `model` is where the base fit started.
    """
    experiments, progress, limits = base.experiments, task.progress, task.limits
    if task.is_fast(base) and explained(base) < limits.follows:
        base = from_resonances(base, progress) or base
    share = explained(base)
    records = [e.record for e in experiments]
    tests = (doubts.doubtful_unit, doubts.doubtful_voltage, doubts.doubtful_time)
    notes = tuple(s for t in (*tests, doubts.doubtful_quantity) if (s := t(records)))
    if share >= limits.follows and doubts.correlation(records) > limits.falling:
        return Driven(follows=True, notes=notes)
    progress("the displacement with flipped sign")
    flipped = [replace(r, displacement=-r.measured) for r in records]
    turned = [replace(e, record=r) for e, r in zip(experiments, flipped, strict=True)]
    other, positive = 0.0, max(share, 0.0)
    with suppress(PsaError):
        other = explained(fit_base(model, turned))
    if other > max(share, limits.follows):
        return Driven(False, (note("flipped", flipped=other, share=positive), *notes))
    if share >= limits.follows:
        return Driven(follows=True, notes=notes)
    linear = filtered(experiments)
    if linear > limits.follows:
        return Driven(False, (note("filtered", linear=linear, share=positive), *notes), True)
    quantity = doubts.doubtful_quantity(records)
    return Driven(False, (note("not_driven", share=positive), *([quantity] if quantity else [])))


def explained(base: Fit) -> float:
    """Share of the displacements' variance that a fit explains over whole records; 1 is all.

    A drift does not count, a parabola over time: a base can make one from its start alone. It does
    where the voltage itself is hardly more than that.
    """
    left = total = 0.0
    for e, y in zip(base.experiments, base.predicted(), strict=True):
        inputs = e.record.measured
        valid = np.isfinite(inputs)
        time, v = e.record.time[valid], e.record.voltage[valid]
        moving = np.sum(_about_trend(time, v) ** 2) > _TREND * np.sum((v - np.mean(v)) ** 2)
        rows = ((inputs - y)[valid], inputs[valid])
        about = [_about_trend(time, r) if moving else r - np.mean(r) for r in rows]
        left += float(np.sum(about[0] ** 2))
        total += float(np.sum(about[1] ** 2))
    return 1.0 - left / total if total > 0 else 0.0


def _about_trend(time: FloatArray, signal: FloatArray) -> FloatArray:
    t = (time - time[0]) / max(float(time[-1] - time[0]), 1e-300)
    columns = np.column_stack([np.ones_like(t), t, t**2])
    values: FloatArray = signal - columns @ np.linalg.lstsq(columns, signal, rcond=None)[0]
    return values


def filtered(experiments: Sequence[Experiment]) -> float:
    """Share of the displacements' variance that linear filters of the voltage explain.

    A finite impulse response for each record with a parabola over time; variances per degree of
    freedom, so that a filter of what has nothing to do with the voltage explains nothing.
    """
    left = total = 0.0
    for e in experiments:
        record, y = e.record, e.record.measured
        taps = max(1, min(_TAPS, record.n // _EACH))
        past = np.concatenate([np.full(taps - 1, record.voltage[0]), record.voltage])
        lagged = np.lib.stride_tricks.sliding_window_view(past, taps)[record.mask]
        time = record.time[record.mask]
        reading, columns = _about_trend(time, y[record.mask]), _about_trend(time, lagged)
        rest = reading - columns @ np.linalg.lstsq(columns, reading, rcond=None)[0]
        left += record.n * float(np.sum(rest**2)) / max(rest.size - taps - 3, 1)
        total += record.n * float(np.sum(reading**2)) / max(rest.size - 3, 1)
    return 1.0 - left / total if total > 0 else 0.0


#: The places that effects belong to, in the order in which they are listed.
_PLACES = ("drive", "sensor", "plant", "environment")
#: Probability below which an effect is no rival.
_RIVAL = 0.01


def column_decisions(
    steps: Sequence[Step], task: Task, table: Sequence[Component], start: Model, verdict: Verdict
) -> tuple[Decision, ...]:
    """Return what every fitted column, and a measured load, decided.

    `table` are all effects, the base fit starts at `start`, `verdict` is that on `steps`. Each
    column costs a search.
    """
    experiments = steps[0].fit.experiments
    columns = [q.column for q in experiments[0].further]
    if is_measured(experiments):
        columns.append(LOAD)
    first, last, colour = steps[0].view.of, steps[-1].view.of, steps[-1].screening.colour
    decisions = []
    for column in columns:
        task.progress(f"the same without {column}")
        effects = task.table
        if column == LOAD:
            effects = tuple(e for e in table if e in effects or e.measured_by == LOAD)
        apart = without_column(experiments, column)
        alone = Task(effects, STACK, task.method, task.progress, hidden=task.hidden)
        now = _named(steps, task.limits) if verdict in NAMING else {}
        then = _named(_searched(start, apart, alone), task.limits)
        k = next((k for k, f in enumerate(last.fit.further) if f.column == column), None)
        gained = further_gains(first.fit, last.fit, colour).get(column, 0.0)
        by_name = {e.name: e for e in effects}
        decisions.append(
            Decision(
                column=column,
                role="input" if k is None else "output",
                unit="N" if k is None else COLUMNS[column].unit,
                noise=None if k is None else colour.further[k].rms,
                base_rms=None if k is None else first.held[k + 1],
                extended_rms=None if k is None else last.held[k + 1],
                named=now,
                named_without=then,
                ruled_out=tuple(n for n in then if n not in now),
                evidence=gained,
                outcome=decided(column, now, then, gained, by_name, clear=verdict == "adequate"),
            )
        )
    return tuple(decisions)


def _named(steps: Sequence[Step], limits: Thresholds) -> dict[str, float]:
    """Return the named set of every cause, with the probability of each effect."""
    values: dict[str, float] = {}
    for step in steps[:-1]:
        for name in (step.cause.name, *indistinguishable(step, limits)):
            if step.probability.get(name, 0.0) >= _RIVAL:
                values.setdefault(name, step.probability[name])
    return values


def decided(
    column: str,
    now: Mapping[str, float],
    then: Mapping[str, float],
    gained: float,
    table: Mapping[str, Component],
    *,
    clear: bool,
) -> Note:
    """Return what a column decided, from what is named with it and without it.

    With `clear` nothing is left to name with the column.
    """
    before = tuple(then.items())
    gone, new = [n for n in then if n not in now], tuple(n for n in now if n not in then)
    if not now and not then:
        return note("column_agrees" if clear else "column_decides_nothing", column=column)
    if not gone and not new:
        return note("column_adds", column=column, gained=gained)
    held = [n for n in gone if n in table and table[n].measured_by == column]
    if held and not now and clear:
        return note("column_holds", column=column, effect=held[0], before=before)
    if not gone:
        return note("column_names", column=column, new=new, then=tuple(then))
    if not now:
        return note("column_clears", column=column, before=before)
    kept = {table[n].belongs_to for n in now if n in table}
    lost = {table[n].belongs_to for n in gone if n in table} - kept
    places = tuple(p for p in _PLACES if p in lost)
    return note(
        "column_rules_out",
        column=column, places=places, effects=tuple(gone), now=tuple(now), before=before,
    )  # fmt: skip


#: Number of further stuck readings that justify a second search.
MORE = 3


@interruptible_work()
@one_thread_of_algebra()
def diagnose(
    records: Records,
    *,
    holdout: Records = (),
    reference: Records = (),
    model: Model | None = None,
    stiffness: float | None = None,
    hysteresis: Hysteresis | None = None,
    effects: Sequence[Component] | None = None,
    leave_out: Sequence[str] = (),
    method: Method | None = None,
    progress: Progress = silent,
    watch: Callable[[Tried], None] = lambda _: None,
) -> StackDiagnosis:
    """Find what the base model gets wrong on the records, name the cause, measure the gain.

    `records` are those of one device: a record, the path of a file, a data frame or a mapping of
    arrays (see `record_from`), or several of these. Held-out data are the records `holdout`, else a
    quarter of every record in blocks (see `divided`). No fit uses them; they may reject an
    extension, and blocks help to choose between fitted models.

    Records of the same device when it was healthy are its `reference`: what the base model leaves
    there is learnt and taken off, so that causes are named of what has changed since (see
    `reference.Healthy`).

    `model` is where the base fit starts; `stiffness` [N/m] fixes the force scale; `hysteresis` is
    the form of the base's (see `identify`); `effects` is the table to search, without those of the
    names `leave_out`; `method` can leave parts of the method out (for its ablation). `progress`
    gets what is done in words, `watch` every hypothesis of the search (`Tried`). Raises InputError,
    and DiagnosisInterrupted with the best model so far at a keyboard interrupt once there is one.
    """
    method = method or Method()
    table = tuple(effects if effects is not None else known_effects().values())
    if unknown := set(leave_out) - {c.name for c in table}:
        raise InputError(f"`leave_out` has {quoted(sorted(unknown))}, which is no effect.")
    table = tuple(c for c in table if c.name not in leave_out)
    inputs, kept = records_given(records), records_given(holdout)
    sound, since = records_given(reference), None
    if sound:
        known = identify(
            sound, model=model, stiffness=stiffness, hysteresis=hysteresis, progress=progress
        )
        progress("what the reference leaves open")
        since = Healthy(known.fit).since([*inputs, *kept])
        inputs, kept = since.taken_off(len(inputs))
        method, model = since.method(method), known.model
    so_far: list[Fit] = []
    with stage("preparing"):
        (whole, cut), (held, cut_too) = without_gaps(inputs), without_gaps(kept)
        ordered = in_one_order(whole)
        task = Task(table, STACK, method, progress, so_far.append, watch)
        start, experiments, task, scale_given, notes = _prepared(
            ordered, in_one_order(held), [*cut, *cut_too], task, model, stiffness, hysteresis,
            stuck=stuck_values(model) if model is not None and not since else (),
        )  # fmt: skip

    def diagnosed(method: Method, free: tuple[str, ...] | None) -> StackDiagnosis:
        changed = replace(task, method=method, free=free)
        return _diagnose(start, experiments, changed, scale_given)

    try:
        laws = laws_of(start, [e.record for e in experiments if e.stop], task.table)
        # from the end: the screening starts at the front
        with compiled_ahead(reversed(screened_with(start, task.table, laws))):
            result = since.concluded(method, diagnosed) if since else diagnosed(method, None)
        noise: tuple[NoiseFound, ...] = ()
        if result.verdict != "not_driven":
            noise = noise_found(result.extended_fit, (*whole, *held))
        return result.with_noise(noise, notes)
    except KeyboardInterrupt:
        if not so_far:
            raise
        raise DiagnosisInterrupted(unfinished(so_far[-1], ordered, scale_given)) from None


def _prepared(
    records: Sequence[Record],
    kept: Sequence[Record],
    cut: Sequence[str],
    task: Task,
    model: Model | None,
    stiffness: float | None,
    hysteresis: Hysteresis | None,
    *,
    stuck: tuple[str, ...],
) -> tuple[Model, tuple[Experiment, ...], Task, bool, list[Note | str]]:
    """Return where the base fit starts, the experiments, the task, and notes on the records.

    And, before these, whether the force scale is known; `kept` are records that are held out, `cut`
    the notes on their gaps, `stuck` the model's values on a bound. Raises InputError.
    """
    clean, notes, hidden = _cleaned(records)
    notes += cut
    judged = [cleaned(r) for r in kept]
    if "one clock" not in task.method.without:
        clean, judged = _on_one_clock(clean, notes), _on_one_clock(judged, notes)
    (clean, means), (judged, means_too) = averaged(clean), averaged(judged)
    start, scale_given = chosen_start(clean, model, stiffness)
    if stuck:
        values = starting_model(clean, start.values.get("k_B")).values
        start = start.with_values({n: v for n, v in values.items() if n in start.values})
        notes.append(note("stuck_start", names=stuck))
    (clean, long), (judged, long_too) = excerpts(clean), excerpts(judged)
    experiments = divided(clean, judged)
    columns = columns_of(start, [e.record for e in experiments])
    notes += [*means, *means_too, *long, *long_too, *columns.left_out]
    experiments = with_levels(experiments, columns.fitted)
    start, *forms = forms_of(columns.model, hysteresis)
    if forms:
        best, why = search_forms((start, *forms), experiments, progress=task.progress)
        notes += [why] if why else []
        start = next(m for m in (start, *forms) if m.components == best.best.model.components)
    doubts.refuse_stuck([e.record for e in experiments])
    known = {e.name for e in task.table}
    searched = (*task.table, *(c for c in start.effects if c.more_of in known))
    start = start.without(c.name for c in searched if c.gain is not None)
    there = {c.name for c in start.components}
    table = (e for e in task.table if set(e.needs) <= there and _recorded(e, experiments))
    task = replace(task, table=tuple(table), hidden=hidden)
    return start, experiments, task, scale_given, notes


def _cleaned(records: Sequence[Record]) -> tuple[list[Record], list[Note | str], float]:
    """Return the records without suspect samples, and where a sensor was saturated.

    And the share of the readings that a saturated sensor has made.

    Raises InputError where hardly a sample is left.
    """
    doubts.refuse_unreadable(records)
    pairs = [(r, suspects(r)) for r in records]
    clean = [cleaned(r, s) for r, s in pairs]
    saturation = tuple(n for r, s in pairs for n in s.saturation(r.name))
    doubts.refuse_few(records, clean, texts(saturation))
    saturated = sum(s.counts["saturated"] for _, s in pairs)
    share = saturated / max(1, sum(int(r.mask.sum()) for r in records))
    return clean, [*saturation], share


def _on_one_clock(records: Sequence[Record], notes: list[Note | str]) -> list[Record]:
    """Return the records with their readings on one clock; `notes` gets what is done."""
    done = [on_one_clock(r) for r in records]
    notes += [s for _, statements in done for s in statements]
    return [r for r, _ in done]


def _diagnose(
    start: Model, experiments: tuple[Experiment, ...], task: Task, scale_given: bool
) -> StackDiagnosis:
    """Diagnose from where the base fit starts; the task's `keep` gets the best fit so far."""
    table, progress = task.table, task.progress
    if is_measured(experiments):
        task = replace(task, table=tuple(e for e in table if e.measured_by != LOAD))
        experiments = loads_as_curves(start, experiments, progress)
    base = _base(start, experiments, task)
    sound, stuck = without_stuck_readings(base)
    if stuck:
        doubts.refuse_stuck([e.record for e in sound])
        base = _base(start, sound, task)
    read: list[Note] = []
    base = _on_even_clock(base, start, task, read)
    following = driven(base, start, task)
    if not following.follows:
        judge = StackJudge(
            unsearched(base, task), task, scale_given=scale_given, driven=following.filtered
        )
        result = judge.conclude()
        return replace(result, remarks=(*result.remarks, *following.notes))
    steps = _steps(base, task)
    fewer, more = without_stuck_readings(steps[-1].fit)
    if more >= MORE and len(steps) > 1:  # which the misfit of the base had hidden
        stuck += more
        steps = _searched(start, fewer, task)
    steps = _between_samples(steps, start, task, read)
    progress("judging")
    result = StackJudge(steps, task, scale_given=scale_given).conclude()
    columns = column_decisions(steps, task, table, start, result.verdict)
    read += [note("stuck", count=stuck)] if stuck else []
    turned = [n for f in steps[0].fit.further for n in f.turned]
    remarks = *result.remarks, *following.notes, *read, *turned, *steps[-1].remarks
    return replace(result, columns=columns, remarks=remarks)


def _on_even_clock(base: Fit, start: Model, task: Task, notes: list[Note]) -> Fit:
    """Fit the base to samples at even times where the data say that the stamps jitter."""
    even = None if "one clock" in task.method.without else even_clock(base)
    if even is not None:
        again = _base(start, even[0], task)
        if again.rms < base.rms:
            notes.append(even[1])
            return again
    return base


def _between_samples(steps: list[Step], start: Model, task: Task, notes: list[Note]) -> list[Step]:
    """Search again with a voltage that is smooth between samples where the data say so."""
    between = None
    if "between samples" not in task.method.without:
        between = smooth_between(steps[0].fit)
    if between is not None:
        again = _searched(start, between[0], task)
        if again[0].fit.rms < steps[0].fit.rms:
            notes.append(between[1])
            return again
    return steps


def _base(start: Model, experiments: tuple[Experiment, ...], task: Task) -> Fit:
    """Fit the base model, further columns at their levels, and keep it.

    Raises KeyboardInterrupt after a fit that was interrupted.
    """
    if task.free is None:
        base = fit_base(start, experiments, progress=task.progress)
    else:
        base = fit(start, experiments, task.free, sigma=noise_levels(experiments))
    base = relevelled(base)
    task.keep(base)
    if base.interrupted:
        raise KeyboardInterrupt
    return base


def _searched(start: Model, experiments: tuple[Experiment, ...], task: Task) -> list[Step]:
    """Fit the base and search; return the steps."""
    return _steps(_base(start, experiments, task), task)


def _steps(base: Fit, task: Task) -> list[Step]:
    """Search from a base fit and keep the best."""
    steps = steps_of(best_first(base, task))
    task.keep(steps[-1].fit)
    return steps


def _recorded(effect: Component, experiments: Sequence[Experiment]) -> bool:
    """Whether a record has the columns that an effect follows (a temperature) or needs."""
    columns = [n for n in effect.needs_column if any(n == q.column for q in experiments[0].further)]
    return bool(columns or not effect.needs_column) and all(
        any(getattr(e.record, i.name, None) is not None for e in experiments) for i in effect.inputs
    )
