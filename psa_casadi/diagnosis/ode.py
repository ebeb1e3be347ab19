"""Diagnose any model: fit it, search generic effects at its ports, judge."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from difflib import get_close_matches
from typing import Any

import numpy as np

from psa_casadi.common.errors import InputError, PsaError
from psa_casadi.common.notes import Note, note
from psa_casadi.diagnosis.free_functions import model_of
from psa_casadi.diagnosis.generic import Attached, effects_of, of_ones_own
from psa_casadi.diagnosis.judgement import ModelJudge
from psa_casadi.diagnosis.pack import Pack, Task
from psa_casadi.diagnosis.result import Diagnosis, DiagnosisInterrupted
from psa_casadi.diagnosis.search.best_first import best_first
from psa_casadi.diagnosis.search.hypothesis import Hypothesis, hypothesis
from psa_casadi.diagnosis.search.moves import fit_rivals
from psa_casadi.diagnosis.search.state import SearchState
from psa_casadi.diagnosis.task import Method, Tried
from psa_casadi.identification.experiments import column_notes, experiments_of, given_to, undecided
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.inputs import (
    LIKELIER,
    held_as,
    held_otherwise,
    likelier,
    other_hold,
    read_like,
    refitted,
)
from psa_casadi.identification.multistart import free_of, known_zeros, levelled, refuse_unfit
from psa_casadi.identification.own_model import (
    NEAR,
    Made,
    cut,
    fit_longer_parts,
    follows,
    forgets,
    settled,
    ways,
)
from psa_casadi.identification.refitting import reweighted, unlike, with_noise
from psa_casadi.identification.result import noise_found
from psa_casadi.model.component import Component
from psa_casadi.model.compose import Model
from psa_casadi.model.ports import parameter_ports, ports_of, with_ports
from psa_casadi.records.signals import Hold, Signals
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.sizes import sizes_of

#: The steps of a search that are a stack's: they need its voltage, its loop or its resonances.
_OF_STACKS = frozenset(
    {"one clock", "fits afresh", "resonances", "several modes", "between samples"}
)
#: Verdicts that leave something open.
_OPEN = ("unexplained", "partly_explained")
#: An input that is held is late by half a sampling interval, give or take; a fit without that delay
#: explains as much if it leaves no more than this share of the rms.
_HALF, _AS_MUCH = (0.3, 0.7), 1.2


def diagnose_ode(
    model: Model,
    records: Any,
    *,
    holdout: Any = (),
    free: Sequence[str] | None = None,
    leave_out: Sequence[str] = (),
    starts: int = 8,
    zeros: Sequence[str] = (),
    known_start: bool = False,
    hold: Hold | None = None,
    effects: Sequence[Component] = (),
    progress: Callable[[str], None] = lambda _: None,
    watch: Callable[[Tried], None] = lambda _: None,
) -> Diagnosis:
    """Find what a model gets wrong on its records, name the cause and its place, measure the gain.

    The model is fitted as by `identify`; then generic effects at its inputs, outputs and rates are
    searched by the score of a stack's diagnosis: evidence less 8 nats for every cause, confirmed by
    held-out samples. These are the records `holdout`, else a quarter of every record in blocks.
    `leave_out` names effects, or beginnings of their names such as "zero_of", that cannot be;
    `effects` are your components, which are searched with these: each has a gain and adds
    a term to a port (`applied_u` of an input u, `rate_x` of a state x, `shown_y` of an output y).
    Other words are those of `identify`. `watch` gets every hypothesis of the search (`Tried`).

    Raises InputError for records or names that do not fit, SimulationError where the model cannot
    be simulated at its values, DiagnosisInterrupted with the best model so far at a keyboard
    interrupt once there is one.
    """
    inputs, held = _given(model, records, holdout, hold)
    shifted = known_zeros(model, zeros)

    def made(length: int | None) -> tuple[Experiment, ...]:
        parts = cut(model, inputs, length), cut(model, held, length)
        return experiments_of(model, *parts, zeros=shifted, known_start=known_start)

    known_hold, of_zeros = not undecided(records, hold), [f"zero_of_{n}" for n in shifted]
    for base, _, choices in ways(
        model,
        inputs,
        made,
        free_of(model, free),
        undecided=not known_hold,
        starts=starts,
        progress=progress,
    ):
        if base.interrupted:
            raise KeyboardInterrupt
        table = _table(base, effects, leave_out, of_zeros)
        way = _Way(base, choices, table, made, known_hold, progress, watch, [base])
        with way.kept_at_interrupt():
            judge, notes = way.searched({c.name for c in effects})
        if _settled(judge):
            break
    with way.kept_at_interrupt():
        answer = judge.conclude()
    noise = noise_found(answer.extended_fit, (*inputs, *held))
    codes = {n.code for n in notes}
    remarks = (
        *(n for n in way.notes if n.code not in codes),
        *notes,
        *judge.known.remarks,
        *_entering(judge.final.view.of),
        *column_notes(model, judge.experiments),
    )
    return answer.with_noise(noise, remarks)


def _entering(of: Hypothesis) -> tuple[Note, ...]:
    """Return where noise enters a model, as far as it does not come from its sensors."""
    rows = [(f.column, c) for f, c in zip(of.fit.channels, of.colours, strict=True)]
    return tuple(
        note(
            "noise_enters", output=column, place=w.place, rate=w.rate, rms=(w.rms, w.unit),
            time=w.time, nats=c.gained,
        )
        for column, c in rows
        if (w := c.entering) is not None
    )  # fmt: skip


def _given(
    model: Model, records: Any, holdout: Any, hold: Hold | None
) -> tuple[list[Signals], list[Signals]]:
    """Return the records to fit and those to judge by. Raises InputError."""
    refuse_unfit(model)
    if model.effects:
        names = ", ".join(c.name for c in model.effects)
        raise InputError(
            f"The model '{model.name}' has effects already ({names}); diagnose it without them."
        )
    signals = given_to(model, records, hold)
    none = isinstance(holdout, tuple | list) and not holdout
    return signals, [] if none else given_to(model, holdout, hold, len(signals) + 1)


@dataclass(frozen=True)
class _Way:
    """A search from one fit, of whole records or of their parts, with `notes`.

    `made` returns the whole records; `hold_known` states whether a user has declared what inputs do
    between samples. `so_far` gets every fit that is better than those before it.
    """

    base: Fit
    notes: tuple[Note, ...]
    table: Mapping[str, Attached]
    made: Made
    hold_known: bool
    progress: Callable[[str], None]
    watch: Callable[[Tried], None]
    so_far: list[Fit]

    def searched(self, texts: Collection[str]) -> tuple[ModelJudge, tuple[Note, ...]]:
        """Return the judge of the result; parameters may change where the rest leaves much."""
        fixed = [
            n for n, e in self.table.items() if n in texts or e.component.kind != "changing gain"
        ]
        judge, notes, first = self._judged(fixed)
        if len(fixed) < len(self.table) and (judge.verdict in _OPEN or _coloured(judge)):
            self.progress("searching again, with parameters that change")
            other, more, _ = self._judged(self.table, first)
            if _better(other, judge):
                return other, (*notes, *more)
        return judge, notes

    @contextmanager
    def kept_at_interrupt(self) -> Iterator[None]:
        """Raise DiagnosisInterrupted with the best model so far at a keyboard interrupt."""
        try:
            yield
        except KeyboardInterrupt:
            best = self.so_far[-1]
            attached = [self.table[c.name] for c in best.model.effects]
            model = model_of(self.base.model, best, attached, interrupted=True)
            raise DiagnosisInterrupted(model) from None

    def _judged(
        self, names: Collection[str], before: SearchState | None = None
    ) -> tuple[ModelJudge, tuple[Note, ...], SearchState]:
        task, notes = self._task(names), tuple[Note, ...]()
        if before is None:
            searched, notes = _search(self.base, task, hold_known=self.hold_known)
        else:
            searched = best_first(before.base, task, before)
            task.keep(searched.answer.fit)
        known = searched
        hold = known.base.experiments[0].record.hold
        whole = read_like(self.made(None), hold, self.notes)
        if len(self.base.experiments) > len(whole):
            known = _of_whole(known, whole) or known
        fit_rivals(known)
        self.progress("judging")
        return ModelJudge(known, self.base.model, self.table, whole), notes, searched

    def _task(self, names: Collection[str]) -> Task:
        chosen = tuple(self.table[n].component for n in names)
        method = Method(without=_OF_STACKS)
        return Task(chosen, Pack(), method, self.progress, self.so_far.append, self.watch)


def _better(new: ModelJudge, old: ModelJudge) -> bool:
    """Whether parameters that change explain more, and with no more causes."""
    if old.verdict == "adequate":
        return new.verdict != "adequate"
    if "unexplained" in (new.verdict, old.verdict):
        return new.verdict != "unexplained"
    now, before = new.last.view.of, old.last.view.of
    fewer = len(now.causes) <= len(before.causes)
    return fewer and new.known.scale.evidence(now) > old.known.scale.evidence(before)


def _settled(judge: ModelJudge) -> bool:
    """Whether parts of records would show no more than a search in them."""
    if judge.verdict not in _OPEN:
        return settled(judge.final.fit)
    best = judge.last.fit
    return forgets(best) and (bool(judge.kept) or follows(best, NEAR))


def _coloured(judge: ModelJudge) -> bool:
    """Whether a base that lacks nothing leaves noise that is not white."""
    colours = judge.first.view.of.colours
    return judge.verdict == "adequate" and any(c.autoregression.size for c in colours)


def _search(base: Fit, task: Task, *, hold_known: bool) -> tuple[SearchState, tuple[Note, ...]]:
    """Search from a base fit, and again where the records' noise differs by what it finds.

    And with held inputs, if that is likelier and what they do between samples is not known
    (`hold_known`).
    """
    known = _once(base, task)
    noise = with_noise(known.answer.fit)
    if unlike(noise, base.experiments):
        task.progress("searching again, noise by record")
        known = _once(reweighted(base, noise), task)
    other = None if hold_known else _held_instead(known, base)
    return (known, ()) if other is None else other


def _once(base: Fit, task: Task) -> SearchState:
    ports = {*ports_of(base.model), *parameter_ports(base.model)}
    known = best_first(replace(base, model=with_ports(base.model, ports)), task)
    task.keep(known.answer.fit)
    return known


def _held_instead(known: SearchState, base: Fit) -> tuple[SearchState, tuple[Note, ...]] | None:
    """Return the result with inputs the other way between samples, if that is likelier.

    Looked for where the answer is likelier so, or has straight lines that are late by half a
    sampling interval. A cause counts as much as for the choice itself.
    """
    best, runs, hold = known.answer, known.base.experiments, other_hold(known.base.experiments)
    step = float(np.median([e.record.sample_time for e in runs]))
    times = [best.fit.model.values[f"{c.name}_time"] for c in best.causes if c.name in _late(base)]
    late = hold == "zero" and any(_HALF[0] < t / step < _HALF[1] for t in times)
    if not late and not held_otherwise(best.fit):
        return None
    others = held_as(runs, hold)
    try:
        result = _once(refitted(base, others), known.task)
    except PsaError:
        return None
    nats, more = likelier(result.answer.fit, best.fit), len(result.answer.causes) - len(best.causes)
    as_much = late and more < 0 and result.answer.fit.rms < _AS_MUCH * best.fit.rms
    if not as_much and nats < LIKELIER * (1 + more):
        return None
    return result, (note("hold_found", hold=hold, nats=max(nats, 0.0)),)


def _late(base: Fit) -> set[str]:
    return {f"{kind}_of_{n}" for kind in ("delay", "lag") for n in base.model.input_names}


def _of_whole(known: SearchState, whole: Sequence[Experiment]) -> SearchState | None:
    """Return the results of parts of records as hypotheses of the `whole` ones.

    None where the result does not follow these.
    """
    best = known.answer
    known.task.progress("fitting the whole records")
    try:
        top = fit_longer_parts(best.fit, whole)
        if not best.causes or not follows(top):
            return None
        base = fit_longer_parts(known.root.fit, whole)
        result = SearchState(levelled(base), known.task)
        for h in (h for h in known.hypotheses.values() if h.causes and h.final):
            with suppress(PsaError):
                fit = top if h is best else fit_longer_parts(h.fit, whole)
                result.note(hypothesis(h.causes, fit, final=True))
        result.conclude()
    except PsaError:
        return None
    return result


def _table(
    base: Fit, effects: Sequence[Component], leave_out: Sequence[str], known: Sequence[str]
) -> dict[str, Attached]:
    """Return the effects to search at a model's ports, by name, without those that are `known`."""
    sizes = sizes_of(base.model, base.experiments, base.starts())
    every = [*effects_of(base.model, sizes), *(of_ones_own(base.model, c) for c in effects)]
    names = [e.name for e in every]
    for name in leave_out:
        if not any(n.startswith(name) for n in names):
            near = get_close_matches(name, names, 3, 0.3) or names
            raise InputError(
                f"`leave_out` has '{name}', with which no effect's name starts; of the"
                f" {len(names)} there are, the nearest are {', '.join(near)}."
            )
    return {e.name: e for e in every if not e.name.startswith((*leave_out, *known))}
