"""Causes against the unnamed corrections: all beside the base, each beside the model without it."""

from collections.abc import Sequence
from dataclasses import dataclass

from psa_casadi.diagnosis.corrections import Correction, corrections
from psa_casadi.diagnosis.held_out import removed_from
from psa_casadi.diagnosis.judgement import Weighed
from psa_casadi.diagnosis.search.hypothesis import Hypothesis, Scale
from psa_casadi.diagnosis.search.steps import Step
from psa_casadi.records.split import Experiment


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
        found = (
            corrections(before.fit, self.experiments, self.scale.colour, after.predicted)
            if beside
            else ()
        )
        removed = removed_from(self.experiments, before.predicted, self.noise)
        whole = self.scale.evidence(after)
        return Weighed(
            evidence=whole - self.scale.evidence(before),
            causes=len(after.causes) - len(before.causes),
            share=removed.from_base(after.predicted),
            corrections=found,
            shares=[removed.from_base(c.predicted) for c in found],
            whole=whole,
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
