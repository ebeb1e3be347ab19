"""Moves of the search for more than one effect: modes, exchanges, several at once, rivals."""

from collections.abc import Sequence
from dataclasses import asdict, replace

import numpy as np

from psa_casadi.common.errors import PsaError
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.screening import Copy, Score, best_sets, copies, temperature
from psa_casadi.diagnosis.search import fits
from psa_casadi.diagnosis.search.hypothesis import Hypothesis, hypothesis
from psa_casadi.diagnosis.search.state import FINALISTS, NEAR, SearchState, nearly
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.start.linear_response import MOST_DAMPED, Mode, Response, modes_of
from psa_casadi.model.component import Component
from psa_casadi.model.compose import Model
from psa_casadi.model.effects.mechanics import FEWEST, MODAL_SERIES, MOST, structural_mode
from psa_casadi.model.shapes import stiffness_scale
from psa_casadi.records.record import Record
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.side_by_side import side_by_side
from psa_casadi.simulation.simulate import accurate, record_inputs
from psa_casadi.simulation.start import start_on
from psa_casadi.simulation.timings import stage

#: Samples of all records from which modes are read off; evaluations of the fit.
_ENOUGH, _EVALUATIONS = 20_000, 20
#: To what share of the rms each mode must bring the residual. The seven largest of a mirror's axis
#: do, the next one does not; noise has no mode that does.
_LOWERED = 0.95
#: Number of fits of one mode in the place of several that go to their end.
_ALONE = 3
_RTOL = 1e-4


def with_modes(before: Hypothesis) -> Hypothesis | None:
    """Fit with a series of modes; None where the residual shows fewer than two, or no fit works.

    Modes that a fit damps until they ring no more are left out: they stand for something else.
    """
    if "wafer_force" not in before.fit.model.structure.balances:
        return None
    experiments = before.experiments
    even = [k for k, e in enumerate(experiments) if not e.held_out_whole and _even(e.record.time)]
    most = _ENOUGH // max(1, len(even))
    shaken, free = [], []
    for k in even:
        e = experiments[k]
        part = _moving(e, most)
        first, last = (int(e.used[:end].sum()) for end in (part.start, part.stop))
        try:
            drive = _at_rest(before.fit.model, e.record, e.stop)
        except PsaError:
            return None
        left = e.record.measured[part] - before.predicted[k][part]
        shaken.append(Response(e.record.sample_time, drive[part], left, e.used[part]))
        free.append(before.fit.jacobian[before.fit.parts[k]][first:last])
    modes = modes_of(shaken, np.vstack(free), most=MOST, better=_LOWERED) if shaken else []
    fit, states = before.fit, tuple(before.fit.starts())
    while len(modes) >= FEWEST:
        effect = MODAL_SERIES[len(modes)]
        values = {
            f"series_{name}_{k}": value
            for k, mode in enumerate(modes, 1)
            for name, value in asdict(mode).items()
        }
        added = [(effect, values, 1.0)]
        result = fits.fit_with_all(fit, added, states, {}, _EVALUATIONS)
        if result is None:
            return None
        ringing = [m for m in _modes(result, len(modes)) if m.damping < MOST_DAMPED]
        if len(ringing) == len(modes):
            return hypothesis((*before.causes, effect), result)
        base = result.model.without([effect.name])
        modes, states = ringing, tuple(result.starts())
        fit = replace(before.fit, model=base)
    return None


def one_mode(series: Hypothesis, less: Hypothesis) -> list[Hypothesis]:
    """Fit one mode in the place of a series, from each of those, and the best to the end.

    The series is the last cause; `less` is the hypothesis without it. The base starts where the
    series has led it: modes may stand for what the base without them had bent itself to.
    """
    fit = series.fit
    states = tuple(fit.starts())
    low, high = next(p.bounds for p in structural_mode.parameters if p.name == "mode_lead")
    starts: list[fits.Start] = []
    for mode in _modes(fit, series.causes[-1].count):
        lead = float(np.clip(mode.ahead / (mode.share or 1e-300), low, high))
        form = {
            "mode_frequency": mode.frequency, "mode_damping": mode.damping, "mode_lead": lead
        }  # fmt: skip
        starts.append((form, mode.share, states))
    results = side_by_side(lambda s: fits.exchanged(series, less, structural_mode, s, fit), starts)
    best = sorted((h for h in results if h is not None), key=lambda h: h.fit.cost)[:_ALONE]
    return side_by_side(fits.to_end, best)


def _even(time: FloatArray) -> bool:
    """Whether times (n,) lie on an even grid but for a tenth of a step."""
    grid = np.linspace(time[0], time[-1], time.size)
    return bool(np.max(np.abs(time - grid)) < 0.1 * (time[-1] - time[0]) / (time.size - 1))


def _moving(e: Experiment, most: int) -> slice:
    """Return `most` samples at most, from where the voltage starts to move."""
    v = e.record.voltage[: e.stop]
    moves = np.flatnonzero(v != v[0])
    begin = max(0, int(moves[0]) - 1) if moves.size else 0
    return slice(begin, min(e.stop, begin + most))


def _modes(fit: Fit, count: int) -> list[Mode]:
    """Return the modes of a fit."""
    names = ("frequency", "damping", "share", "ahead")
    values = fit.model.values
    return [Mode(*(values[f"series_{name}_{k}"] for name in names)) for k in range(1, count + 1)]


def _at_rest(model: Model, record: Record, count: int) -> FloatArray:
    """Return the displacement that the wafers' force has at rest [m], at the first samples."""
    t, u = record.time[:count] - record.time[0], record_inputs(model, record, count)
    steps, _ = accurate(model, t, u, start_on(model, t, u).x, rtol=_RTOL, hold="linear")
    values = model.structure.balance("wafer_force").map(count)
    p = np.tile(model.parameter_vector()[:, None], count)
    result: FloatArray = values(t[None], steps.x.T, u.T, p).full().ravel()
    return result / stiffness_scale(model.values)


#: Largest number of rivals of a cause that are fitted, and of copies.
_MOST = 3


@stage("causes judged again")
def exchange(h: Hypothesis, known: SearchState) -> None:
    """Fit in each cause's place what the screening with all others finds near it."""
    for cause in h.causes:
        less = known.hypotheses.get(h.names - {cause.name})
        if less is None:
            continue
        if len(h.causes) > 1:
            for starts in _near(h, less, known)[:_MOST]:
                known.task.progress(f"{_effect(starts).name} in the place of {cause.name}")
                _put_in_place(h, less, starts, known)
            known.remember(less, cause.name)
        for copy in _copies(h, less, known):
            name = copy.direction.effect.name
            known.task.progress(f"{name}, which could copy {cause.name}")
            known.note(fits.like(h, less, copy, known.near(less, h)))
            known.remember(less, name)


def _near(h: Hypothesis, less: Hypothesis, known: SearchState) -> list[list[Score]]:
    """Return the starts of effects that promise nearly what `h` gains with the causes of `less`.

    They are not among the causes, and bend no curve that one of them bends.
    """
    view = known.view(less)
    promised = view.estimated()
    least = nearly(known.scale.evidence(h) - known.scale.evidence(less))
    return [
        starts
        for starts in view.leading()
        if promised[_effect(starts).name] > least
        and _effect(starts).name not in h.names
        and known.different(_effect(starts), less)
    ]


def _put_in_place(
    h: Hypothesis, less: Hypothesis, starts: Sequence[Score], known: SearchState
) -> None:
    """Fit an effect with the causes of `less`, from there and from where `h` has led the base.

    To the end where that comes near.
    """
    goal = known.near(less, h)
    rival = fits.with_cause(less, starts, goal)
    known.note(rival)
    if rival is None:
        return
    effect = _effect(starts)
    known.note(fits.in_place(h, less, h.fit, rival.fit, effect, goal))
    known.remember(less, effect.name)
    best = known.hypotheses.get(rival.names)
    if best is not None and known.scale.evidence(best) > known.scale.evidence(h) - NEAR:
        known.finish([best])


def _copies(h: Hypothesis, less: Hypothesis, known: SearchState) -> list[Copy]:
    """Return effects that could add what the cause not in `less` adds, but were not fitted so.

    A copy that leaves so little of the contribution's sum of squares D that D (1 - R^2)/2 is
    below `NEAR` might explain the data as well; a fit much worse than its copy was lost.
    """
    pairs = zip(h.predicted, less.predicted, h.experiments, strict=True)
    added = np.concatenate([(p - q)[e.at(h.fit.channels[0].number)] for p, q, e in pairs])
    table = [e for e in known.task.table if e.name not in h.names]
    trials = [d for d in known.trials if d.effect in table and known.different(d.effect, less)]
    power, result = copies(less.fit, added, trials, known.scale.colour, known.task.limits)
    evidence = known.scale.evidence(h)
    lost: dict[str, float] = {}
    for name, copy in result.items():
        left = 0.5 * power * (1.0 - copy.share)
        fitted = known.hypotheses.get(less.names | {name})
        reached = -np.inf if fitted is None else known.scale.evidence(fitted)
        if left < NEAR and reached < evidence - left - NEAR:
            lost[name] = left
    return [result[n] for n in sorted(lost, key=lambda n: lost[n])[:_MOST]]


def _effect(starts: Sequence[Score]) -> Component:
    return starts[0].direction.effect


#: Largest number of sets that are fitted.
_SETS = 4
#: ... and of those among them that are pairs with the best cause alone.
_PAIRS = 2


@stage("fits of several at once")
def fit_sets(known: SearchState, h: Hypothesis) -> None:
    """Fit the base with the sets of two effects and more that promise most together.

    The cause that explains most alone, that of `h`, may stand for several and hold the search
    there: sets without it are tried. Or it is one of them: pairs with what leads with it are
    tried, as a fit that adds one cause to the other may end in another minimum than one that starts
    with both. These go to their end, since they need more steps for it.
    """
    root, task, price = known.root, known.task, known.scale.limits.price
    view, similar = known.view(root), task.indistinguishable(root.fit)
    if not view.trials:
        return
    every = [
        results
        for size in range(2, task.limits.most_causes + 1)
        for results in best_sets(
            root.fit, view.trials, view.screening.colour, size, similar, task.limits
        )
    ]
    ranked = sorted(every, key=lambda s: price * len(s.names) - s.promise)
    with_best = [h.names | {n} for n in known.view(h).screening.leading()[:_PAIRS] if h.causes]
    pairs = [s for s in ranked if s.names in with_best]
    apart = [s for s in ranked if not s.names & h.names]
    starts = [s for s in [*pairs, *apart] if s.names not in known.hypotheses][:_SETS]
    text = ", ".join("+".join(sorted(s.names)) for s in starts)
    task.progress(f"several causes: fitting {text}")
    goal = fits.cost_beside(known.best(), root)
    ways = [fits.with_causes]
    if "fits afresh" not in task.method.without:
        ways.append(fits.with_causes_afresh)
    jobs = [(way, s) for way in ways for s in starts]
    results = side_by_side(lambda j: j[0](root, j[1], goal), jobs)
    fitted = [f for f in results if f is not None]
    better = [f for f in fitted if f.names in with_best and known.scale.evidence(f) > 0.0]
    tried = sorted((f for f in fitted if f not in better), key=lambda h: -known.scale.score(h))
    # of two fits of one set the better one so far need not be the one that ends lower
    best, others = [*better, *tried[:FINALISTS]], tried[FINALISTS:]
    task.progress(f"{', '.join('+'.join(sorted(h.names)) for h in best)} to the end")
    ended = side_by_side(lambda h: fits.to_end(h, goal), best)
    for f in [*ended, *others]:
        known.note(f)


@stage("fits afresh")
def fit_from_other_parents(h: Hypothesis, known: SearchState) -> None:
    """Fit children of a hypothesis from their other parents, where those promise more.

    With fewer causes a fit may have ended in another minimum, and a deeper one. If causes add up,
    a child gains what both of its parents have gained over what these share.
    """
    evidence = known.scale.evidence
    for cause in h.causes:
        shared = known.hypotheses.get(h.names - {cause.name})
        if shared is None or not shared.causes:
            continue
        gained = evidence(h) - evidence(shared) - known.scale.limits.price
        for child in known.children(h):
            other = known.hypotheses.get(child.names - {cause.name})
            if other is not None and evidence(other) + gained > evidence(child):
                added = child.causes[-1].name
                known.task.progress(f"cause {len(child.causes)}: {added} once more")
                known.note(fits.in_place(child, other, other.fit, h.fit, cause))


def fit_rivals(known: SearchState) -> None:
    """Fit to their end the effects that may be in the place of each cause of the answer.

    By their estimated evidence with the other causes they are not clearly less likely.
    """
    best = known.answer
    for cause in best.causes:
        names = best.names - {cause.name}
        if names not in known.hypotheses:
            known.note(fits.without(best, cause))
        less = known.hypotheses.get(names)
        if less is None:
            continue
        view, base_evidence = known.view(less), known.scale.evidence(less)
        top = known.scale.evidence(best) - base_evidence
        near = top - known.task.limits.clearly * temperature(top)
        for name, evidence in view.estimated().items():
            if evidence > near and names | {name} not in known.hypotheses:
                known.note(fits.with_cause(less, view.starts_of(name)))
        larger = [h for h in known.hypotheses.values() if h.names > names]
        children = [h for h in larger if len(h.names - names) == 1]
        known.remember(less, *(n for h in children for n in h.names - names))
        open_ones = [h for h in children if not h.final]
        known.finish([h for h in open_ones if known.scale.evidence(h) - base_evidence > near])
    known.admissible = frozenset(n for n, h in known.hypotheses.items() if known.is_admissible(h))
