"""A model with some causes, fitted: what its residual still shows, by which directions.

The score is that of a stack's diagnosis: ln of the Bayes factor over the base, less a price for
every cause (`psa_casadi.diagnosis.search.hypothesis`).
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import numpy.typing as npt

from psa_casadi.any_model.effects.attached import Attached, extended
from psa_casadi.any_model.fit import OdeFit
from psa_casadi.any_model.predict import shown_by, start_of, traced, zero_name
from psa_casadi.any_model.runs import Run
from psa_casadi.component import Component
from psa_casadi.diagnosis.colour import Colour, Omnibus, noise_rms, omnibus
from psa_casadi.diagnosis.held_out import held_out_gain as gained_by
from psa_casadi.diagnosis.probes import Direction
from psa_casadi.diagnosis.screening import screen
from psa_casadi.diagnosis.search.hypothesis import Look, Scale, confirmed
from psa_casadi.diagnosis.task import LIMITS
from psa_casadi.errors import MachineError, PsaError
from psa_casadi.model.compose import Model
from psa_casadi.simulation.side_by_side import side_by_side
from psa_casadi.simulation.stepper import make_ready

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Table:
    """The effects of a search, and the base model that they are attached to."""

    base: Model
    effects: tuple[Attached, ...]

    def attached(self, component: Component) -> Attached:
        """Return an effect with its ports."""
        return next(e for e in self.effects if e.name == component.name)

    def with_effects(self, fit: OdeFit, effects: Sequence[Component]) -> Model:
        """Return the base with effects, with the values that a fit has of them."""
        model = extended(self.base, [self.attached(e) for e in effects])
        known = {n: v for n, v in fit.model.values.items() if n in model.values}
        return model.with_values(known)


def trial_directions(
    fit: OdeFit, runs: Sequence[Run], table: Table, effects: Sequence[Component]
) -> list[Direction]:
    """Return the directions of effects over their trial values, beside those that a fit has."""
    there = fit.model.effects
    models = {e.name: table.with_effects(fit, [*there, e]) for e in effects}
    side_by_side(_compiled, list(models.values()))
    tasks = []
    for e in effects:
        grids = [g for g in e.probe.values() if not isinstance(g, str)]
        tasks += [(e, dict(zip(e.probe, point, strict=True))) for point in product(*grids)]

    def one(task: tuple[Component, dict[str, float]]) -> list[Direction]:
        effect, values = task
        return list(_at(fit, runs, effect, models[effect.name].with_values(values), values))

    return [d for found in side_by_side(one, tasks) for d in found]


def _compiled(model: Model) -> None:
    with suppress(PsaError, MachineError):
        make_ready(model)


def _at(
    fit: OdeFit, runs: Sequence[Run], effect: Component, model: Model, values: dict[str, float]
) -> Iterator[Direction]:
    gain = effect.gain or ""
    parameter = model.parameter(gain)
    scale, one_sided = parameter.typical(model.values), parameter.bounds[0] >= 0
    memory = tuple(fit.starts())
    for step in [s * scale for s in effect.finite_step] or [0.0]:
        try:
            if step:
                columns = _stepped(fit, runs, model.with_values({gain: step}))
            else:
                columns = [c[:, 0] * scale for c in slopes_of(fit, runs, model, [gain])]
        except PsaError:
            continue
        every = np.concatenate(columns)
        if np.all(np.isfinite(every)) and np.any(every):
            yield Direction(
                effect, values, memory, step or scale, columns[0], one_sided, bool(step),
                tuple(columns[1:]),
            )  # fmt: skip


def slopes_of(
    fit: OdeFit, runs: Sequence[Run], model: Model, names: Sequence[str]
) -> list[FloatArray]:
    """Return d prediction / d parameters (n, k) at every output's fitted samples, over its noise.

    The model begins where the fit does. Raises PsaError.
    """
    columns, starts, found = [model.parameter_names.index(n) for n in names], fit.starts(), []
    for o in fit.outputs:
        parts = []
        for k in o.runs:
            run = runs[k]
            begun = start_of(model, run.inputs[0], starts[k])
            s0 = begun.by_parameter[:, columns]
            slopes = traced(model, run, begun.x, [*names], s0, o.column, fit.rtol)[1]
            parts.append(slopes[run.fitted(o.index)[: run.stop]] / run.noise[o.index])
        found.append(np.vstack(parts))
    return found


def _stepped(fit: OdeFit, runs: Sequence[Run], model: Model) -> list[FloatArray]:
    """Return what another model shows in every output's fitted samples more than a fit does.

    Over the noise, from the initial states of the fit. Raises PsaError.
    """
    starts, found = fit.starts(), []
    for o in fit.outputs:
        parts = []
        for k, residual in zip(o.runs, o.parts, strict=True):
            run, j, noise = runs[k], o.index, runs[k].noise[o.index]
            used, zero = run.fitted(j), starts[k].get(zero_name(o.column), 0.0)
            shown = shown_by(model, run, starts[k], run.stop, fit.rtol)[used[: run.stop], j]
            parts.append((shown - (run.outputs[used, j] - zero - residual * noise)) / noise)
        found.append(np.concatenate(parts))
    return found


@dataclass(frozen=True, eq=False)
class OdeHypothesis:
    """A model with causes, fitted; `predicted` (n, ny) are whole experiments.

    `held` and `train` are the rms `Run.errors` of every measured output in held-out and in used
    samples, `final` says that the fit went on to its end.
    """

    causes: tuple[Component, ...]
    fit: OdeFit
    predicted: tuple[FloatArray, ...]
    held: tuple[float, ...]
    train: tuple[float, ...]
    final: bool = False

    @property
    def names(self) -> frozenset[str]:
        """Names of the causes."""
        return frozenset(c.name for c in self.causes)

    @property
    def errors(self) -> tuple[float, ...]:
        """The held-out rms of every output, that of used samples where none is held out."""
        return tuple(held or train for held, train in zip(self.held, self.train, strict=True))


def hypothesis_of(
    causes: Sequence[Component], fit: OdeFit | None, runs: Sequence[Run], *, final: bool = False
) -> OdeHypothesis | None:
    """Return a fit as a hypothesis; None without a fit, or where it cannot predict the records."""
    if fit is None:
        return None
    try:
        predicted = tuple(fit.predicted(runs))
    except PsaError:
        return None
    held = tuple(rms_of(runs, predicted, o.index, Run.judged) for o in fit.outputs)
    train = tuple(rms_of(runs, predicted, o.index, Run.fitted) for o in fit.outputs)
    return OdeHypothesis(tuple(causes), fit, predicted, held, train, final)


def errors_at(
    runs: Sequence[Run],
    predicted: Sequence[FloatArray],
    output: int,
    which: Callable[[Run, int], npt.NDArray[np.bool_]],
) -> FloatArray:
    """Return `Run.errors` of an output, at the chosen samples of all experiments."""
    both = zip(runs, predicted, strict=True)
    return np.concatenate([r.errors(y)[which(r, output), output] for r, y in both])


def rms_of(
    runs: Sequence[Run],
    predicted: Sequence[FloatArray],
    output: int,
    which: Callable[[Run, int], npt.NDArray[np.bool_]],
) -> float:
    """Return the root mean square of `errors_at`, 0 without a sample."""
    errors = errors_at(runs, predicted, output, which)
    return float(np.sqrt(np.mean(errors**2))) if errors.size else 0.0


class OdeView(Look[OdeHypothesis]):
    """What the residual of a hypothesis shows: screening of further effects, and its test."""

    @property
    def shows(self) -> bool:
        """Whether a further effect is above the screening's threshold and could be told.

        Beside a cause the test must alarm too, as in a stack's diagnosis. Errors of every output
        below what can be told of a device show nothing.
        """
        told = any(o.rms > o.straight for o in self.of.fit.outputs)
        seen = told and self.decrease >= self.screening.threshold
        return seen and (self.test.alarm or not self.of.causes)


def look(
    of: OdeHypothesis, runs: Sequence[Run], table: Table, known: Sequence[Direction] = ()
) -> OdeView:
    """Screen the effects that a hypothesis does not hold, and test its residual.

    Directions that are `known` from the base are used again.
    """
    left = [e.component for e in table.effects if e.name not in of.names]
    names = {e.name for e in left}
    kept = [d for d in known if d.effect.name in names]
    trials = kept if known else trial_directions(of.fit, runs, table, left)
    screening = screen(of.fit, trials, of.fit.outputs[0].lengths)
    return OdeView(of, tuple(trials), screening, tested(of, runs, screening.colour))


def tested(of: OdeHypothesis, runs: Sequence[Run], colour: Colour) -> Omnibus:
    """Test the residual of every output along every input; the most telling one counts.

    With Bonferroni's correction for their number.
    """
    rows = []
    for output, own in zip(of.fit.outputs, colour.each, strict=True):
        parts = [runs[k].inputs[runs[k].fitted(output.index)] for k in output.runs]
        moving = [column for column in np.vstack(parts).T if np.ptp(column) > 0]
        for along in moving or [np.zeros(len(output.residuals))]:
            time = np.concatenate([runs[k].time[runs[k].fitted(output.index)] for k in output.runs])
            found = omnibus(
                output.residuals, along, time, own, noise_rms(output.residuals, own),
                knowable=output.straight, even=bool(of.causes), alarms_below=LIMITS.alarm,
            )  # fmt: skip
            rows.append(replace(found, output=output.column if len(of.fit.outputs) > 1 else ""))
    p = min(1.0, len(rows) * min(r.p_value for r in rows))
    worst = min(rows, key=lambda r: (not r.alarm, r.p_value))
    told = worst.p_value * len(rows)
    return replace(worst, p_value=min(1.0, told if worst.alarm else p))


def can_be_told(of: OdeHypothesis, before: OdeHypothesis) -> bool:
    """Whether a hypothesis removes more of some output's error than what cannot be told of it."""
    rows = zip(of.fit.outputs, before.train, of.train, strict=True)
    return any(old**2 - new**2 > o.straight**2 for o, old, new in rows)


def held_out_gain(
    of: OdeHypothesis, before: OdeHypothesis, runs: Sequence[Run], colour: Colour
) -> float:
    """Return what a hypothesis adds to the log-likelihood of held-out samples over another one.

    Summed over the outputs.
    """
    samples = [sum(int(r.judged(o.index).sum()) for r in runs) for o in of.fit.outputs]
    straight = [o.straight for o in of.fit.outputs]
    return gained_by(samples, colour, straight, before.held, of.held)


def held_out_confirms(
    of: OdeHypothesis, before: OdeHypothesis, runs: Sequence[Run], scale: Scale[OdeHypothesis]
) -> bool:
    """Whether held-out samples do not speak against what a hypothesis adds to another one.

    The rule of a stack's diagnosis (`psa_casadi.diagnosis.search.hypothesis.confirmed`), what is
    promised summed over the outputs.
    """
    gained, promise = scale.held_out(of, before), 0.0
    for k, (o, own) in enumerate(zip(of.fit.outputs, scale.colour.each, strict=True)):
        old = errors_at(runs, before.predicted, o.index, Run.judged)
        new = errors_at(runs, of.predicted, o.index, Run.judged)
        if not old.size:
            continue
        after = max(float(np.hypot(of.held[k], o.straight)), 1e-300)
        promise += 0.5 * old.size / own.inflation * float(np.mean((new - old) ** 2)) / after**2
    if promise == 0.0 and gained == 0.0:
        return True
    return confirmed(gained, promise, scale.of_fitted(of) - scale.of_fitted(before), scale.limits)
