"""Trial directions of a model's effects: what each would add to every output."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import numpy.typing as npt

from psa_casadi.any_model.effects.attached import Attached, extended
from psa_casadi.any_model.fit import FittedOutput, OdeFit
from psa_casadi.any_model.predict import start_of, traced, zero_name
from psa_casadi.any_model.runs import Run
from psa_casadi.component import Component
from psa_casadi.diagnosis.probes import Direction
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
    tasks = [(e, values) for e in effects for values in _values(e)]

    def one(task: tuple[Component, dict[str, float]]) -> list[Direction]:
        effect, values = task
        return list(_at(fit, runs, effect, models[effect.name].with_values(values), values))

    return [d for found in side_by_side(one, tasks) for d in found]


def _compiled(model: Model) -> None:
    try:
        make_ready(model)
    except (PsaError, MachineError):
        return


def _values(effect: Component) -> Iterator[dict[str, float]]:
    grids = [g for g in effect.probe.values() if not isinstance(g, str)]
    for point in product(*grids):
        yield dict(zip(effect.probe, point, strict=True))


def _at(
    fit: OdeFit, runs: Sequence[Run], effect: Component, model: Model, values: dict[str, float]
) -> Iterator[Direction]:
    gain = effect.gain or ""
    parameter = model.parameter(gain)
    scale, one_sided = parameter.typical(model.values), parameter.bounds[0] >= 0
    memory = tuple(fit.starts())
    for step in [s * scale for s in effect.finite_step] or [0.0]:
        try:
            columns = _moved(fit, runs, model, gain, step, scale)
        except PsaError:
            continue
        every = np.concatenate(columns)
        if np.all(np.isfinite(every)) and np.any(every):
            yield Direction(
                effect, values, memory, step or scale, columns[0], one_sided, bool(step),
                tuple(columns[1:]),
            )  # fmt: skip


def _moved(
    fit: OdeFit, runs: Sequence[Run], model: Model, gain: str, step: float, scale: float
) -> list[FloatArray]:
    """Return what a gain changes in the fitted samples of every output: its derivative or a step.

    At the initial states of the fit.
    """
    starts, found = fit.starts(), []
    current = model.with_values({gain: step}) if step else model
    column = model.parameter_names.index(gain)
    for o in fit.outputs:
        parts = []
        for k, residual in zip(o.runs, o.parts, strict=True):
            run = runs[k]
            begun = start_of(current, run.inputs[0], starts[k])
            wanted: list[str | int] = [] if step else [gain]
            s0 = begun.by_parameter[:, [column]][:, : len(wanted)]
            shown, slopes = traced(current, run, begun.x, wanted, s0, o.column, fit.rtol)
            used = run.fitted(o.index)
            moved = (shown if step else slopes[:, 0] * scale)[used[: run.stop]]
            if step:
                moved = moved - _shown(o, residual, run, starts[k])
            parts.append(moved / run.noise[o.index])
        found.append(np.concatenate(parts))
    return found


def _shown(
    output: FittedOutput, residual: FloatArray, run: Run, start: Mapping[str, float]
) -> FloatArray:
    """Return a fit's own predictions of an output's used samples, without an unknown zero."""
    j, zero = output.index, start.get(zero_name(output.column), 0.0)
    return np.asarray(run.outputs[run.fitted(j), j] - zero - residual * run.noise[j])
