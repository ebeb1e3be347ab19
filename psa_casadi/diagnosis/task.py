"""What a search for causes works on, and by which method."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

from psa_casadi.component import Component
from psa_casadi.diagnosis.thresholds import Thresholds
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.records.split import Experiment, fitted

#: Sampling interval [s] below which a stack may ring within the record's band.
FAST = 7e-4
_MASSES = ("m_P", "m_B", "m")
#: Further columns that show the displacement.
_TELL_BENDS = ("displacement_2", "strain")

#: The steps of the method that a diagnosis can go without, to show what each is good for, and what
#: is done in their place.
STEPS = {
    "one clock": "readings stay on a clock of their own, whatever the data say",
    "remainder": "the noise's colour is that of the residual, not of what nothing explains",
    "finite steps": "effects whose derivative vanishes at their null are not looked for by a step",
    "fits afresh": "no fits from an ordinary base beside those from the fitted one",
    "other parents": "a set is fitted from one of its parents only",
    "begun again": "a cause that comes near the end of its range does not begin once more",
    "base again": "the base is not fitted again from where a cause has led",
    "resonances": "no resonances that the base has missed are tried",
    "several modes": "no series of modes is fitted where one leaves structure",
    "several at once": "causes are found one by one only",
    "exchange": "causes are not exchanged beside the later ones",
    "all afresh": "effects far behind in the screening are never fitted",
    "rejected": "no neighbours of what held-out data reject are fitted",
    "held out": "held-out data are not asked",
    "between samples": "the voltage between two samples is a straight line, whatever the data say",
    "form": "a further cause may be smaller than the first one's form is known",
}


@dataclass(frozen=True)
class Method:
    """The method, `without` some of its `STEPS`, with its deciding constants."""

    without: frozenset[str] = frozenset()
    thresholds: Thresholds = field(default_factory=Thresholds)


#: Why a hypothesis is told of.
State = Literal["fitted", "finished", "visited", "best"]


@dataclass(frozen=True)
class Tried:
    """A hypothesis of a search at the moment that it is told of.

    `state` says why: it was "fitted", its fit went on to its end ("finished"), its neighbours are
    fitted next ("visited"), or it is the answer ("best"). `causes` stand beside the base in the
    order in which they were added, so that all but the last are the parent's. `evidence` is ln of
    the Bayes factor over the first base fit, `score` that less the price of the causes. `rms_m`
    and `holdout_rms_m` [m] are the errors in fitted and in held-out samples, `base_rms_m` and
    `noise_rms_m` [m] the held-out error of the base and the noise as both are known by now.
    """

    state: State
    causes: tuple[str, ...]
    evidence: float
    score: float
    rms_m: float
    holdout_rms_m: float
    base_rms_m: float
    noise_rms_m: float


@dataclass(frozen=True)
class Task:
    """The records, the table of effects to search, the method, and who is told of the progress.

    `watch` gets every hypothesis of the search, `keep` the best fit so far where a keyboard
    interrupt ends it; `hidden` is the share of the readings that a saturated sensor has made.
    """

    experiments: tuple[Experiment, ...]
    table: tuple[Component, ...]
    method: Method = field(default_factory=Method)
    progress: Callable[[str], None] = lambda _: None
    keep: Callable[[Fit], None] = lambda _: None
    watch: Callable[[Tried], None] = lambda _: None
    hidden: float = 0.0

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

    They show one if a `fit` of them needed a mass and a record is fast enough to see it ring. A
    second sensor of the displacement tells them apart.
    """
    if any(f.column in _TELL_BENDS for f in fit.further):
        return ()
    rings = shows_ringing(experiments) and any(n in fit.unknowns.names for n in _MASSES)
    curves = () if rings else sorted({e.curve for e in effects if e.curve is not None})
    groups = (tuple(e.name for e in effects if e.curve == c) for c in curves)
    return tuple(group for group in groups if len(group) > 1)


def shows_ringing(experiments: Sequence[Experiment]) -> bool:
    """Whether a fitted record is sampled fast enough for a stack to ring within its band."""
    return min(e.record.sample_time for e in fitted(experiments)) < FAST
