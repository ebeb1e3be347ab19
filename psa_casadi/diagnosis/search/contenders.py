"""The fitted effects that a diagnosis could not choose among, for the design of what would tell."""

from collections.abc import Sequence

from psa_casadi.component import Component
from psa_casadi.diagnosis.result import Contender
from psa_casadi.diagnosis.screening.evidence import credible_set
from psa_casadi.diagnosis.search.fits import to_end, with_cause
from psa_casadi.diagnosis.search.hypothesis import hypothesis, scale_of
from psa_casadi.diagnosis.search.steps import Step
from psa_casadi.diagnosis.search.view import examine
from psa_casadi.diagnosis.task import Task, same_curves
from psa_casadi.diagnosis.thresholds import thresholds
from psa_casadi.errors import InputError
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.prepare import as_read
from psa_casadi.identification.refitting import Progress
from psa_casadi.identification.search import fit_base
from psa_casadi.identification.start.ordinary import chosen_start
from psa_casadi.model.compose import Model
from psa_casadi.records.record import Record
from psa_casadi.records.split import Experiment, whole


def contenders(
    step: Step, experiments: Sequence[Experiment], names: Sequence[str] = ()
) -> tuple[Contender, ...]:
    """Return effects of one step of the search with their fits; those not fitted are fitted now.

    Without `names` they are the fewest that hold the cause with the probability `credible`. An
    effect whose fit fails is left out.
    """
    names = names or credible_set(step.probability, thresholds().credible)
    found = dict(step.fitted)
    scale = scale_of(step.view.of, step.screening.colour, 0.0, experiments)
    known = dict(step.evidence)
    for name in names:
        scores = [] if name in found else step.view.starts_of(name)
        fitted = with_cause(step.view.of, experiments, scores) if scores else None
        if fitted is not None:
            found[name] = to_end(fitted, experiments)
            known[name] = scale.gain(found[name], step.view.of)
    return tuple(Contender(n, found[n].fit, known[n]) for n in names if n in found)


def one_of_each(
    found: Sequence[Contender], experiments: Sequence[Experiment]
) -> tuple[tuple[Contender, ...], str]:
    """Return contenders of which a voltage may tell one from another, and what none will tell.

    Of effects that bend the same curve the best fit stands for all; the sentence is empty where
    there are none.
    """
    best = sorted(found, key=lambda c: c.fit.cost)
    own = [next(e for e in c.fit.model.components if e.name == c.effect) for c in best]
    groups = same_curves(experiments, own, best[0].fit) if best else ()
    rest = {name for group in groups for name in group[1:]}
    said = " ".join(same_curve_note(group) for group in groups)
    return tuple(c for c in found if c.effect not in rest), said


def same_curve_note(names: Sequence[str]) -> str:
    """Return the sentence on effects that bend the same curve."""
    return (
        f"{' and '.join(names)} bend the same curve: no voltage below the resonances tells one from"
        " another. Measure the displacement with a second sensor (column displacement_2) or the"
        " load's force (load_force), elsewhere in the range of this sensor, or without the load;"
        " or sample fast enough to excite and see the resonances."
    )


def fit_contenders(
    records: Sequence[Record],
    effects: Sequence[Component],
    *,
    model: Model | None = None,
    progress: Progress = lambda _: None,
) -> tuple[Fit, tuple[Contender, ...], tuple[Experiment, ...]]:
    """Fit the base and each of the named effects to records in full, without a verdict.

    Raises InputError where an effect cannot be fitted to them.
    """
    experiments = tuple(whole(as_read(r)) for r in records)
    start = chosen_start(records, model, None)[0].without(e.name for e in effects)
    base = fit_base(start, experiments, progress=progress)
    plain = hypothesis((), base, experiments, final=True)
    if plain is None:
        raise InputError(["The fitted base cannot be simulated over the whole of these records."])
    task = Task(experiments, tuple(effects), progress=progress)
    seen = examine(plain, task)
    progress("fitting the rivals")
    step = Step(seen, evidence=seen.estimated())
    chosen = contenders(step, experiments, [e.name for e in effects])
    lost = {e.name for e in effects} - {c.effect for c in chosen}
    if lost:
        raise InputError(
            f"{', '.join(sorted(lost))} could not be fitted to these records, so there is nothing"
            " to tell apart; leave the records out to design from ordinary sizes."
        )
    return base, chosen, experiments
