"""What data say of a cause first: its family, the place where it sits and what it does.

Which effect of a family it is comes second, and it may be none that is listed: unnamed corrections
of other kinds compete with the listed effects on the scale of evidence.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from psa_casadi.diagnosis.corrections import Correction, Patch
from psa_casadi.diagnosis.task import Thresholds
from psa_casadi.model.component import Kind

#: What a correction of a kind does, where it has another name, and the places of its ports.
_DOES: dict[str, Kind] = {
    "curve": "curve", "direction": "hysteresis", "memory": "hysteresis", "relaxation": "relaxation",
    "modes": "resonance", "time": "time", "gain in time": "changing gain",
}  # fmt: skip
_PLACES = {"drive voltage": "drive", "force": "plant", "reading": "sensor"}
#: The largest probability that is stated.
SUREST = 0.99
#: Families less probable than this are not reported.
_LEAST = 0.01


@dataclass(frozen=True)
class Family:
    """A place (plant, drive, sensor, environment, or a port of any model) and a kind.

    `probability` is that the cause belongs to it; `effects` are those of the listed effects in it,
    `not_listed` that it is none of them.
    """

    place: str
    kind: str
    probability: float
    effects: Mapping[str, float]
    not_listed: float


def place_and_kind(c: Correction) -> tuple[str, str]:
    """Return the family of an unnamed correction; a free function is a curve at its port."""
    if isinstance(c, Patch):
        return _PLACES[c.port], _DOES[c.kind]
    return c.port, "curve"


@dataclass(frozen=True)
class CauseEvidence:
    """What a cause has: its evidence E [nats], from n samples, with k causes in all."""

    evidence: float
    samples: int
    causes: int = 1

    def listed_probability(self, limits: Thresholds) -> float:
        """Return the probability that it is of any kind that was tried.

        The odds of what looks like it, but nobody has thought of or is the form of another cause,
        are `unknown` k (n/E)^(1/2). The smaller it is over the noise, the less of its form shows.
        """
        small = float(np.sqrt(self.samples / max(self.evidence, 1e-300)))
        return 1.0 / (1.0 + limits.unknown * self.causes * small)


def families(
    probability: Mapping[str, float],
    places: Mapping[str, tuple[str, str]],
    shown: CauseEvidence,
    corrections: Sequence[Correction],
    limits: Thresholds,
) -> tuple[Family, ...]:
    """Return the families that a cause may belong to, the most probable first.

    `probability` is that of each effect on condition that the cause is a listed one, `places` has
    their families; `shown` is the evidence of the cause over the model without it, `corrections`
    are those of that model. With the evidence F_k, above the price of a cause, of each correction
    and that E of the cause, the odds that it is not listed are

        sum_k exp((F_k - E*) / T),   T = max(temperature 2, further E)

    over corrections whose kind no likely effect has; E* is E, or F of one of its kind if larger.
    One of its kind has more freedom: it counts where `enough` of its F is more than E.
    Without any effect the corrections share all, with `form_of_unnamed` in that place: a model that
    lacks the cause holds little information on it. One whose kind nobody has declared may be of
    any. What is missing to 1 is of no kind that was tried (`CauseEvidence.listed_probability`).
    """
    evidence = shown.evidence
    form = limits.further if probability else limits.form_of_unnamed
    scale = max(limits.temperature, form * evidence)
    kinds = {places[n][1] for n, p in probability.items() if n in places and p > _LEAST}
    apart = [(place_and_kind(c), c.evidence) for c in corrections if c.evidence > limits.price]
    most = max([evidence, *(e for family, e in apart if family[1] in kinds)])
    others: dict[tuple[str, str], float] = {}
    for family, each in apart:
        if "" not in kinds:
            ahead = limits.enough * each - evidence if family[1] in kinds else each - most
            odds = float(np.exp(min(ahead / scale, 50.0)))
            others[family] = max(others.get(family, 0.0), odds)
    odds_of_all = bool(probability) + sum(others.values())
    listed = shown.listed_probability(limits) / odds_of_all if odds_of_all else 0.0
    table: dict[tuple[str, str], dict[str, float]] = {family: {} for family in others}
    for name, p in probability.items():
        if name in places:
            table.setdefault(places[name], {})[name] = p * listed
    rows = (
        Family(
            *family,
            probability=min(SUREST, sum(effects.values()) + others.get(family, 0.0) * listed),
            effects={n: p for n, p in effects.items() if p > _LEAST},
            not_listed=others.get(family, 0.0) * listed,
        )
        for family, effects in table.items()
    )
    probable = (f for f in rows if f.probability > _LEAST)
    return tuple(sorted(probable, key=lambda f: -f.probability))
