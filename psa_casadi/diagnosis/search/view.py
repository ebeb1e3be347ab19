"""What a fitted hypothesis still shows: the screening of further effects, the residual's test."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from psa_casadi.component import Component
from psa_casadi.diagnosis.colour import Colour, Omnibus, noise_rms, omnibus, residual_colour
from psa_casadi.diagnosis.noise import knowable_of, known_colour
from psa_casadi.diagnosis.probes import Direction, directions
from psa_casadi.diagnosis.screening import Score, Screening, estimated, screen
from psa_casadi.diagnosis.search.hypothesis import Hypothesis
from psa_casadi.diagnosis.task import Task
from psa_casadi.diagnosis.thresholds import thresholds
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.fitting.further import with_column
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.timings import stage

#: So many starts each effect gets.
_STARTS = 2


@dataclass(frozen=True, eq=False)
class View:
    """What the residual of a hypothesis shows.

    `of` is the hypothesis as it was seen, `trials` the directions of further effects there,
    `screening` their scores with the colour of the noise, `test` the omnibus test.
    """

    of: Hypothesis
    trials: tuple[Direction, ...]
    screening: Screening
    test: Omnibus

    @property
    def decrease(self) -> float:
        """Decrease of the whitened sum of squares along the best direction, over the variance."""
        return max((s.decrease for s in self.screening.scores), default=0.0)

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
        for score in near:
            if all(_form(score) != _form(s) for s in starts):
                starts.append(score)
        for score in sorted(near, key=lambda s: -_differing(s, near[0])):
            known = [s.direction.values for s in starts]
            new = score.direction.values not in known or score.direction.finite
            if new and score not in starts and len(starts) < _STARTS:
                starts.append(score)
        return starts


@stage("screening")
def examine(of: Hypothesis, task: Task, known: Sequence[Direction] = ()) -> View:
    """Screen the effects that a hypothesis does not hold yet, and test its residual.

    Directions that are `known` from the base are used again: what an effect adds hardly changes
    with another effect beside it, and a full fit judges.
    """
    task.progress("screening effects")
    fit, experiments = of.fit, task.experiments
    table = [e for e in task.table if e not in fit.model.components]
    kept = [d for d in known if d.effect in table]
    if known:
        lines = [e for e in table if e.from_residual]  # this residual's peaks are other ones
        kept = [d for d in kept if d.effect not in lines] + _directions(fit, task, lines)
    else:
        kept = _directions(fit, task, table)
    screening = _screened(fit, kept, task)
    voltage = np.concatenate([e.record.voltage[e.used] for e in experiments])
    time = np.concatenate([e.record.time[e.used] for e in experiments])
    test = omnibus(
        fit.residuals,
        voltage,
        time,
        screening.colour,
        noise_rms(fit.residuals, screening.colour),
        knowable=knowable_of(fit, experiments),
        even=bool(of.causes),
    )
    test = _with_further(test, fit, experiments, screening.colour, even=bool(of.causes))
    return View(of, tuple(kept), screening, test)


def _with_further(
    test: Omnibus, fit: Fit, experiments: Sequence[Experiment], colour: Colour, *, even: bool
) -> Omnibus:
    """Return the test of the residual, or that of a further column where only this one alarms."""
    for f, own in zip(fit.further, colour.further, strict=True):
        if test.alarm:
            break
        parts = [experiments[k] for k in with_column(experiments, f.column)]
        voltage, time = (
            np.concatenate([getattr(e.record, name)[e.used] for e in parts])
            for name in ("voltage", "time")
        )
        noise = noise_rms(f.residuals, own)
        found = omnibus(f.residuals, voltage, time, own, noise, knowable=f.straight, even=even)
        p = min(1.0, found.p_value * (1 + len(fit.further)))
        if found.alarm and p < thresholds().alarm:
            size = max(test.size, 2.0 * test.knowable)
            test = replace(found, p_value=p, size=size, knowable=test.knowable, output=f.column)
    return test


def _form(score: Score) -> dict[str, float]:
    direction = score.direction
    return {n: v for n, v in direction.values.items() if n not in direction.effect.fitted}


def _differing(score: Score, other: Score) -> int:
    return sum(v != other.direction.values[n] for n, v in score.direction.values.items())


def _directions(fit: Fit, task: Task, effects: Sequence[Component]) -> list[Direction]:
    finite = "finite steps" not in task.method.without
    return directions(fit, task.experiments, effects, finite_steps=finite)


def _screened(fit: Fit, trials: Sequence[Direction], task: Task) -> Screening:
    lengths = [int(e.used.sum()) for e in task.experiments]
    residuals = fit.residuals_of(task.experiments)
    known = [known_colour(e.record, r) for e, r in zip(task.experiments, residuals, strict=True)]
    if "remainder" in task.method.without:
        return screen(fit, trials, lengths, colour=residual_colour(fit.residuals, lengths))
    return screen(fit, trials, lengths, known)
