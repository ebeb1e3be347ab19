"""Effects that the records could not have shown, even at an ordinary size."""

from collections.abc import Sequence

import numpy as np

from psa_casadi.component import Component
from psa_casadi.diagnosis.judgement import told_from
from psa_casadi.diagnosis.result import BlindSpot
from psa_casadi.diagnosis.search.steps import Step
from psa_casadi.diagnosis.task import thresholds
from psa_casadi.notes import note


def shown(steps: Sequence[Step]) -> set[str]:
    """Return the effects that the records do show: fitted with evidence, or as likely as a cause.

    Where they stand beside a cause, or are rivals of it, no smallest size of theirs is told.
    """
    price = thresholds().price
    fitted = {n for s in steps for n in s.fitted if s.evidence.get(n, -np.inf) > price}
    return fitted.union(*(told_from(s) for s in steps))


def blind_spots(final: Step, table: Sequence[Component]) -> tuple[BlindSpot, ...]:
    """Return effects whose smallest gain that shows on these records is more than ordinary."""
    spots = []
    present = {c.name for c in final.fit.model.components}
    for effect in table:
        if effect.name in present:
            continue
        scores = [s for s in final.screening.scores if s.direction.effect is effect]
        gain = next(p for p in effect.parameters if p.name == effect.gain)
        extended = final.fit.model.with_effect(effect, {gain.name: 0.0})
        practical = gain.typical(extended.values)
        factor = np.sqrt(final.screening.threshold)
        smallest = min((factor * s.detectable_gain for s in scores), default=np.inf)
        if smallest > practical:
            why = note(
                "blind_spot" if np.isfinite(smallest) else "blind",
                effect=effect.name, gain=gain.name,
                smallest=(smallest, gain.unit), ordinary=(practical, gain.unit),
            )  # fmt: skip
            spots.append(BlindSpot(effect.name, float(min(smallest, 1e300)), gain.unit, why))
    return tuple(spots)
