"""A hypothesis: a model with a set of causes, fitted; and the one score that all are compared by.

    score = ln B + ln L - price * causes
    ln B  = (n - k)/2 ln(S_0 / S) - 1/2 ln det(1 + P H P)
    ln L  = m ln(E_0 / E)

Laplace's approximation of the Bayes factor over the plain base fit, of k unknowns. S and S_0 are
sums of squares of n whitened residuals, the noise level being the data's own; H is the information
on the unknowns that the base has not, those it has projected out, and P their prior standard
deviations. An unknown that the data do not tell costs nothing, a sharp one costs what its prior
range is wider than its interval (MacKay, Neural Computation 4 (1992), 415). L is what the fitted
samples predict of the held-out ones: E are the rms of their errors, m their number over the
inflation by the noise's colour. The evidence of all samples is the product of the two. Records that
are held out whole judge alone: of these the score has no L. The price is the prior of a cause.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from psa_casadi.component import Component
from psa_casadi.diagnosis.colour import Colour, rms
from psa_casadi.diagnosis.held_out import (
    held_out_further,
    held_out_rms,
    output_gain,
    whole_residuals,
)
from psa_casadi.diagnosis.screening import evidence
from psa_casadi.diagnosis.task import State, Tried
from psa_casadi.errors import PsaError
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.stepper import SimulationError

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A model with some causes beside the base, fitted to the records.

    `causes` are in the order in which the search found them; `predicted` [m] are the predictions of
    whole records, `holdout_rms` and `whole_rms` [m] the errors in held-out and in all samples;
    `final` says that the fit went on to its end. `held_further` are the errors of the further
    columns in held-out samples, in their units.
    """

    causes: tuple[Component, ...]
    fit: Fit
    predicted: tuple[FloatArray, ...]
    holdout_rms: float
    whole_rms: float
    final: bool = False
    held_further: tuple[float, ...] = ()

    @property
    def names(self) -> frozenset[str]:
        """Names of the causes."""
        return frozenset(c.name for c in self.causes)

    def names_upto(self, count: int) -> frozenset[str]:
        """Names of the first so many causes."""
        return frozenset(c.name for c in self.causes[:count])

    @property
    def power(self) -> float:
        """Mean square of the residuals [m^2]."""
        return self.fit.rms**2

    def removes(self, before: "Hypothesis") -> float:
        """Power [m^2] that it takes from the residual of another one.

        What it takes from a further column counts over that column's level, as of the displacement.
        """
        level, count = rms(np.array(before.fit.sigma)), max(len(before.fit.residuals), 1)
        beside = sum(
            len(old.residuals) / count * (old.rms**2 - new.rms**2) * (level / old.level) ** 2
            for old, new in zip(before.fit.further, self.fit.further, strict=True)
        )
        return before.power - self.power + beside

    def share(self, before: "Hypothesis", root: "Hypothesis") -> float:
        """What it takes from another one's error over whole records, over what that one takes."""
        taken = root.whole_rms**2 - before.whole_rms**2
        more = before.whole_rms**2 - self.whole_rms**2
        return more / taken if taken > 0 else np.inf


def hypothesis(
    causes: Sequence[Component],
    fit: Fit | None,
    experiments: Sequence[Experiment],
    *,
    final: bool = False,
) -> Hypothesis | None:
    """Return a fit as a hypothesis; None without a fit, or where it cannot predict the records."""
    if fit is None:
        return None
    try:
        predicted = tuple(fit.predicted(experiments))
        beside = held_out_further(fit, experiments)
    except PsaError:
        return None
    held = held_out_rms(experiments, predicted)
    whole = rms(np.concatenate(whole_residuals(experiments, predicted)))
    return Hypothesis(tuple(causes), fit, predicted, held, whole, final, beside)


def root_of(base: Fit, experiments: Sequence[Experiment]) -> Hypothesis:
    """Return a base fit as the hypothesis without causes. Raises SimulationError."""
    root = hypothesis((), base, experiments, final=True)
    if root is None:
        raise SimulationError(
            "The fitted base cannot be simulated over the whole records; start from a model."
        )
    return root


@dataclass(frozen=True, eq=False)
class Scale:
    """What hypotheses are compared by: the plain base, the colour of the noise, the price.

    `held` is the number of held-out samples; they choose between hypotheses, or `judge_only`.
    """

    base: Hypothesis
    colour: Colour
    price: float
    held: int = 0
    judge_only: bool = False
    _known: dict[Fit, float] = field(init=False, default_factory=dict)

    def evidence(self, of: Hypothesis) -> float:
        """Ln B, of the fitted samples alone; more modes than one have their price here."""
        if of.fit not in self._known:
            self._known[of.fit] = evidence(self.base.fit, of.fit, self.colour)
        return self._known[of.fit] - self.price * sum(c.count - 1 for c in of.causes)

    def held_out(self, of: Hypothesis, before: Hypothesis) -> float:
        """Ln of what one hypothesis gives the held-out samples over what another one does."""
        if not self.held:
            return 0.0
        samples = self.held / self.colour.inflation
        gained = output_gain(samples, before.holdout_rms, of.holdout_rms)
        rows = zip(
            of.fit.further, self.colour.further, before.held_further, of.held_further, strict=True
        )
        return gained + sum(
            output_gain(self.held / own.inflation, old, new, f.straight)
            for f, own, old, new in rows
        )

    def gain(self, of: Hypothesis, before: Hypothesis) -> float:
        """Ln of the Bayes factor of one hypothesis over another one, of all samples that choose."""
        held_out = 0.0 if self.judge_only else self.held_out(of, before)
        return self.evidence(of) - self.evidence(before) + held_out

    def score(self, of: Hypothesis) -> float:
        """Ln of the Bayes factor over the plain base, less the price of the causes."""
        return self.gain(of, self.base) - self.price * len(of.causes)

    def of_fitted(self, of: Hypothesis) -> float:
        """The score of the fitted samples alone."""
        return self.evidence(of) - self.price * len(of.causes)


def scale_of(
    base: Hypothesis, colour: Colour, price: float, experiments: Sequence[Experiment]
) -> Scale:
    """Return the scale of a search; blocks of fitted records choose, whole records judge alone."""
    held = sum(int(e.held_out.sum()) for e in experiments)
    return Scale(base, colour, price, held, any(e.held_out_whole for e in experiments))


def tried(of: Hypothesis, state: State, root: Hypothesis, scale: Scale) -> Tried:
    """Return what is told of a hypothesis while a search goes on."""
    return Tried(
        state,
        tuple(c.name for c in of.causes),
        evidence=float(scale.evidence(of)),
        score=float(scale.score(of)),
        rms_m=float(of.fit.rms),
        holdout_rms_m=float(of.holdout_rms),
        base_rms_m=float(root.holdout_rms),
        noise_rms_m=float(scale.colour.rms),
    )


def ended(of: Hypothesis) -> Hypothesis:
    """Return a hypothesis whose fit cannot go on."""
    return replace(of, final=True)
