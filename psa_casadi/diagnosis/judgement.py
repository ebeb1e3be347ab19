"""From what a search found to a verdict: do the names stand, and how much do they explain?"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from psa_casadi.diagnosis.corrections import Correction, corrections
from psa_casadi.diagnosis.held_out import Share, removed_from
from psa_casadi.diagnosis.result import Verdict
from psa_casadi.diagnosis.screening import credible_set
from psa_casadi.diagnosis.search.hypothesis import Hypothesis, Scale
from psa_casadi.diagnosis.search.steps import Step
from psa_casadi.diagnosis.task import LIMITS, Thresholds
from psa_casadi.notes import Note, note
from psa_casadi.records.split import Experiment


@dataclass(frozen=True)
class Weighed:
    """Causes against the unnamed corrections beside the model without them.

    `evidence` of the causes together over that model; `share` that they remove of its held-out
    excess; `shares` those that the `corrections` would.
    """

    evidence: float
    causes: int
    share: float
    corrections: Sequence[Correction]
    shares: Sequence[float]
    limits: Thresholds

    @property
    def adds(self) -> bool:
        """Do the causes remove more than their form may be wrong by, named or not?"""
        return self.share > self.limits.form

    def beaten_by(self) -> Correction | None:
        """Return the unnamed correction that takes the names away, if there is one.

        It has more evidence, a price paid for it too, and they remove less than `enough` of what it
        removes of the held-out excess: it has more freedom.
        """
        limits = self.limits
        own = self.evidence - limits.price * self.causes
        for c, share in zip(self.corrections, self.shares, strict=True):
            if self.share < limits.enough * max(share, 0.0) and c.evidence - limits.price > own:
                return c
        return None


def verdict_by(*, missing: bool, withdrawn: bool, ambiguous: bool, more: bool) -> Verdict:
    """Return the verdict: is something `missing`, do no names stand, are there rivals, more left?

    The first of these that is so decides.
    """
    if not missing:
        return "adequate"
    if withdrawn:
        return "unexplained"
    if ambiguous:
        return "ambiguous"
    return "partly_explained" if more else "cause_named"


def told_from(step: Step, limits: Thresholds) -> tuple[str, ...]:
    """Effects that may as well be a step's cause: with the chosen one, the credible set."""
    return () if step.chosen is None else rivals(step.probability, step.cause.name, limits)


def rivals(
    probability: Mapping[str, float], cause: str, limits: Thresholds = LIMITS
) -> tuple[str, ...]:
    """Return the other effects of the credible set that holds a cause."""
    within = credible_set(probability, limits.credible)
    return tuple(name for name in within if name != cause)


def too_small(causes: Sequence[Share], limits: Thresholds) -> tuple[Share, ...]:
    """Return causes that are not named where structure remains: the form of the others is wrong.

    Each removes less of the base's excess than a form may miss, and less than `enough` of what the
    largest does: that one is always named.
    """
    least = least_share([c.share for c in causes], limits)
    return tuple(c for c in causes if c.share < least)


def least_share(shares: Collection[float], limits: Thresholds = LIMITS) -> float:
    """Return the share of the base's excess from which on a cause is named beside others."""
    most = max(shares, default=0.0)
    return min(limits.form, limits.enough * most if most > 0.0 else most)


def withdrawn_names(
    steps: Sequence[Step],
    weighed: Weighed,
    beaten: Correction | None,
    vague: Mapping[str, Correction],
    doubt: Note | None,
) -> tuple[Note, ...]:
    """Return which names were found but not told, and why: `doubt` is that of held-out samples.

    An unnamed correction has `beaten` all of them, or some have beaten each of them (`vague`).
    """
    names = tuple(s.cause.name for s in steps if s.chosen is not None)
    if not names:
        return ()
    kept = False
    if doubt is not None:
        why = doubt
    elif beaten is not None:
        share = weighed.shares[list(weighed.corrections).index(beaten)]
        why = note("beaten", by=beaten.kind.name, port=beaten.kind.port,
                   evidence=beaten.evidence, share=share)  # fmt: skip
    elif vague:
        why = _each(vague)
    else:
        why, kept = note("little", least=weighed.limits.enough), weighed.adds
    return (
        note("withdrawn", names=names, evidence=weighed.evidence, share=max(0.0, weighed.share),
             kept=kept, why=why),
    )  # fmt: skip


def vague_note(vague: Mapping[str, Correction]) -> tuple[Note, ...]:
    """Return which causes stay in the model without a name, as corrections describe them better."""
    return (note("vague", names=tuple(vague), why=_each(vague)),) if vague else ()


def _each(vague: Mapping[str, Correction]) -> Note:
    each = tuple((c.kind.name, c.kind.port, n) for n, c in vague.items())
    return note("better_unnamed", each=each)


@dataclass(frozen=True, eq=False)
class Balance:
    """What hypotheses of one search are weighed with: records, score, rms of the noise [m]."""

    experiments: Sequence[Experiment]
    scale: Scale
    noise: float

    def weigh(self, before: Hypothesis, after: Hypothesis, *, beside: bool = True) -> Weighed:
        """Weigh the causes that one hypothesis has more than another against corrections of that.

        Without any corrections where it is not `beside` them.
        """
        found = corrections(before.fit, self.experiments, self.scale.colour) if beside else ()
        removed = removed_from(self.experiments, before.predicted, self.noise)
        return Weighed(
            evidence=self.scale.evidence(after) - self.scale.evidence(before),
            causes=len(after.causes) - len(before.causes),
            share=removed.from_base(after.predicted),
            corrections=found,
            shares=[removed.from_base(c.predicted) for c in found],
            limits=self.scale.limits,
        )

    def vague(self, steps: Sequence[Step]) -> dict[str, Correction]:
        """Return those of several causes that an unnamed correction describes better, by name.

        Each is weighed beside the model without it, all others kept.
        """
        if len(steps) < 3:
            return {}
        last, found = steps[-1].view.of, {}
        for s in steps:
            if s.chosen is not None and s.without is not None:
                better = self.weigh(s.without, last).beaten_by()
                if better is not None:
                    found[s.cause.name] = better
        return found
