"""From what a search found to a verdict: do the names stand, and how much do they explain?"""

from collections.abc import Sequence
from dataclasses import dataclass

from psa_casadi.diagnosis.corrections.correct import Correction
from psa_casadi.diagnosis.result import Verdict
from psa_casadi.diagnosis.screening.evidence import credible_set, temperature
from psa_casadi.diagnosis.search.steps import Step
from psa_casadi.diagnosis.thresholds import thresholds


@dataclass(frozen=True)
class Weighed:
    """Named causes against the unnamed corrections beside the base.

    `evidence` of the causes together over the base; `share` that they remove of the base's excess;
    `shares` those that the `corrections` would.
    """

    evidence: float
    causes: int
    share: float
    corrections: Sequence[Correction]
    shares: Sequence[float]

    def beaten_by(self) -> Correction | None:
        """Return the unnamed correction that takes the names away, if there is one.

        It has clearly more evidence, a price paid for it too, and removes more of the held-out
        excess than they do, by more than what their form may cost. One that can add what they add,
        of all corrections best or but for their form, takes nothing while they do as much: it only
        has more freedom.
        """
        own = self.evidence - thresholds().price * self.causes
        best = max((c.copies for c in self.corrections), default=0.0)
        alike = min(best, 1.0 - thresholds().form)
        for c, share in zip(self.corrections, self.shares, strict=True):
            clearly = thresholds().clearly * temperature(max(self.evidence, c.evidence))
            enough = share - thresholds().form
            if c.copies >= alike:
                enough = thresholds().as_much * share
            removes_more = share > 0.0 and self.share < enough
            if removes_more and c.evidence - thresholds().price > own + clearly:
                return c
        return None


def verdict_of(
    steps: Sequence[Step],
    *,
    missing: bool,
    beaten: bool,
    share: float,
) -> Verdict:
    """Return the verdict on what a search found; the last step is the model with all causes.

    `missing` says that the base leaves something, `beaten` that an unnamed correction takes the
    names away, `share` of the held-out excess the causes remove.
    """
    if not missing:
        return "adequate"
    if len(steps) == 1 or beaten:
        return "unexplained"
    partly = steps[-1].test.alarm
    if partly and share < thresholds().partly:
        return "unexplained"
    if told_from(steps[0]):
        return "ambiguous"
    return "partly_explained" if partly else "cause_named"


def told_from(step: Step) -> tuple[str, ...]:
    """Effects that may as well be a step's cause: with the chosen one, the credible set."""
    if step.chosen is None:
        return ()
    within = credible_set(step.probability, thresholds().credible)
    return tuple(name for name in within if name != step.cause.name)
