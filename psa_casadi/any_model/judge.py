"""From what a search found in any model to a verdict, by the rules of a stack's diagnosis."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from psa_casadi.any_model.effects.attached import Attached, extended
from psa_casadi.any_model.free_functions import Free, correction_of, free_functions
from psa_casadi.any_model.result import (
    OdeBudget,
    OdeDiagnosis,
    OutputError,
    PortCause,
    removed_from,
)
from psa_casadi.component import Component
from psa_casadi.diagnosis.colour import noise_left, noise_told
from psa_casadi.diagnosis.held_out import Removed, Share
from psa_casadi.diagnosis.judgement import least_share, rivals, verdict_by
from psa_casadi.diagnosis.remedy import Size
from psa_casadi.diagnosis.result import Candidate, Remaining, Verdict, estimates
from psa_casadi.diagnosis.screening import probabilities, temperature
from psa_casadi.diagnosis.search.fits import with_cause, without
from psa_casadi.diagnosis.search.hypothesis import Hypothesis
from psa_casadi.diagnosis.search.known import Known, Names
from psa_casadi.diagnosis.task import LIMITS
from psa_casadi.errors import PsaError
from psa_casadi.identification.determinacy import determinacy
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.result import MISSED, with_told
from psa_casadi.model.compose import Model
from psa_casadi.notes import Note, note
from psa_casadi.records.record import FEWEST_SAMPLES
from psa_casadi.records.split import Experiment, missed_rms


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
    root: Hypothesis, errors: Sequence[float], noise: Sequence[float], together: float
) -> Weighed:
    """Weigh a model by the `errors` that it leaves of every output, with its share `together`.

    An output counts by itself where there are several, and the base's held-out rms is above
    `MISSED` times the noise:

        share_j = (P_base,j - P_j) / (P_base,j - s_j^2)
    """
    rows = list(zip(root.fit.channels, root.errors, errors, noise, strict=True))
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
    best: Hypothesis,
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
        theirs = weighed(known.root, f.errors, noise, f.share).named
        more = {n: theirs[n] - share for n, share in own.named.items()}
        where = max(more, key=lambda n: more[n])
        if more[where] > form and min(more.values()) >= -form:
            names, share = tuple(c.name for c in best.causes), own.named[where]
            why = note("free_beats", of=f.of, port=f.port.words, share=theirs[where])
            return note("own_withdrawn", names=names, share=share, output=where, why=why)
    return None


def left_out(known: Known, best: Hypothesis) -> tuple[Note, ...]:
    """Return which causes are clearly likelier than the best ones, and add too little to be told.

    Only where structure remains beside the best.
    """
    if not best.causes or not known.view(best).test.alarm:
        return ()
    clearly = LIMITS.clearly * temperature(known.scale.evidence(best))
    better = [
        h for h in known.found.values() if known.scale.score(h) > known.scale.score(best) + clearly
    ]
    better = [h for h in better if known.slight(h) and known.worth(h, form=False)]
    top = max(better, key=known.scale.score, default=None)
    if top is None:
        return ()
    names, small = (tuple(sorted(n)) for n in (top.names, known.slight(top)))
    more = known.scale.evidence(top) - known.scale.evidence(best)
    return (note("slight", names=names, more=more, small=small, least=LIMITS.further),)


def changes(effect: Component, fit: Fit, experiments: Sequence[Experiment]) -> tuple[Size, ...]:
    """Return by how much an effect changes each measured output within a record, at most.

    It is the range of the difference of two runs from the same start, with the effect and with its
    gain at 0; nothing where the latter cannot be simulated.
    """
    names = [o.channel.outputs[0] for o in fit.channels]
    columns = [fit.model.output_names.index(n) for n in names]
    without = fit.at({effect.gain or "": 0.0})
    try:
        pairs = zip(fit.outputs(experiments), without.outputs(experiments), strict=True)
        most = np.max([np.ptp(a - b, axis=0)[columns] for a, b in pairs], axis=0)
    except PsaError:
        return ()
    longest = max(e.record.duration for e in experiments)
    return tuple(
        Size("record", float(size), o.channel.unit, None, longest, "s", None, output=o.column)
        for size, o in zip(most, fit.channels, strict=True)
    )


def judged(known: Known, base: Model, table: Mapping[str, Attached]) -> OdeDiagnosis:
    """Return the diagnosis of what a search found; `table` are the effects with their ports."""
    root, best, experiments = known.root, known.answer, known.task.experiments
    first, last = known.view(root), known.view(best)
    floors = noise_left(best.fit, last.screening.colour)
    removed = removed_from(experiments, root.shown, floors)
    own = weighed(root, best.errors, floors, removed.from_base(best.shown))
    held = sum(int(e.held_out.sum()) for e in experiments)
    few = held < FEWEST_SAMPLES
    free = free_functions(known, first, base) if first.test.alarm or best.causes else ()
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
    rest = left, notes, free
    return _diagnosis(known, (base, table), verdict, named, removed, told, rest)


def _chances(known: Known, best: Hypothesis, cause: Component) -> dict[str, float]:
    """Return the probabilities of the effects that may be in a cause's place."""
    experiments = known.task.experiments
    less = known.found.get(best.names - {cause.name}) or without(best, cause, experiments)
    if less is None:
        return {cause.name: 1.0}
    view, own = known.view(less), known.scale.evidence(less)
    evidences = dict(view.estimated())

    def children() -> list[Hypothesis]:
        every = known.found.values()
        return [c for c in every if c.names > less.names and len(c.names - less.names) == 1]

    fitted = {c for h in children() for c in h.names - less.names}
    top = known.scale.evidence(best) - own
    near = top - LIMITS.clearly * temperature(top)
    for name in [n for n, e in evidences.items() if e > near and n not in fitted]:
        known.note(with_cause(less, experiments, view.starts_of(name)))
    known.finish([h for h in children() if not h.final and known.scale.evidence(h) - own > near])
    for child in children():
        (name,) = child.names - less.names
        allowed = child.names == best.names or known.worth(child)
        evidences[name] = known.scale.evidence(child) - own if allowed else -np.inf
    evidences[cause.name] = top
    return probabilities({n: e for n, e in evidences.items() if np.isfinite(e)})


def _diagnosis(
    known: Known,
    whole: tuple[Model, Mapping[str, Attached]],
    verdict: Verdict,
    named: Hypothesis,
    removed: Removed,
    told: Mapping[str, Mapping[str, float]],
    rest: tuple[Mapping[Names, Remaining], list[Note], Sequence[Free]],
) -> OdeDiagnosis:
    (base, table), (left, notes, free) = whole, rest
    root, experiments = known.root, known.task.experiments
    model = extended(base, [table[c.name] for c in named.causes])
    model = model.with_values(
        {n: v for n, v in named.fit.model.values.items() if n in model.values}
    )
    sure, given = determinacy(named.fit, experiments), [e.record for e in experiments]
    model = with_told(model, given, sure.names, sure.intervals, force_scale="given")
    told_noise, noise = _noise(known, named)
    partly = known.view(named).test.alarm
    shares = {}
    for c in named.causes:
        less = known.found.get(named.names - {c.name})
        shares[c.name] = Share(c.name, 0.0, (0.0, 0.0))
        if less is not None:
            shares[c.name] = removed.share(c.name, less.shown, named.shown)
    least = least_share([s.share for s in shares.values()])
    small = [n for n, s in shares.items() if partly and s.share < least]
    causes = tuple(
        PortCause(
            effect=c.name,
            port=table[c.name].port.words,
            belongs_to=c.belongs_to,
            description=c.description,
            confidence=float(min(0.99, told[c.name].get(c.name, 1.0))),
            parameters=estimates(c, model),
            cannot_be_told_from=rivals(told[c.name], c.name),
            explained_share=shares[c.name].shown[0],
            remedy=c.what_now.code,
            sizes=changes(c, named.fit, experiments),
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
                o.column,
                o.channel.unit,
                level,
                *(missed_rms(experiments, h.shown, o.number) for h in (root, named)),
            )
            for o, level in zip(named.fit.channels, noise, strict=True)
        ),
        remaining=left[named.names],
        remarks=(*notes, *(note("small", effect=n, share=shares[n].shown[0]) for n in small)),
        model=model,
        base_fit=root.fit,
        extended_fit=named.fit,
        experiments=told_noise,
        base=tuple(root.fit.outputs(experiments)),
        extended=tuple(named.fit.outputs(experiments)),
        missed=left[root.names],
        budget=OdeBudget(
            removed.share("together", root.shown, named.shown),
            tuple(shares[c.effect] for c in causes),
            best_free.removes if best_free else None,
        ),
        free_function=note("free_function", of=best_free.of, port=best_free.port.words,
                           share=best_free.share) if best_free else None,
        correction=correction_of(best_free, experiments) if best_free else None,
    )  # fmt: skip


def _candidates(
    known: Known,
    removed: Removed,
    told: Mapping[str, Mapping[str, float]],
    named: Hypothesis,
) -> tuple[Candidate, ...]:
    """Return every effect alone beside the base; its evidence is estimated where not fitted."""
    root = known.root
    rows = []
    first = next(iter(told.values()), {}) if named.causes else {}
    for name, estimate in known.view(root).estimated().items():
        own, share, evidence = known.found.get(frozenset({name})), 0.0, estimate
        if own is not None:
            share = float(np.clip(removed.from_base(own.shown), 0.0, 1.0))
            evidence = known.scale.evidence(own)
        rows.append(Candidate(name, share, evidence, own is not None, first.get(name, 0.0)))
    return tuple(sorted(rows, key=lambda c: (-c.fitted, -c.evidence)))


def _noise(known: Known, h: Hypothesis) -> tuple[tuple[Experiment, ...], tuple[float, ...]]:
    return noise_told(h.fit, known.view(h).screening.colour, known.task.experiments)


def _remaining(known: Known, h: Hypothesis) -> Remaining:
    """Return what a model leaves: of fitted samples by its test, of held-out ones by their size."""
    test, experiments = known.view(h).test, known.task.experiments
    if test.alarm:
        return Remaining(False, test.p_value, test.finding)
    for o, noise in zip(h.fit.channels, _noise(known, h)[1], strict=True):
        held = any(e.at(o.number, e.held_out).any() for e in experiments)
        rms = missed_rms(experiments, h.shown, o.number)
        least = LIMITS.unseen_ratio_of_records * float(np.hypot(noise, o.straight))
        if held and rms > least:
            unlike = note("held_out_unlike", output=o.column, ratio=rms / noise)
            return Remaining(False, test.p_value, unlike)
    return Remaining(True, test.p_value)
