"""What a search for causes works on, and by which method."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

from psa_casadi.component import Component
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.records.split import Experiment

#: Sampling interval [s] below which a stack may ring within the record's band.
FAST = 7e-4
_MASSES = ("m_P", "m_B", "m")


@dataclass(frozen=True)
class Method:
    """The parts of the method that a diagnosis can go without, to show what each is good for.

    `whiten_from`: the noise's colour is that of what neither the base nor any candidate explains
    ("remainder"), or an autoregression of the residual itself. `finite_steps`: effects whose
    derivative vanishes at their null are screened by a step. `imitators`: effects that could look
    like the best one are fitted too. `weights`: probabilities come from the evidence, tempered as
    measured, or from the Bayesian information criterion.
    """

    whiten_from: Literal["remainder", "residual"] = "remainder"
    finite_steps: bool = True
    imitators: bool = True
    weights: Literal["evidence", "bic"] = "evidence"


@dataclass(frozen=True)
class Task:
    """The records, the table of effects to search, the method, and who is told of the progress."""

    experiments: tuple[Experiment, ...]
    table: tuple[Component, ...]
    method: Method = field(default_factory=Method)
    progress: Callable[[str], None] = lambda _: None

    @property
    def fast(self) -> bool:
        """Whether a stack may ring within a record's band."""
        return shows_ringing(self.experiments)

    def alike(self, fit: Fit) -> tuple[tuple[str, ...], ...]:
        """Groups of effects that these records cannot tell apart but by forms nobody knows."""
        return same_curves(self.experiments, self.table, fit)


def same_curves(
    experiments: Sequence[Experiment], effects: Sequence[Component], fit: Fit
) -> tuple[tuple[str, ...], ...]:
    """Return groups of effects that bend the same curve, where the records show no resonance.

    They show one if a `fit` of them needed a mass and a record is fast enough to see it ring.
    """
    rings = shows_ringing(experiments) and any(n in fit.unknowns.names for n in _MASSES)
    curves = () if rings else sorted({e.curve for e in effects if e.curve is not None})
    groups = (tuple(e.name for e in effects if e.curve == c) for c in curves)
    return tuple(group for group in groups if len(group) > 1)


def shows_ringing(experiments: Sequence[Experiment]) -> bool:
    """Whether a record is sampled fast enough for a stack to ring within its band."""
    return min(e.record.sample_time for e in experiments) < FAST
