"""Trial directions: what each effect would add to the prediction at its trial values."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import numpy.typing as npt

from psa_casadi.component import (
    DISPLACEMENT_PEAKS,
    DISPLACEMENT_STEPS,
    RECORD_DURATION,
    SPECTRAL_PEAKS,
    Component,
)
from psa_casadi.diagnosis.screening.peaks import (
    residual_jumps,
    residual_peaks,
    residual_periods,
)
from psa_casadi.errors import PsaError
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.fitting.further import COLUMNS, Further, measured_in, with_column
from psa_casadi.identification.fitting.prediction import OUTPUT, measured, trace_record
from psa_casadi.model.compose import Model
from psa_casadi.records.drive import tells_tone
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.side_by_side import compiled, side_by_side
from psa_casadi.simulation.simulate import Way
from psa_casadi.simulation.start import memory_names

FloatArray = npt.NDArray[np.float64]

_RTOL = 1e-4  # of derivatives; finite steps are differences and need the fit's own tolerance


@dataclass(frozen=True, eq=False)
class Direction:
    """One effect at one set of trial values.

    `column` (samples,) [m] is the change of the prediction for the gain `unit_gain` (a derivative
    times the gain's scale, or a finite step); `values` are the trial values, `memory` the assumed
    history. `one_sided` says that only positive multiples make sense. `further` are the same
    changes of the further columns, in their units, without what their offsets can follow. `weight`
    names the parameter that moves, of several that an effect is linear in (see `spans`).
    """

    effect: Component
    values: dict[str, float]
    memory: tuple[dict[str, float], ...]
    unit_gain: float
    column: FloatArray
    one_sided: bool
    finite: bool
    further: tuple[FloatArray, ...] = ()
    weight: str = ""


def directions(
    fit: Fit,
    experiments: Sequence[Experiment],
    effects: Sequence[Component],
    *,
    finite_steps: bool = True,
) -> list[Direction]:
    """Return the directions of all effects over their probe values, at the fitted model.

    Without `finite_steps` only derivatives are taken, which some effects have not at their null.
    They are simulated side by side.
    """
    peaks = {SPECTRAL_PEAKS: residual_peaks(fit, experiments)}
    if any(DISPLACEMENT_PEAKS in e.probe.values() for e in effects):
        peaks[DISPLACEMENT_PEAKS] = residual_periods(fit, experiments)
    if any(DISPLACEMENT_STEPS in e.probe.values() for e in effects):
        peaks[DISPLACEMENT_STEPS] = residual_jumps(fit, experiments)
    tasks = [(e, values) for e in effects for values in _probe_values(e, experiments, peaks)]
    composed = {e.name: fit.model.with_effect(e) for e in effects}

    def one(task: tuple[Component, dict[str, float]]) -> list[Direction]:
        effect, values = task
        model = composed[effect.name].with_values(values)
        return list(_directions_at(fit, experiments, effect, model, values, finite_steps))

    # else all cores wait for the first one's model, of which there are several tasks
    compiled(fit.model.with_effect(e) for e in effects)
    return [d for found in side_by_side(one, tasks) for d in found]


def _probe_values(
    effect: Component, experiments: Sequence[Experiment], peaks: Mapping[str, tuple[float, ...]]
) -> Iterator[dict[str, float]]:
    longest = max(e.record.duration for e in experiments)
    grids: list[tuple[float, ...]] = []
    probe = {n: grid for n, grid in effect.probe.items() if n not in effect.linear}
    for name, grid in probe.items():
        if grid == RECORD_DURATION:
            grids.append((longest,))
        elif isinstance(grid, str):
            low, high = next(p.bounds for p in effect.parameters if p.name == name)
            places = [f for f in peaks[grid] if low < f < high]
            if grid == SPECTRAL_PEAKS and effect.belongs_to != "environment":
                first = experiments[0].record  # a resonance answers at the drive's harmonics only
                places = [f for f in places if tells_tone(f, first, hum=False)]
            grids.append(tuple(places))
        else:
            grids.append(grid)
    for point in product(*grids):
        yield dict(zip(probe, point, strict=True))


def _directions_at(
    fit: Fit,
    experiments: Sequence[Experiment],
    effect: Component,
    model: Model,
    values: dict[str, float],
    finite_steps: bool,
) -> Iterator[Direction]:
    gain = effect.gain or ""
    parameter = model.parameter(gain)
    scale = parameter.typical({**model.values, gain: 0.0})
    one_sided = parameter.bounds[0] >= 0
    moved, steps = {gain: scale}, [s * scale for s in effect.finite_step if finite_steps] or [0.0]
    if effect.linear:
        model = model.with_values(effect.at_gain(0.0, {}))
        moved, steps = {n: model.parameter(n).typical(model.values) for n in effect.linear}, [0.0]
        one_sided = False
    for memory in _histories(fit, experiments, effect, model):
        for step in steps:
            trial = _Trial(fit, experiments, model, moved, memory, step)
            try:
                columns, further = trial.columns(), trial.further()
            except PsaError:
                continue
            for k, (name, size) in enumerate(moved.items()):
                column, others = columns[:, k], tuple(f[:, k] for f in further)
                every = np.concatenate([column, *others])
                if not np.all(np.isfinite(every)) or not np.any(every):
                    continue
                if effect.linear:
                    weight, own, unit = name, {**values, name: size}, 1.0
                else:
                    weight, own, unit = "", values, step or size
                yield Direction(
                    effect, own, memory, unit, column, one_sided, bool(step), others, weight
                )


def _histories(
    fit: Fit, experiments: Sequence[Experiment], effect: Component, model: Model
) -> list[tuple[dict[str, float], ...]]:
    """The effect's memories at rest, and for settling ones also as after long cycling."""
    known = fit.starts()
    settling = [s.name for s in effect.states if s.memory and s.settles and s.unit == "m"]
    variants = [tuple(known)]
    if settling:
        cycled = []
        for memory, e in zip(known, experiments, strict=True):
            y = measured(e.record)[e.known]
            cycled.append({**memory, **dict.fromkeys(settling, float(np.mean(y) - y[0]))})
        variants.append(tuple(cycled))
    if effect.trial_starts:
        return [tuple({**k, **trial} for k in known) for trial in effect.trial_starts]
    return variants


@dataclass(frozen=True, eq=False)
class _Trial:
    """Parameters `moved` along their derivatives, by their sizes; or the one by a finite `step`."""

    fit: Fit
    experiments: Sequence[Experiment]
    model: Model
    moved: Mapping[str, float]
    memory: tuple[dict[str, float], ...]
    step: float

    def columns(self) -> FloatArray:
        """Return what each changes in the displacement's used samples (samples, m) [m]."""
        parts = [self._moved(k, OUTPUT) for k in range(len(self.experiments))]
        if self.step:
            left = self.fit.residuals_of(self.experiments)
            for k, (e, residual) in enumerate(zip(self.experiments, left, strict=True)):
                shown = measured(e.record)[: e.stop][e.used[: e.stop]]
                parts[k] = parts[k] + (self.fit.offset(k) - (shown - residual))[:, None]
        return np.concatenate(parts)

    def further(self) -> tuple[FloatArray, ...]:
        """Return what each changes in every further column, beyond offsets and factors."""
        found = []
        for f in self.fit.further:
            records = with_column(self.experiments, f.column)
            left = f.left_of(np.concatenate([self._in_column(f, k) for k in records]))
            found.append(left + f.residuals[:, None] if self.step else left)
        return tuple(found)

    def _in_column(self, f: Further, k: int) -> FloatArray:
        e = self.experiments[k]
        total = -measured_in(e, f.column) if self.step else np.zeros(int(e.used.sum()))
        total = total[:, None]
        for factor, output in zip(f.factors, COLUMNS[f.column].outputs, strict=True):
            total = total + factor * self._moved(k, output)
        return total

    def _moved(self, k: int, output: str) -> FloatArray:
        """Return an output after the step, or its changes along the derivatives (samples, m)."""
        e, step = self.experiments[k], self.step
        if e.held_out_whole:
            return np.zeros((0, len(self.moved)))
        model = self.model.with_values(dict.fromkeys(self.moved, step)) if step else self.model
        start = dict.fromkeys(memory_names(model.structure), 0.0) | self.memory[k]
        rtol = self.fit.way.rtol if step else _RTOL
        found = trace_record(
            model, e.record, start, () if step else tuple(self.moved),
            stop=e.stop, way=Way(rtol, rtol), by_start=False, output=output,
        )  # fmt: skip
        sizes = np.array(list(self.moved.values()))
        moved = found.output[:, None] if step else found.sensitivity * sizes
        return moved[e.used[: e.stop]]
