"""What the design of an experiment gives: the record to play and what it promises."""

from collections.abc import Mapping
from dataclasses import dataclass

from psa_casadi.design.experiment.criteria import Optimality
from psa_casadi.design.experiment.limits import Limits
from psa_casadi.records.record import Record

#: How often a record may be played until it tells, and the probability that is asked for.
PLAYS, ASKED = (1, 2, 3, 5), 0.9


@dataclass(frozen=True)
class Pair:
    """How surely a record would tell: growth of ln of the Bayes factor if `truth` is the cause.

    `designed` for the designed record, `usual` for a sine and a triangle of the same length and
    amplitude.
    """

    truth: str
    other: str
    designed: float
    usual: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Separated:
    """A record that tells effects apart.

    `record` is the voltage to play (no displacement), of the family `kind` ("sine" or "triangle"
    where no designed one was better); `chance` is for each
    effect the probability that a diagnosis of the data at hand with the record names it alone if it
    is the cause, as the rivals' fits predict it; `usual_chance` the same with sine and triangle.
    `plays` is how often the record must be played, each time from rest, until every chance is at
    least 90 %; None where `PLAYS[-1]` times are not enough.
    """

    record: Record
    kind: str
    limits: Limits
    pairs: tuple[Pair, ...]
    chance: Mapping[str, float]
    usual_chance: Mapping[str, Mapping[str, float]]
    plays: int | None
    evaluations: int
    seconds: float

    @property
    def names(self) -> tuple[str, ...]:
        """The effects to tell apart."""
        return tuple(self.chance)

    def factor(self, usual: str) -> float:
        """Return the least ln of the Bayes factor over that with a usual voltage."""
        least = min(p.designed for p in self.pairs)
        return least / max(min(p.usual[usual] for p in self.pairs), 1e-12)


@dataclass(frozen=True, eq=False)
class Informative:
    """A record that sharpens parameters.

    `intervals` are the predicted 95 % intervals with it (and the data at hand), `before` those
    without, each in the parameter's unit; `factor` says by how much the mean standard error of the
    criterion is smaller than with a usual voltage of the same length and amplitude.
    """

    record: Record
    kind: str
    limits: Limits
    optimality: Optimality
    intervals: Mapping[str, tuple[float, float]]
    before: Mapping[str, tuple[float, float]]
    factor: Mapping[str, float]
    evaluations: int
    seconds: float
