"""Which effects are fitted, and the choice among them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from psa_casadi.diagnosis.held_out.errors import held_out_rms
from psa_casadi.diagnosis.noise.colour import Colour, excess_power
from psa_casadi.diagnosis.screening.screen import Score, Screening
from psa_casadi.diagnosis.search.extension import Extension
from psa_casadi.diagnosis.task import shows_ringing
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.records.drive import among_harmonics
from psa_casadi.records.split import Experiment

FloatArray = npt.NDArray[np.float64]

#: How many effects are fitted fully in each round; how many where the screening's scores are this
#: close to the best one's; and how many starts each gets.
FULL_FITS, _MOST_FITS, _AS_NEAR = 4, 7, 0.4
_STARTS = 2
#: An effect whose screening score is below this share of the best one is not worth a full fit.
_WORTH = 0.1
#: Evidence below which nothing is named: 7 to 1, and where the omnibus test sees nothing as much as
#: no base fit of a clean record that is a little off has given. Such a base has missed a resonance,
#: which nothing slow resembles: of what changes from sample to sample (the variance of that over
#: twice its own) by less than `_BRISK`, no clean record has shown more than `UNSEEN_SLOW`.
LEAST, UNSEEN, UNSEEN_SLOW, _BRISK = 2.0, 12.0, 7.0, 0.15
#: Evidence (in units of the log-likelihood) within which the better held-out prediction leads.
MARGIN = 3.0
#: Share of the excess power that an effect must remove to be added, and share of what the best one
#: removes that will do for its rivals.
WORTHWHILE, _NEARLY = 0.25, 0.8
#: Gain in log-likelihood of the held-out samples that a first effect, if these samples can show
#: that, and a further effect, or one that only evidence below `UNSEEN` tells of, must bring.
HELD_OUT, HELD_OUT_FURTHER = 1.0, 4.0
#: Evidence from which on held-out samples that hardly show an effect do not speak against it.
_CLEAR = 8.0
#: A further effect must remove this share of what the first one did: less may be the first one's
#: form, which is not the true one.
OF_FIRST = 0.05


def leading(screening: Screening) -> list[tuple[str, list[Score]]]:
    """Return the effects worth a full fit with their best starts, best first."""
    best = screening.best_by_effect()
    if not best:
        return []
    top = next(iter(best.values())).decrease
    limit = max(screening.threshold, _WORTH * top)
    near = [name for name, score in best.items() if score.decrease >= max(limit, _AS_NEAR * top)]
    count = max(FULL_FITS, min(len(near), _MOST_FITS))
    chosen = [name for name, score in best.items() if score.decrease >= limit][:count]
    return [(name, starts_of(screening, name)) for name in chosen]


def starts_of(screening: Screening, name: str) -> list[Score]:
    """Return the best directions of one effect, from which its fits start.

    Of an effect that has two forms, between which no fit moves, each form gets a start.
    """
    own = [s for s in screening.scores if s.direction.effect.name == name]
    near = [s for s in own if s.decrease >= 0.3 * own[0].decrease]
    starts: list[Score] = []
    for score in near:
        if all(_form(score) != _form(s) for s in starts):
            starts.append(score)
    for score in near:
        known = [s.direction.values for s in starts]
        new = score.direction.values not in known or score.direction.finite
        if new and score not in starts and len(starts) < _STARTS:
            starts.append(score)
    return starts


def _form(score: Score) -> dict[str, float]:
    direction = score.direction
    return {n: v for n, v in direction.values.items() if n not in direction.effect.fitted}


def choose(
    extensions: Sequence[Extension],
    experiments: Sequence[Experiment],
    before: Fit,
    predicted: Sequence[FloatArray],
    colour: Colour,
    first: Extension | None,
    *,
    alarm: bool,
    knowable: float,
) -> list[Extension]:
    """Return the extensions that are worth having, best first.

    Worth having: evidence above `LEAST`, or without the omnibus test's `alarm` above `UNSEEN`, of
    slow effects above `UNSEEN_SLOW` unless a faster one has about as much; the effect in character;
    a share of the training residual's power above the noise removed, or nearly what another one
    removes that does, and more than what is `knowable` [m]; and held-out data predicted better than
    by the model `before`, whose predictions are given. A further cause, beside the `first`, must
    also remove a share of what that one did. The order is that of the evidence; within the margin
    the better prediction leads.
    """
    least = WORTHWHILE * max(0.0, excess_power(before.residuals, colour))
    held = _HeldOut(experiments, predicted, colour)

    brisk = max((e.evidence for e in extensions if not held.slow(e)), default=-np.inf)

    def least_evidence(e: Extension) -> float:
        slow = held.slow(e) and e.evidence > brisk + MARGIN
        return LEAST if alarm else UNSEEN_SLOW if slow else UNSEEN

    def sure(e: Extension) -> bool:
        return first is None and (alarm or e.evidence > UNSEEN)

    fit = [
        e
        for e in extensions
        if e.evidence > least_evidence(e)
        and not out_of_character(e, experiments)
        and e.removed > knowable**2
        and (first is None or e.removed > OF_FIRST * first.removed)
        and held.gained(e) > (held.promised(e) if sure(e) else HELD_OUT_FURTHER)
    ]
    most = max((e.removed for e in fit), default=0.0)
    good = [e for e in fit if most > least and e.removed > min(least, _NEARLY * most)]
    good.sort(key=lambda e: -e.evidence)
    close = [e for e in good if good[0].evidence - e.evidence < MARGIN]
    close.sort(key=lambda e: e.holdout_rms)
    return close + [e for e in good if e not in close]


@dataclass(frozen=True)
class _HeldOut:
    """Held-out samples, what a model predicts there, and the colour of the noise."""

    experiments: Sequence[Experiment]
    predicted: Sequence[FloatArray]
    colour: Colour

    def gained(self, e: Extension) -> float:
        """Log-likelihood that an extension gains there."""
        return self._samples() * float(np.log(self._before / max(e.holdout_rms, 1e-300)))

    def promised(self, e: Extension) -> float:
        """What it must gain: `HELD_OUT`, or less where clear evidence does little to these samples.

        A change of prediction with the sum of squares D promises p = D/2 over the noise's power,
        give or take sqrt(2 p); two such errors less will do.
        """
        if e.evidence < _CLEAR:
            return HELD_OUT
        change = np.concatenate(
            [c[x.held_out] for c, x in zip(self._changes(e), self.experiments, strict=True)]
        )
        share = float(np.mean(change**2)) / e.holdout_rms**2 if change.size else 0.0
        promise = 0.5 * self._samples() * share
        return min(HELD_OUT, promise - 2.0 * float(np.sqrt(2.0 * promise)))

    def slow(self, e: Extension) -> bool:
        """Whether what an extension changes is alike in neighbouring samples.

        Never of records so fast that a stack may ring within their band.
        """
        changes = [c - np.mean(c) for c in self._changes(e)]
        steps = np.concatenate([np.diff(c) for c in changes])
        spread = float(np.mean(np.concatenate(changes) ** 2))
        alike = float(np.mean(steps**2)) < 2.0 * _BRISK * spread
        return alike and not shows_ringing(self.experiments)

    def _changes(self, e: Extension) -> list[FloatArray]:
        """Change of the prediction of every record [m]."""
        return [new - old for new, old in zip(e.predicted, self.predicted, strict=True)]

    @cached_property
    def _before(self) -> float:
        return held_out_rms(self.experiments, self.predicted)

    def _samples(self) -> float:
        return sum(int(e.held_out.sum()) for e in self.experiments) / self.colour.inflation


def out_of_character(extension: Extension, experiments: Sequence[Experiment]) -> bool:
    """Whether the data ask for something that is not this effect.

    A parameter pushed to the end of its range, or a tone among the harmonics of a periodic drive.
    """
    values = extension.fit.model.values
    tone = extension.effect.tone
    if tone is not None and any(among_harmonics(values[tone], e.record) for e in experiments):
        return True
    for p in extension.effect.parameters:
        if not p.fitted or p.name == extension.effect.gain:
            continue
        low, high = p.bounds
        margin = 1e-3 * (high - low) if not p.log else 0.0
        value = values[p.name]
        if p.log and (value < 1.01 * low or value > high / 1.01):
            return True
        if not p.log and (value <= low + margin or value >= high - margin):
            return True
    return False
