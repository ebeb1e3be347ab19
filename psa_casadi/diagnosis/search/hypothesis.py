"""Hypotheses: a fitted model with a set of causes, its score, and what its residual shows.

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

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Generic, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from psa_casadi.component import DISPLACEMENT_PEAKS, Component
from psa_casadi.diagnosis.colour import Colour, Omnibus, noise_rms, omnibus, residual_colour, rms
from psa_casadi.diagnosis.held_out import (
    held_out_further,
    held_out_gain,
    held_out_rms,
    whole_residuals,
)
from psa_casadi.diagnosis.noise import knowable_of, known_colour
from psa_casadi.diagnosis.probes import Direction, directions
from psa_casadi.diagnosis.screening import (
    Score,
    Screening,
    estimated,
    evidence,
    independent,
    screen,
    without,
)
from psa_casadi.diagnosis.task import LIMITS, Task, Thresholds
from psa_casadi.errors import PsaError
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.fitting.further import with_column
from psa_casadi.identification.fitting.unknowns import Fitted
from psa_casadi.records.drive import tells_tone
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.start import linear_part
from psa_casadi.simulation.stepper import SimulationError
from psa_casadi.simulation.timings import stage

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

    def removes(self, before: "Hypothesis") -> float:
        """Power [m^2] that it takes from the residual of another one.

        What it takes from a further column counts over that column's level, as of the displacement.
        """
        level, count = rms(np.array(before.fit.sigma)), max(len(before.fit.residuals), 1)
        beside = sum(
            len(old.residuals) / count * (old.rms**2 - new.rms**2) * (level / old.level) ** 2
            for old, new in zip(before.fit.further, self.fit.further, strict=True)
        )
        return before.fit.rms**2 - self.fit.rms**2 + beside

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
        whole = fit.predictions(experiments, differentiated=False, further=True)
    except PsaError:
        return None
    beside = held_out_further(fit, experiments, whole)
    predicted = tuple(p.displacement for p in whole)
    held = held_out_rms(experiments, predicted)
    every = rms(np.concatenate(whole_residuals(experiments, predicted)))
    return Hypothesis(tuple(causes), fit, predicted, held, every, final, beside)


def root_of(base: Fit, experiments: Sequence[Experiment]) -> Hypothesis:
    """Return a base fit as the hypothesis without causes. Raises SimulationError."""
    root = hypothesis((), base, experiments, final=True)
    if root is None:
        raise SimulationError(
            "The fitted base cannot be simulated over the whole records; start from a model."
        )
    return root


class Explanation(Protocol):
    """What a scale needs of a hypothesis: its causes, and the fit with them."""

    @property
    def causes(self) -> tuple[Component, ...]:
        """Its causes."""

    @property
    def fit(self) -> Fitted:
        """The fit with them."""


H = TypeVar("H", bound=Explanation)


def _nothing(_of: object, _before: object, _colour: Colour) -> float:
    return 0.0


@dataclass(frozen=True, eq=False)
class Scale(Generic[H]):
    """What hypotheses are compared by: the plain base, the colour of the noise, the limits.

    `by_held_out` is ln of what one hypothesis gives the held-out samples over what another one
    does; they choose between hypotheses, or `judge_only`.
    """

    base: H
    colour: Colour
    limits: Thresholds
    by_held_out: Callable[[H, H, Colour], float] = _nothing
    judge_only: bool = False
    _known: dict[Fitted, float] = field(init=False, default_factory=dict)

    def evidence(self, of: H) -> float:
        """Ln B, of the fitted samples alone; more modes than one have their price here."""
        if of.fit not in self._known:
            self._known[of.fit] = evidence(self.base.fit, of.fit, self.colour)
        return self._known[of.fit] - self.limits.price * sum(c.count - 1 for c in of.causes)

    def held_out(self, of: H, before: H) -> float:
        """Ln of what one hypothesis gives the held-out samples over what another one does."""
        return self.by_held_out(of, before, self.colour)

    def gain(self, of: H, before: H) -> float:
        """Ln of the Bayes factor of one hypothesis over another one, of all samples that choose."""
        held_out = 0.0 if self.judge_only else self.held_out(of, before)
        return self.evidence(of) - self.evidence(before) + held_out

    def score(self, of: H) -> float:
        """Ln of the Bayes factor over the plain base, less the price of the causes."""
        return self.gain(of, self.base) - self.limits.price * len(of.causes)

    def of_fitted(self, of: H) -> float:
        """The score of the fitted samples alone."""
        return self.evidence(of) - self.limits.price * len(of.causes)


def scale_of(
    base: Hypothesis, colour: Colour, limits: Thresholds, experiments: Sequence[Experiment]
) -> Scale[Hypothesis]:
    """Return the scale of a search; blocks of fitted records choose, whole records judge alone."""
    held = sum(int(e.held_out.sum()) for e in experiments)

    def gained(of: Hypothesis, before: Hypothesis, colour: Colour) -> float:
        straight = [0.0, *(f.straight for f in of.fit.further)]
        errors = [(h.holdout_rms, *h.held_further) for h in (before, of)]
        return held_out_gain([held] * len(straight), colour, straight, *errors) if held else 0.0

    return Scale(base, colour, limits, gained, any(e.held_out_whole for e in experiments))


#: So many starts each effect gets.
_STARTS = 2


@dataclass(frozen=True, eq=False)
class Look(Generic[H]):
    """What the residual of a hypothesis shows.

    `of` is the hypothesis as it was seen, `trials` the directions of further effects there,
    `screening` their scores with the colour of the noise, `test` the omnibus test.
    """

    of: H
    trials: tuple[Direction, ...]
    screening: Screening
    test: Omnibus

    @property
    def decrease(self) -> float:
        """Decrease of the whitened sum of squares along the best direction, over the variance."""
        return max((s.decrease for s in self.screening.scores), default=0.0)

    def estimated(self) -> dict[str, float]:
        """Evidence of every further effect over this hypothesis, without a fit."""
        return estimated(self.of.fit, self.screening)

    def leading(self) -> list[list[Score]]:
        """Return the best starts of the effects worth a fit, the best effect first."""
        return [self.starts_of(name) for name in self.screening.leading()]

    def starts_of(self, name: str) -> list[Score]:
        """Return the best directions of one effect, from which its fits start.

        Of an effect that has two forms, between which no fit moves, each form gets a start; a
        further start differs from the best one in as many trial values as it can.
        """
        own = [s for s in self.screening.scores if s.direction.effect.name == name]
        near = [s for s in own if s.decrease >= 0.3 * own[0].decrease]
        starts: list[Score] = []

        def form(score: Score) -> dict[str, float]:
            fitted = score.direction.effect.fitted
            return {n: v for n, v in score.direction.values.items() if n not in fitted}

        def differing(score: Score) -> int:
            best = near[0].direction.values
            return sum(v != best[n] for n, v in score.direction.values.items())

        for score in near:
            if all(form(score) != form(s) for s in starts):
                starts.append(score)
        for score in sorted(near, key=lambda s: -differing(s)):
            known = [s.direction.values for s in starts]
            new = score.direction.values not in known or score.direction.finite
            if new and score not in starts and len(starts) < _STARTS:
                starts.append(score)
        return starts


class View(Look[Hypothesis]):
    """What the residual of a stack's hypothesis shows."""

    @property
    def promise(self) -> float:
        """Power [m^2] that the best direction would remove, linearly estimated."""
        return self.decrease * self.screening.colour.level**2 / len(self.of.fit.residuals)

    @property
    def shows(self) -> bool:
        """Whether a direction is above the threshold and would remove what can be told of a stack.

        Beside a cause the test must alarm too: what it leaves of its own form shows in directions.
        """
        seen = self.decrease >= self.screening.threshold and self.promise > self.test.knowable**2
        return seen and (self.test.alarm or not self.of.causes)

    @property
    def leaves(self) -> bool:
        """Whether anything is left to explain."""
        return self.test.alarm or self.shows


@stage("screening")
def examine(of: Hypothesis, task: Task, known: Sequence[Direction] = ()) -> View:
    """Screen the effects that a hypothesis does not hold yet, and test its residual.

    Directions that are `known` from the base are used again: what an effect adds hardly changes
    with another effect beside it, and a full fit judges.
    """
    task.progress("screening effects")
    fit, experiments = of.fit, task.experiments
    effects = [e for e in task.table if e not in fit.model.components]
    kept: list[Direction] = []
    if known:
        lines = [e for e in effects if e.from_residual]  # this residual's peaks are other ones
        kept = [d for d in known if d.effect in effects and d.effect not in lines]
        effects = lines
    finite = "finite steps" not in task.method.without
    kept += directions(fit, experiments, effects, finite_steps=finite)
    screening = _screened(fit, kept, task)
    return View(
        of, tuple(kept), screening,
        tested(fit, experiments, screening.colour, task.limits, even=bool(of.causes)),
    )  # fmt: skip


def tested(
    fit: Fit,
    experiments: Sequence[Experiment],
    colour: Colour,
    limits: Thresholds,
    *,
    even: bool,
) -> Omnibus:
    """Return the test of the residual, or that of a further column where only this one alarms."""

    def test_of(
        residual: FloatArray, parts: Sequence[Experiment], own: Colour, least: float
    ) -> Omnibus:
        voltage, time = (
            np.concatenate([getattr(e.record, name)[e.used] for e in parts])
            for name in ("voltage", "time")
        )
        noise = noise_rms(residual, own)
        return omnibus(
            residual, voltage, time, own, noise,
            knowable=least, even=even, alarms_below=limits.alarm,
        )  # fmt: skip

    test = test_of(fit.residuals, experiments, colour, knowable_of(fit, experiments, limits))
    for f, own in zip(fit.further, colour.further, strict=True):
        if test.alarm:
            break
        parts = [experiments[k] for k in with_column(experiments, f.column)]
        found = test_of(f.residuals, parts, own, f.straight)
        p = min(1.0, found.p_value * (1 + len(fit.further)))
        if found.alarm and p < limits.alarm:
            size = max(test.size, 2.0 * test.knowable)
            test = replace(found, p_value=p, size=size, knowable=test.knowable, output=f.column)
    return test


def _screened(fit: Fit, trials: Sequence[Direction], task: Task) -> Screening:
    lengths = [int(e.used.sum()) for e in task.experiments]
    residuals = fit.residuals_of(task.experiments)
    known = [known_colour(e.record, r) for e, r in zip(task.experiments, residuals, strict=True)]
    if "remainder" in task.method.without:
        return screen(
            fit, trials, lengths, colour=residual_colour(fit.residuals, lengths), limits=task.limits
        )
    return screen(fit, trials, lengths, known, limits=task.limits)


#: Fits of one set whose evidence differs by so many nats at most are the same minimum.
_SAME = 1.0
#: Terms of a static curve.
_CURVE = 8
#: Share of a range that is near its end.
_END = 0.1
#: Damping ratio of a sharp resonance, and halves of its width within which a tone is its ringing.
_SHARP, _WIDTHS = 0.05, 2.0


def held_out_confirms(
    of: Hypothesis, before: Hypothesis, experiments: Sequence[Experiment], scale: Scale[Hypothesis]
) -> bool:
    """Whether held-out samples do not speak against what a hypothesis adds to another one.

    The rule is `confirmed`; a change of prediction with the sum of squares D promises D/2 over the
    noise's power.
    """
    held = np.concatenate([e.held_out for e in experiments])
    if not np.any(held):
        return True
    samples = np.count_nonzero(held) / scale.colour.inflation
    change = np.concatenate(
        [(new - old) for new, old in zip(of.predicted, before.predicted, strict=True)]
    )[held]
    after = max(of.holdout_rms, 1e-300)
    promise = 0.5 * samples * float(np.mean(change**2)) / after**2
    gained = scale.held_out(of, before)
    score = scale.of_fitted(of) - scale.of_fitted(before)
    return confirmed(gained, promise, score, scale.limits)


def confirmed(gained: float, promise: float, score: float, limits: Thresholds = LIMITS) -> bool:
    """Whether a gain of the held-out log-likelihood is enough, beside that of the score [nats].

    A promised gain p is found give or take sqrt(2 p). Found must be `held_out`, or, where these
    samples can hardly show the cause, two such errors less than what is promised; and so much must
    the fitted samples' score and what is found be together.
    """
    least = min(limits.held_out, promise - 2.0 * float(np.sqrt(2.0 * promise)))
    return bool(gained > least and score + gained > limits.held_out)


def another_minimum(gained: float, held_out: float) -> bool:
    """Whether a fit of the same causes is another minimum that takes the other one's place.

    It has `gained` more evidence, and held-out samples do not object by more than that [nats].
    """
    return gained > _SAME and gained + held_out > 0.0


def shows_memory(
    of: Hypothesis, before: Hypothesis, experiments: Sequence[Experiment], limits: Thresholds
) -> bool:
    """Whether what a cause adds to another hypothesis is more than a curve of the voltage.

    At most `static` of the power that the other's parameters cannot follow may be one. Elements
    that are wider than the voltage's way are such a curve.
    """
    pairs = zip(of.predicted, before.predicted, experiments, strict=True)
    added = np.concatenate([(new - old)[e.used] for new, old, e in pairs])
    voltage = np.concatenate([e.record.voltage[e.used] for e in experiments])
    basis = independent(before.fit.jacobian)
    target = without(added, basis)
    place = (voltage - voltage.min()) / max(float(np.ptp(voltage)), 1e-300)
    curves = np.cos(np.pi * np.outer(place, np.arange(1, _CURVE + 1)))
    static = independent(without(curves, basis)).T @ target
    return float(static @ static) < limits.static * float(target @ target)


def in_character(fit: Fit, cause: Component, experiments: Sequence[Experiment]) -> bool:
    """Whether the data ask for this effect and not for something else.

    Not with a parameter pushed to the end of its range, a tone among the harmonics of a periodic
    drive (a hum at the mains' frequency may lie between them), a hum where the stack itself rings,
    or a period over the displacement that fits into it less than twice.
    """
    values = fit.model.values
    widest = max(e.record.range_m for e in experiments)
    periods = [values[n] for n, grid in cause.probe.items() if grid == DISPLACEMENT_PEAKS]
    if any(period > 0.5 * widest for period in periods):
        return False
    tone = cause.tone
    hum = cause.belongs_to == "environment"
    if tone is not None and not all(
        tells_tone(values[tone], e.record, hum=hum) for e in experiments
    ):
        return False
    if tone is not None and hum and _rings_at(fit, values[tone]):
        return False
    return inside_ranges(values, cause)


def _rings_at(fit: Fit, frequency: float) -> bool:
    """Whether a frequency [Hz] lies within a sharp resonance of the fitted model."""
    try:
        poles = np.linalg.eigvals(linear_part(fit.model).a) / (2.0 * np.pi)
    except (PsaError, np.linalg.LinAlgError):
        return False
    sharp = np.abs(poles.real) < _SHARP * np.abs(poles)
    near = np.abs(np.abs(poles) - frequency) < _WIDTHS * np.abs(poles.real)
    return bool(np.any(sharp & near))


def inside_ranges(values: Mapping[str, float], cause: Component) -> bool:
    """Whether no parameter of a cause but its gain was pushed to the end of its range.

    One whose lower end is a limit of the law may be there.
    """
    for p in cause.parameters:
        if not p.fitted or p.name == cause.gain:
            continue
        low, high = (0.0, p.bounds[1]) if p.limit else p.bounds
        margin = 1e-3 * (high - low) if not p.log else 0.0
        value = values[p.name]
        if p.log and (value < 1.01 * low or value > high / 1.01):
            return False
        if not p.log and (value <= low + margin or value >= high - margin):
            return False
    return True


def near_end(values: Mapping[str, float], effect: Component) -> bool:
    """Whether a parameter of an effect, its gain and weights apart, is near an end of its range."""
    for p in effect.parameters:
        if not p.fitted or p.name in (effect.gain, *effect.linear):
            continue
        scale = np.log if p.log else float
        low, high, value = scale(p.bounds[0]), scale(p.bounds[1]), scale(values[p.name])
        if not _END < (value - low) / (high - low) < 1.0 - _END:
            return True
    return False
