"""Hypotheses: a fitted model with a set of causes, its score, and what its residual shows.

    score = ln B + ln L - price * causes
    ln B  = (n - k)/2 ln(S_0 / S) - 1/2 ln det(1 + P H P)
    ln L  = m ln(E_0 / E)

Laplace's approximation of the Bayes factor over the plain base fit, of k unknowns. S and S_0 are
sums of squares of n whitened residuals, the noise level being estimated from the data; H is the
information on the unknowns that the base has not, those it has projected out, and P their prior
standard deviations. An unknown that the data leave open costs nothing, a sharp one costs what its
prior range is wider than its interval (MacKay, Neural Computation 4 (1992), 415). L is what the
fitted samples predict of the held-out ones: E are the rms of their errors, m their number over the
inflation by the noise's colour. The evidence of all samples is the product of the two. Records that
are held out whole judge alone: of these the score has no L. The price is the prior of a cause.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy

from psa_casadi.common.errors import PsaError
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.colour import Colour, OwnColour, own_colour, residual_colour, rms
from psa_casadi.diagnosis.held_out import held_out_gain
from psa_casadi.diagnosis.noise import Omnibus, known_colour
from psa_casadi.diagnosis.pack import Pack, Task
from psa_casadi.diagnosis.probes import Direction, directions
from psa_casadi.diagnosis.process_noise import entering
from psa_casadi.diagnosis.screening import (
    Score,
    Screening,
    estimated,
    evidence,
    occam,
    screen,
    whitened_residuals,
)
from psa_casadi.diagnosis.task import LIMITS, Thresholds
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.model.component import Component
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.stepper import SimulationError
from psa_casadi.simulation.timings import stage


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A model with some causes added to the base, fitted to records.

    `causes` are in the order of the search; `predictions` (n, channels) are the
    predictions of whole records; `held`, `train` and `whole` are the rms errors of every channel in
    held-out, in fitted and in all samples, over the records' shares of the noise, in its unit;
    `colours` are those that every channel's residual has by itself; `final`: the fit went on to
    its end.
    """

    causes: tuple[Component, ...]
    fit: Fit
    predictions: tuple[FloatArray, ...]
    held: tuple[float, ...]
    train: tuple[float, ...]
    whole: tuple[float, ...]
    colours: tuple[OwnColour, ...]
    final: bool = False

    @property
    def experiments(self) -> tuple[Experiment, ...]:
        """The records with the samples that are fitted and judged."""
        return self.fit.experiments

    @property
    def predicted(self) -> tuple[FloatArray, ...]:
        """The predictions (n,) of the first channel."""
        return tuple(y[:, 0] for y in self.predictions)

    @property
    def colour(self) -> Colour:
        """The colour of its residual, in every channel's fitted samples."""
        first, *others = (item.colour for item in self.colours)
        return replace(first, further=tuple(others))

    def beyond_noise(self, before: "Hypothesis", held: Sequence[int], chance: float) -> float:
        """Return its evidence over another one where either's residual may be noise of its colour.

        With what it gains beyond `chance` [nats] in the samples of every channel that are `held`
        out, of which noise of the other one's colour leaves few independent ones. Less than 0 where
        noise of another colour explains the data as well [nats].
        """
        rows = list(zip(self.fit.channels, before.colours, self.colours, strict=True))
        gained = sum(new.nats(f.straight) - old.nats(f.straight) for f, old, new in rows)
        levels = [float(np.hypot(new.level, f.straight)) for f, _, new in rows]
        straight = [f.straight for f in self.fit.channels]
        ahead = held_out_gain(held, before.colour, straight, before.held, self.held) if held else 0
        spent = occam(before.fit, self.fit, self.colour, levels)
        return gained + max(ahead - chance, 0.0) - spent

    @property
    def errors(self) -> tuple[float, ...]:
        """The held-out rms of every channel, that of fitted samples where none is held out."""
        return tuple(held or train for held, train in zip(self.held, self.train, strict=True))

    @property
    def names(self) -> frozenset[str]:
        """Names of the causes."""
        return frozenset(c.name for c in self.causes)

    def names_upto(self, count: int) -> frozenset[str]:
        """Names of the first `count` causes."""
        return frozenset(c.name for c in self.causes[:count])

    def removes(self, before: "Hypothesis") -> float:
        """Power, in the first channel's unit, that it takes from the residual of another one.

        What it takes from a further channel counts over that one's level, as of the first.
        """
        level, count = rms(np.array(before.fit.sigma)), max(len(before.fit.residuals), 1)
        others = sum(
            len(old.residuals) / count * (old.rms**2 - new.rms**2) * (level / old.level) ** 2
            for old, new in zip(before.fit.further, self.fit.further, strict=True)
        )
        return before.fit.rms**2 - self.fit.rms**2 + others

    def leaves(self, before: "Hypothesis") -> float:
        """What it leaves of another one's error over whole records, in power, over that [-]."""
        levels = np.array([f.level for f in before.fit.channels])
        old, new = (np.square(h.whole / levels).sum() for h in (before, self))
        return float(new / max(old, 1e-300))

    def share(self, before: "Hypothesis", root: "Hypothesis") -> float:
        """What it takes from another one's error over whole records, over what that one takes.

        Summed over the channels, each over its level.
        """
        levels = np.array([f.level for f in before.fit.channels])
        base, old, new = (np.square(h.whole / levels).sum() for h in (root, before, self))
        return float((old - new) / (base - old)) if base > old else np.inf


def hypothesis(
    causes: Sequence[Component], fit: Fit | None, *, final: bool = False
) -> Hypothesis | None:
    """Return a fit as a hypothesis; None without a fit, or where it cannot predict the records."""
    if fit is None:
        return None
    try:
        predictions = tuple(fit.predicted_channels())
    except PsaError:
        return None
    rows, colours, experiments = [], [], fit.experiments
    for k, f in enumerate(fit.channels):
        held, train, every, rests = [], [], [], []
        for e, y in zip(experiments, predictions, strict=True):
            left = e.errors(f.number, y[:, k])
            held.append(left[e.at(f.number, e.held_out)])
            train.append(left[e.at(f.number)])
            every.append(left[np.isfinite(left)])
            rests.append(left)
        errors = tuple(rms(np.concatenate(parts)) for parts in (held, train, every))
        rows.append((errors[0] or (f.rms if k else 0.0), *errors[1:]))
        fitted = [e.at(f.number) for e in experiments]
        judged = [e.at(f.number, e.held_out) for e in experiments]
        rates = [np.gradient(y[:, k]) for y in predictions]
        # the parameters of several channels do not follow the colour of one of them
        free = slice(0 if fit.further else None)
        follow = f.jacobian[:, free], fit.unknowns.prior[free]
        colours.append(own_colour(rests, fitted, judged, *follow, rates))
    held_rms, train_rms, whole = zip(*rows, strict=True)
    return Hypothesis(
        tuple(causes), fit, predictions, held_rms, train_rms, whole, tuple(colours), final
    )  # fmt: skip


def noisy(of: Hypothesis, task: Task) -> Hypothesis:
    """Return a hypothesis with noise that enters its model, if that is likelier."""
    if task.pack.is_stack:
        return of  # noise of any colour is the sensor's
    colours = []
    for k, (f, colour) in enumerate(zip(of.fit.channels, of.colours, strict=True)):
        pairs = zip(of.experiments, of.predictions, strict=True)
        errors = [e.errors(f.number, y[:, k]) for e, y in pairs]
        colours.append(entering(of.fit, errors, k, colour))
    return replace(of, colours=tuple(colours))


def root_of(base: Fit, task: Task) -> Hypothesis:
    """Return a base fit as the hypothesis without causes. Raises SimulationError."""
    root = hypothesis((), base, final=True)
    if root is None:
        raise SimulationError(
            "The fitted base cannot be simulated over the whole records; start from a model."
        )
    return noisy(root, task)


@dataclass(frozen=True, eq=False)
class Scale:
    """What hypotheses are compared by: the plain base, the colour of the noise, the limits.

    `held` are the held-out samples of every channel; they choose between hypotheses, or
    `judge_only`.
    """

    base: Hypothesis
    colour: Colour
    limits: Thresholds
    held: tuple[int, ...] = ()
    judge_only: bool = False
    _known: dict[Fit, float] = field(init=False, default_factory=dict)

    def evidence(self, of: Hypothesis) -> float:
        """Ln B, of the fitted samples alone; more modes than one have their price here."""
        if of.fit not in self._known:
            self._known[of.fit] = evidence(self.base.fit, of.fit, self.colour)
        return self._known[of.fit] - self.limits.price * sum(c.count - 1 for c in of.causes)

    def held_out(self, of: Hypothesis, before: Hypothesis) -> float:
        """Ln of what one hypothesis gives the held-out samples over what another one does."""
        if not any(self.held):
            return 0.0
        straight = [f.straight for f in of.fit.channels]
        return held_out_gain(self.held, self.colour, straight, before.held, of.held)

    def gain(self, of: Hypothesis, before: Hypothesis) -> float:
        """Ln of the Bayes factor of one hypothesis over another one, of all samples that choose."""
        held_out = 0.0 if self.judge_only else self.held_out(of, before)
        return self.evidence(of) - self.evidence(before) + held_out

    def score(self, of: Hypothesis) -> float:
        """Ln of the Bayes factor over the plain base, less the price of the causes."""
        return self.gain(of, self.base) - self.limits.price * len(of.causes)

    def of_fitted(self, of: Hypothesis) -> float:
        """The score of the fitted samples alone."""
        return self.evidence(of) - self.limits.price * len(of.causes)


def scale_of(base: Hypothesis, colour: Colour, limits: Thresholds) -> Scale:
    """Return the scale of a search; blocks of fitted records choose, whole records judge alone."""
    experiments, numbers = base.experiments, [f.number for f in base.fit.channels]
    held = tuple(sum(int(e.at(j, e.held_out).sum()) for e in experiments) for j in numbers)
    return Scale(base, colour, limits, held, any(e.held_out_whole for e in experiments))


#: Largest number of starts of each effect.
_STARTS = 2


@dataclass(frozen=True, eq=False)
class View:
    """What the residual of a hypothesis shows.

    `of` is the hypothesis as it was tested, `trials` the directions of further effects there,
    `screening` their scores with the colour of the noise, `test` the omnibus test; `pack` knows the
    kind of device.
    """

    of: Hypothesis
    trials: tuple[Direction, ...]
    screening: Screening
    test: Omnibus
    pack: Pack

    @property
    def decrease(self) -> float:
        """Decrease of the whitened sum of squares along the best direction, over the variance."""
        return max((s.decrease for s in self.screening.scores), default=0.0)

    def estimated(self) -> dict[str, float]:
        """Evidence of every further effect over this hypothesis, without a fit."""
        return estimated(self.of.fit, self.screening)

    def leading(self) -> list[list[Score]]:
        """Return the best starts of the effects that are to be fitted, the best effect first."""
        return [self.starts_of(name) for name in self.screening.leading()]

    def starts_of(self, name: str) -> list[Score]:
        """Return the best directions of one effect, from which its fits start.

        Of an effect that has two forms, between which no fit moves, each form gets a start; a
        further start differs from the best one in as many trial values as it can. One that is
        looked for with both signs of its gain starts at each of these steps, too.
        """
        scores = [s for s in self.screening.scores if s.direction.effect.name == name]
        near = [s for s in scores if s.decrease >= 0.3 * scores[0].decrease]
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
        both = min(scores[0].direction.effect.finite_step, default=0.0) < 0.0
        return starts + [s for s in scores if both and s.direction.finite and s not in starts]

    @property
    def promise(self) -> float:
        """Power [m^2] that the best direction would remove, linearly estimated."""
        return self.decrease * self.screening.colour.level**2 / len(self.of.fit.residuals)

    @property
    def shows(self) -> bool:
        """Whether a direction is above the threshold and promises more than the detection limit.

        With a cause the test must alarm too: the error of the cause's form shows in directions.
        """
        fit, needed = self.of.fit, self.test.alarm or not self.of.causes
        significant = self.decrease >= self.screening.threshold
        return significant and self.pack.shows(fit, self.promise, self.test) and needed

    @property
    def leaves(self) -> bool:
        """Whether anything is left to explain."""
        return self.test.alarm or self.shows


@stage("screening")
def examine(of: Hypothesis, task: Task, known: Sequence[Direction] = ()) -> View:
    """Screen the effects that a hypothesis does not hold yet, and test its residual.

    Directions that are `known` from the base are used again: what an effect adds hardly changes
    with another effect added, and a full fit judges. Without causes the test has the colour of
    the residual itself, which slow noise of any kind may have; with causes that of the screening,
    and it asks whether the residual is as large everywhere.
    """
    task.progress("screening effects")
    fit = of.fit
    effects = [e for e in task.table if e not in fit.model.components]
    kept: list[Direction] = []
    if known:
        lines = [e for e in effects if e.from_residual]  # this residual's peaks are other ones
        kept = [d for d in known if d.effect in effects and d.effect not in lines]
        effects = lines
    finite = "finite steps" not in task.method.without
    kept += directions(fit, effects, finite_steps=finite)
    screening = _screened(fit, kept, task)
    residuals, colour, alone = [f.residuals for f in fit.channels], screening.colour, not of.causes
    if alone:  # is there anything but noise of some colour?
        tested = [c.tested for c in of.colours]
        residuals, (colour, *others) = [r for r, _ in tested], [c for _, c in tested]
        colour = replace(colour, further=tuple(others))
    test = task.pack.tested(fit, residuals, colour, task.limits, from_residual=alone)
    coloured = alone and any(c.autoregression.size for c in of.colours)
    if coloured and kept and not task.pack.is_stack and not test.alarm:
        test = _asked(fit, kept, colour, test, task.limits)
    return View(of, tuple(kept), screening, test, task.pack)


def _asked(
    fit: Fit, trials: Sequence[Direction], colour: Colour, test: Omnibus, limits: Thresholds
) -> Omnibus:
    """Return the test with what an effect would lower in noise of that colour, if it alarms.

    The best direction of effects with m weights removes chi^2 of m noise variances, with
    Bonferroni's correction for the number of directions.
    """
    screening = screen(fit, trials, colour=colour, limits=limits)
    best, count = screening.scores[0], len(screening.scores)
    freedom = max(1, len(best.direction.effect.linear))
    p = min(1.0, count * float(scipy.special.chdtrc(freedom, best.decrease)))
    share = best.decrease * colour.level**2 / float(np.sum(whitened_residuals(fit, colour) ** 2))
    size = float(np.sqrt(min(share, 1.0))) * fit.rms
    of_effect = replace(test, p_value=p, structure="effect", size=size)
    return of_effect if of_effect.alarm else test


def _screened(fit: Fit, trials: Sequence[Direction], task: Task) -> Screening:
    known, colour = None, None
    if "remainder" in task.method.without:
        colour = residual_colour(fit.record_residuals)
    elif task.pack.is_stack:
        pairs = zip(fit.experiments, fit.record_residuals, strict=True)
        known = [known_colour(e.record, r) for e, r in pairs]
    return screen(fit, trials, known, colour=colour, limits=task.limits)


#: Share of a range that is near its end.
_END = 0.1


def held_out_confirms(of: Hypothesis, before: Hypothesis, scale: Scale) -> bool:
    """Whether held-out samples do not speak against what a hypothesis adds to another one.

    The rule is `confirmed`; a change of prediction with the sum of squares D promises D/2 over the
    noise's power, summed over the channels.
    """
    if not any(scale.held):
        return True
    promise = 0.0
    for k, (f, c) in enumerate(zip(of.fit.channels, scale.colour.each, strict=True)):
        rows = zip(of.experiments, of.predictions, before.predictions, strict=True)
        change = np.concatenate(
            [(new - old)[e.at(f.number, e.held_out), k] / e.share(f.number) for e, new, old in rows]
        )
        if change.size:
            after = max(float(np.hypot(of.held[k], f.straight)), 1e-300)
            samples = change.size / c.inflation
            promise += 0.5 * samples * float(np.mean(change**2)) / after**2
    gained, score = scale.held_out(of, before), scale.of_fitted(of) - scale.of_fitted(before)
    return confirmed(gained, promise, score, scale.limits)


def confirmed(gained: float, promise: float, score: float, limits: Thresholds = LIMITS) -> bool:
    """Whether a gain of the held-out log-likelihood is enough, with that of the score [nats].

    A promised gain p is observed with an error of sqrt(2 p). The observed gain must be `held_out`,
    or, where these samples can hardly show the cause, two such errors less than what is promised;
    and so much must the fitted samples' score and the observed gain be together.
    """
    least = min(limits.held_out, promise - 2.0 * float(np.sqrt(2.0 * promise)))
    return bool(gained > least and score + gained > limits.held_out)


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
