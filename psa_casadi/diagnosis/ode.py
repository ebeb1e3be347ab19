"""Diagnose any model: fit it, search generic effects at its ports, judge."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from difflib import get_close_matches
from typing import Any

from psa_casadi.component import Component
from psa_casadi.diagnosis.free_functions import model_of
from psa_casadi.diagnosis.generic.attached import Attached, of_ones_own
from psa_casadi.diagnosis.generic.of_rates import effects_of
from psa_casadi.diagnosis.judgement import ModelJudge
from psa_casadi.diagnosis.pack import Pack, Task
from psa_casadi.diagnosis.result import Diagnosis, DiagnosisInterrupted
from psa_casadi.diagnosis.search.best_first import best_first
from psa_casadi.diagnosis.search.known import Known
from psa_casadi.diagnosis.search.rivals import fit_rivals
from psa_casadi.diagnosis.task import Method, Tried
from psa_casadi.errors import InputError
from psa_casadi.identification.experiments import experiments_of, given_to, told_of_columns
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.multistart import free_of, known_zeros, refuse_unfit, search_starts
from psa_casadi.identification.noise_found import noise_found
from psa_casadi.identification.refitting import reweighted, unlike, with_noise
from psa_casadi.model.compose import Model
from psa_casadi.model.ports import with_ports
from psa_casadi.records.signals import Hold
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.sizes import sized, sizes_of

#: The steps of a search that are a stack's: they need its voltage, its loop or its resonances.
_OF_STACKS = frozenset(
    {"one clock", "fits afresh", "resonances", "several modes", "between samples"}
)


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
    `effects` are components of your own, which are searched beside these: each has a gain and adds
    a term to a port (`applied_u` of an input u, `rate_x` of a state x, `shown_y` of an output y).
    Other words are those of `identify`. `watch` gets every hypothesis of the search (`Tried`).

    Raises InputError for records or names that do not fit, SimulationError where the model cannot
    be simulated at its values, DiagnosisInterrupted with the best model so far at a keyboard
    interrupt once there is one.
    """
    refuse_unfit(model)
    if model.effects:
        names = ", ".join(c.name for c in model.effects)
        raise InputError(
            f"The model '{model.name}' has effects already ({names}); diagnose it without them."
        )
    given = given_to(model, records, hold)
    none = isinstance(holdout, tuple | list) and not holdout
    held = [] if none else given_to(model, holdout, hold, len(given) + 1)
    shifted = known_zeros(model, zeros)
    runs = experiments_of(model, given, held, zeros=shifted, known_start=known_start)
    progress("fitting from several starts")
    base, runs, _ = search_starts(sized(model, runs), runs, free_of(model, free), starts=starts)
    if base.interrupted:
        raise KeyboardInterrupt
    table = _table(base, runs, effects, leave_out, [f"zero_of_{n}" for n in shifted])
    searched, so_far = tuple(e.component for e in table.values()), [base]

    def search(base: Fit, experiments: tuple[Experiment, ...]) -> Known:
        opened = replace(base, model=with_ports(base.model))
        method, pack = Method(without=_OF_STACKS), Pack()
        task = Task(experiments, searched, pack, method, progress, so_far.append, watch)
        found = best_first(opened, task)
        task.keep(found.answer.fit)
        return found

    try:
        known = search(base, runs)
        told = with_noise(known.answer.fit, runs)
        if unlike(told, runs):
            progress("searching again, noise by record")
            known = search(reweighted(base, told), told)
        fit_rivals(known)
        progress("judging")
        found = ModelJudge(known, base.model, table).conclude()
    except KeyboardInterrupt:
        best = so_far[-1]
        attached = [table[c.name] for c in best.model.effects]
        whole = model_of(base.model, best, attached, runs, interrupted=True)
        raise DiagnosisInterrupted(whole) from None
    noise = noise_found(found.extended_fit, found.experiments, (*given, *held))
    return found.with_noise(noise, (*known.remarks, *told_of_columns(model, runs)))


def _table(
    base: Fit,
    runs: Sequence[Experiment],
    effects: Sequence[Component],
    leave_out: Sequence[str],
    known: Sequence[str],
) -> dict[str, Attached]:
    """Return the effects to search at a model's ports, by name, without those that are `known`."""
    sizes = sizes_of(base.model, runs, base.starts())
    every = [*effects_of(base.model, sizes), *(of_ones_own(base.model, c) for c in effects)]
    names = [e.name for e in every]
    for name in leave_out:
        if not any(n.startswith(name) for n in names):
            near = get_close_matches(name, names, 3, 0.3) or names
            raise InputError(
                f"`leave_out` has '{name}', which begins the name of no effect; of the"
                f" {len(names)} there are, the nearest are {', '.join(near)}."
            )
    return {e.name: e for e in every if not e.name.startswith((*leave_out, *known))}
