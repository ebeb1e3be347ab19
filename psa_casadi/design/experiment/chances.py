"""With what probability a record has the cause named, and how often it must be played for that."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import scipy

from psa_casadi.design.experiment.criteria import LEAST, Rival, Separation
from psa_casadi.design.experiment.designs import ASKED, PLAYS
from psa_casadi.diagnosis.screening.evidence import temperature
from psa_casadi.diagnosis.thresholds import thresholds
from psa_casadi.errors import PsaError
from psa_casadi.records.record import Record

#: Chance to be named from which on no better voltage is looked for, at distances this many times
#: smaller: rivals are not the true equations.
_CERTAIN, _MARGIN = 0.999, 10.0


def naming_probability(
    truth: Rival, others: Sequence[Rival], distances: Mapping[tuple[str, str], float], over: float
) -> float:
    """Return the probability that a diagnosis names `truth` if it is the cause.

    Against each other rival ln B is normal with mean (what the data at hand say) + T/2 and
    variance T; to be named alone it must exceed temperature * ln(c/(1 - c)), c = 0.95, where the
    temperature grows with the evidence over the base, of which the new record adds `over`/2.
    """
    credible = thresholds().credible
    needed = temperature(truth.evidence + 0.5 * over) * float(np.log(credible / (1.0 - credible)))
    chances = []
    for other in others:
        t = distances[truth.name, other.name]
        gained = truth.evidence - other.evidence + 0.5 * t - needed
        chances.append(float(scipy.special.ndtr(gained / np.sqrt(max(t, LEAST)))))
    return min(chances, default=1.0)


def tells(criterion: Separation, base: Rival | None, record: Record) -> bool:
    """Whether a record names every rival for sure, even with a fraction of its distances."""
    try:
        less = {pair: t / _MARGIN for pair, t in criterion.distances(record).items()}
        return min(chances_of(criterion, less, base, record).values()) > _CERTAIN
    except PsaError:  # a base that cannot follow: another voltage may be better
        return False


def plays_of(
    criterion: Separation, base: Rival | None, record: Record, chance: Mapping[str, float]
) -> int | None:
    """Return how often a record must be played until it tells; None if `PLAYS[-1]` do not.

    k records of the same voltage are one whose noise has 1/k of the variance.
    """
    for plays in PLAYS:
        if plays > 1:
            colour = replace(criterion.noise, level=criterion.noise.level / np.sqrt(plays))
            often = replace(criterion, noise=colour)
            chance = chances_of(often, often.distances(record), base, record)
        if min(chance.values()) >= ASKED:
            return plays
    return None


def chances_of(
    criterion: Separation,
    distances: Mapping[tuple[str, str], float],
    base: Rival | None,
    record: Record,
) -> dict[str, float]:
    """Return the probability of every rival that it is named if it is the cause.

    `distances` are those of the record; `base` is the model without any of the rivals.
    """
    chances = {}
    for truth in criterion.rivals:
        others = [r for r in criterion.rivals if r is not truth]
        over = 0.0 if base is None else criterion.distance(truth, base, record)
        chances[truth.name] = naming_probability(truth, others, distances, over)
    return chances
