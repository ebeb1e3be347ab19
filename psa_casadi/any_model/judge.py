"""From what a search found in any model to a verdict, by the rules of a stack's diagnosis."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from psa_casadi.any_model.fit import OdeFit, certainty
from psa_casadi.any_model.free_functions import Free, correction_of, free_functions
from psa_casadi.any_model.hypothesis import OdeHypothesis
from psa_casadi.any_model.identify import MISSED, noise_left, noise_told, with_told
from psa_casadi.any_model.result import (
    OdeBudget,
    OdeDiagnosis,
    OutputError,
    PortCause,
    removed_from,
)
from psa_casadi.any_model.runs import Run, missed_rms
from psa_casadi.any_model.search import Known, Names, with_cause, without
from psa_casadi.component import Component
from psa_casadi.diagnosis.held_out import Removed, Share
from psa_casadi.diagnosis.judgement import least_share, rivals, verdict_by
from psa_casadi.diagnosis.remedy import Size
from psa_casadi.diagnosis.result import Candidate, Remaining, Verdict, estimates
from psa_casadi.diagnosis.screening import probabilities, temperature
from psa_casadi.diagnosis.task import LIMITS
from psa_casadi.errors import PsaError
from psa_casadi.notes import Note, note
from psa_casadi.records.record import FEWEST_SAMPLES


@dataclass(frozen=True)
class Weighed:
    """What causes, or a free function, remove of the base's held-out error above the noise.

    `together` of all outputs, each over its noise; `each` of those that the base clearly misses.
    """

    together: float
    each: Mapping[str, float]

    @property
    def least(self) -> tuple[str, float]:
        """The output of which the least is removed, "" for all together, and that share."""
        return min(self.named.items(), key=lambda item: item[1])

    @property
    def enough(self) -> bool:
        """Whether so much of every output is removed that names may stand where more is left."""
        return self.least[1] >= LIMITS.enough

    @property
    def named(self) -> dict[str, float]:
        """Every share by the name of its output, "" for all together."""
        return {"": self.together, **self.each}


def weighed(
    root: OdeHypothesis, errors: Sequence[float], noise: Sequence[float], together: float
) -> Weighed:
    """Weigh a model by the `errors` that it leaves of every output, with its share `together`.

    An output counts by itself where there are several, and the base's held-out rms is above
    `MISSED` times the noise:

        share_j = (P_base,j - P_j) / (P_base,j - s_j^2)
    """
    rows = list(zip(root.fit.outputs, root.errors, errors, noise, strict=True))
    if len(rows) == 1:
        return Weighed(together, {})
    each = {
        o.column: (base**2 - left**2) / (base**2 - floor**2)
        for o, base, left, floor in rows
        if base > MISSED * floor
    }
    return Weighed(together, each)


def beaten_by(
    known: Known,
    best: OdeHypothesis,
    own: Weighed,
    free: Sequence[Free],
    noise: Sequence[float],
) -> Note | None:
    """Return which free function takes the names away, None if none does.

    It is clearly likelier, removes more of some output by more than a form may cost, and of none so
    much less.
    """
    evidence, form = known.scale.evidence(best), LIMITS.form
    for f in free:
        clearly = LIMITS.clearly * temperature(max(evidence, f.evidence))
        if f.evidence - LIMITS.price <= known.scale.of_fitted(best) + clearly:
            continue
        theirs = weighed(known.found[frozenset()], f.errors, noise, f.share).named
        more = {n: theirs[n] - share for n, share in own.named.items()}
        where = max(more, key=lambda n: more[n])
        if more[where] > form and min(more.values()) >= -form:
            names, share = tuple(c.name for c in best.causes), own.named[where]
            why = note("free_beats", of=f.of, port=f.port.words, share=theirs[where])
            return note("own_withdrawn", names=names, share=share, output=where, why=why)
    return None


def left_out(known: Known, best: OdeHypothesis) -> tuple[Note, ...]:
    """Return which causes are clearly likelier than the best ones, and add too little to be told.

    Only where structure remains beside the best.
    """
    if not best.causes or not known.view(best).test.alarm:
        return ()
    clearly = LIMITS.clearly * temperature(known.scale.evidence(best))
    better = [
        h for h in known.found.values() if known.scale.score(h) > known.scale.score(best) + clearly
    ]
    better = [h for h in better if known.slight(h) and known.stands(h)]
    top = max(better, key=known.scale.score, default=None)
    if top is None:
        return ()
    names, small = (tuple(sorted(n)) for n in (top.names, known.slight(top)))
    more = known.scale.evidence(top) - known.scale.evidence(best)
    return (note("slight", names=names, more=more, small=small, least=LIMITS.further),)


def changes(effect: Component, fit: OdeFit, runs: Sequence[Run]) -> tuple[Size, ...]:
    """Return by how much an effect changes each measured output within a record, at most.

    It is the range of the difference of two runs from the same start, with the effect and with its
    gain at 0; nothing where the latter cannot be simulated.
    """
    without = replace(fit, model=fit.model.with_values({effect.gain or "": 0.0}))
    try:
        moved = [
            np.ptp(a - b, axis=0)
            for a, b in zip(fit.predicted(runs), without.predicted(runs), strict=True)
        ]
    except PsaError:
        return ()
    most, longest = np.max(moved, axis=0), max(float(np.ptp(r.time)) for r in runs)
    outputs = fit.model.structure.outputs
    return tuple(
        Size("record", float(most[k]), outputs[k].unit, None, longest, "s", None, output=o.column)
        for k, o in zip(fit.places, fit.outputs, strict=True)
    )


def judged(known: Known) -> OdeDiagnosis:
    """Return the diagnosis of what a search found."""
    root, best = known.found[frozenset()], known.best()
    first, last = known.view(root), known.view(best)
    floors = noise_left(best.fit, last.screening.colour)
    removed = removed_from(known.runs, root.fit.places, root.predicted, floors)
    own = weighed(root, best.errors, floors, removed.from_base(best.predicted))
    held = sum(int(r.held_out.sum()) for r in known.runs)
    few = held < FEWEST_SAMPLES
    free = free_functions(known, first) if first.test.alarm or best.causes else ()
    beaten = beaten_by(known, best, own, free, floors) if best.causes else None
    told = {c.name: _chances(known, best, c) for c in best.causes}
    left = {h.names: _remaining(known, h) for h in (root, best)}
    more = not left[best.names].white
    verdict = verdict_by(
        missing=not left[root.names].white or bool(best.causes),
        withdrawn=bool(beaten) or few or not best.causes or (last.test.alarm and not own.enough),
        ambiguous=any(rivals(told[c.name], c.name) for c in best.causes[:1]),
        more=more,
    )
    named = best if verdict in ("cause_named", "partly_explained", "ambiguous") else root
    notes = [note("own_few_held_out", count=held, least=FEWEST_SAMPLES)] if few else []
    if verdict == "unexplained" and best.causes and not few:
        output, share = own.least
        why, names = (
            note("own_little", least=LIMITS.enough),
            tuple(c.name for c in best.causes),
        )
        little = note("own_withdrawn", names=names, share=share, output=output, why=why)
        notes.append(beaten or little)
    if not few:
        notes += left_out(known, best)
    return _diagnosis(known, verdict, named, removed, told, left, notes, free)


def _chances(known: Known, best: OdeHypothesis, cause: Component) -> dict[str, float]:
    """Return the probabilities of the effects that may be in a cause's place."""
    less = known.found.get(best.names - {cause.name}) or without(known, best, cause)
    if less is None:
        return {cause.name: 1.0}
    view, own = known.view(less), known.scale.evidence(less)
    evidences = dict(view.estimated())
    fitted = {c for h in known.children(less) for c in h.names - less.names}
    top = known.scale.evidence(best) - own
    near = top - LIMITS.clearly * temperature(top)
    for name in [n for n, e in evidences.items() if e > near and n not in fitted]:
        known.note(with_cause(known, less, view.starts_of(name)))
    known.finish(
        [h for h in known.children(less) if not h.final and known.scale.evidence(h) - own > near]
    )
    for child in known.children(less):
        (name,) = child.names - less.names
        allowed = child.names == best.names or known.worth(child)
        evidences[name] = known.scale.evidence(child) - own if allowed else -np.inf
    evidences[cause.name] = top
    return probabilities({n: e for n, e in evidences.items() if np.isfinite(e)})


def _diagnosis(
    known: Known,
    verdict: Verdict,
    named: OdeHypothesis,
    removed: Removed,
    told: Mapping[str, Mapping[str, float]],
    left: Mapping[Names, Remaining],
    notes: list[Note],
    free: Sequence[Free],
) -> OdeDiagnosis:
    root = known.found[frozenset()]
    model = with_told(named.fit.model, known.runs, certainty(named.fit))
    runs, noise = _noise(known, named)
    partly = known.view(named).test.alarm
    shares = {}
    for c in named.causes:
        less = known.found.get(named.names - {c.name})
        shares[c.name] = Share(c.name, 0.0, (0.0, 0.0))
        if less is not None:
            shares[c.name] = removed.share(c.name, less.predicted, named.predicted)
    least = least_share([s.share for s in shares.values()])
    small = [n for n, s in shares.items() if partly and s.share < least]
    causes = tuple(
        PortCause(
            effect=c.name,
            port=known.table.attached(c).port.words,
            belongs_to=c.belongs_to,
            description=c.description,
            confidence=float(min(0.99, told[c.name].get(c.name, 1.0))),
            parameters=estimates(c, model),
            cannot_be_told_from=rivals(told[c.name], c.name),
            explained_share=shares[c.name].shown[0],
            remedy=c.what_now.code,
            sizes=changes(c, named.fit, known.runs),
        )
        for c in named.causes
        if c.name not in small
    )  # fmt: skip
    best_free = max(free, key=lambda f: f.share, default=None)
    if verdict != "unexplained" or (best_free and best_free.share <= LIMITS.form):
        best_free = None
    return OdeDiagnosis(
        verdict=verdict,
        causes=causes,
        candidates=_candidates(known, removed, told, named),
        errors=tuple(
            OutputError(
                o.column, known.base.model.structure.outputs[o.index].unit,
                level,
                *(missed_rms(known.runs, h.predicted, o.index) for h in (root, named)),
            )
            for o, level in zip(named.fit.outputs, noise, strict=True)
        ),
        remaining=left[named.names],
        remarks=(*notes, *(note("small", effect=n, share=shares[n].shown[0]) for n in small)),
        model=model,
        base_fit=root.fit,
        extended_fit=named.fit,
        runs=runs,
        base=root.predicted,
        extended=named.predicted,
        missed=left[root.names],
        budget=OdeBudget(
            removed.share("together", root.predicted, named.predicted),
            tuple(shares[c.effect] for c in causes),
            best_free.removes if best_free else None,
        ),
        free_function=note("free_function", of=best_free.of, port=best_free.port.words,
                           share=best_free.share) if best_free else None,
        correction=correction_of(best_free, known.runs) if best_free else None,
    )  # fmt: skip


def _candidates(
    known: Known,
    removed: Removed,
    told: Mapping[str, Mapping[str, float]],
    named: OdeHypothesis,
) -> tuple[Candidate, ...]:
    """Return every effect alone beside the base; its evidence is estimated where not fitted."""
    root = known.found[frozenset()]
    rows = []
    first = next(iter(told.values()), {}) if named.causes else {}
    for name, estimate in known.view(root).estimated().items():
        own, share, evidence = known.found.get(frozenset({name})), 0.0, estimate
        if own is not None:
            share = float(np.clip(removed.from_base(own.predicted), 0.0, 1.0))
            evidence = known.scale.evidence(own)
        rows.append(Candidate(name, share, evidence, own is not None, first.get(name, 0.0)))
    return tuple(sorted(rows, key=lambda c: (-c.fitted, -c.evidence)))


def _noise(known: Known, h: OdeHypothesis) -> tuple[tuple[Run, ...], tuple[float, ...]]:
    return noise_told(h.fit, known.view(h).screening.colour, known.runs)


def _remaining(known: Known, h: OdeHypothesis) -> Remaining:
    """Return what a model leaves: of fitted samples by its test, of held-out ones by their size."""
    test = known.view(h).test
    if test.alarm:
        return Remaining(False, test.p_value, test.finding)
    for o, noise in zip(h.fit.outputs, _noise(known, h)[1], strict=True):
        held = any(r.judged(o.index).any() for r in known.runs)
        rms = missed_rms(known.runs, h.predicted, o.index)
        least = LIMITS.unseen_ratio_of_records * float(np.hypot(noise, o.straight))
        if held and rms > least:
            unlike = note("held_out_unlike", output=o.column, ratio=rms / noise)
            return Remaining(False, test.p_value, unlike)
    return Remaining(True, test.p_value)
