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
from psa_casadi.errors import PsaError
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.fitting.further import COLUMNS, Further, measured_in, with_column
from psa_casadi.identification.fitting.prediction import measured, trace_record
from psa_casadi.model.compose import Model
from psa_casadi.records.drive import among_harmonics
from psa_casadi.records.quality.filtering import peaks as highest_peaks
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.ahead import compiled
from psa_casadi.simulation.side_by_side import side_by_side
from psa_casadi.simulation.start import memory_names
from psa_casadi.simulation.ways import Way

FloatArray = npt.NDArray[np.float64]

#: Peaks that are tried, and how much finer than 1/duration their frequencies are told.
_PEAKS, _FINER = 4, 8
#: Bins of the displacement; periods between so many of them over the range are tried.
_BINS, _FEWEST_PERIODS, _MOST_PERIODS = 2048, 4, 256
#: A jump is the difference of the means over so many bins on either side.
_SIDE = 64
_RTOL = 1e-4  # of derivatives; finite steps are differences and need the fit's own tolerance


@dataclass(frozen=True, eq=False)
class Direction:
    """One effect at one set of trial values.

    `column` (samples,) [m] is the change of the prediction for the gain `unit_gain` (a derivative
    times the gain's scale, or a finite step); `values` are the trial values, `memory` the assumed
    history. `one_sided` says that only positive multiples make sense. `further` are the same
    changes of the further columns, in their units, without what their offsets can follow.
    """

    effect: Component
    values: dict[str, float]
    memory: tuple[dict[str, float], ...]
    unit_gain: float
    column: FloatArray
    one_sided: bool
    finite: bool
    further: tuple[FloatArray, ...] = ()


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

    def one(task: tuple[Component, dict[str, float]]) -> list[Direction]:
        return list(_directions_at(fit, experiments, *task, finite_steps))

    # else all cores wait for the first one's model, of which there are several tasks
    compiled(fit.model.with_effect(e) for e in effects)
    return [d for found in side_by_side(one, tasks) for d in found]


def residual_peaks(fit: Fit, experiments: Sequence[Experiment]) -> tuple[float, ...]:
    """Frequencies [Hz] of the highest peaks in the spectrum of the first record's residual.

    Samples that do not count are 0, so that a line keeps its phase across them. The range of a
    periodic drive's harmonics is left out: it may be distortion.
    """
    experiment = experiments[0]
    count = experiment.stop
    used = experiment.used[:count]
    residual = np.zeros(count)
    residual[used] = fit.residuals[: int(used.sum())]
    residual[used] -= np.mean(residual[used])
    power = np.abs(np.fft.rfft(residual * np.hanning(count), _FINER * count)) ** 2
    frequency = np.fft.rfftfreq(_FINER * count, experiment.record.sample_time)
    lowest, apart = _FINER * max(8, count // 200), _FINER * max(3, count // 200)
    order = highest_peaks(power[lowest:], apart, 5 * _PEAKS) + lowest
    tones = [k for k in order if not among_harmonics(frequency[k], experiment.record)]
    strongest = np.array(tones[:_PEAKS], dtype=int)
    return tuple(float(f) for f in np.sort(frequency[strongest])) or (
        0.1 / experiment.record.sample_time,
    )


def residual_periods(fit: Fit, experiments: Sequence[Experiment]) -> tuple[float, ...]:
    """Periods [m] with which the residual of the largest record repeats over the displacement.

    Of the mean residual in bins of the predicted displacement, under a Hann window.
    """
    _, span, count, total = _binned(fit, experiments)
    if span <= 0.0:
        return ()
    mean = total / np.maximum(count, 1)
    power = np.abs(np.fft.rfft(mean * np.hanning(_BINS), _FINER * _BINS)) ** 2
    first = _FINER * _FEWEST_PERIODS
    order = highest_peaks(power[first : _FINER * _MOST_PERIODS], 3 * _FINER, _PEAKS) + first
    return tuple(float(p) for p in np.sort(span * _FINER / order))


def residual_jumps(fit: Fit, experiments: Sequence[Experiment]) -> tuple[float, ...]:
    """Places [m] at which the residual of the largest record jumps over the displacement.

    Where the difference of its means on either side is largest over what equal noise would make of
    it; places are displacements of the model, without the record's offset.
    """
    low, span, count, total = _binned(fit, experiments)
    if span <= 0.0:
        return ()
    below, sums = (np.append(0.0, np.cumsum(q)) for q in (count, total))
    edges = np.arange(_SIDE, _BINS - _SIDE + 1)
    left, right = (below[edges + k] - below[edges + k - _SIDE] for k in (0, _SIDE))
    before, after = (sums[edges + k] - sums[edges + k - _SIDE] for k in (0, _SIDE))
    seen = np.minimum(left, right) > 0
    jump = after / np.maximum(right, 1) - before / np.maximum(left, 1)
    power = np.where(seen, jump**2 * left * right / np.maximum(left + right, 1), 0.0)
    places = edges[highest_peaks(power, _SIDE, _PEAKS)]
    found = low + span * np.sort(places) / _BINS
    return tuple(float(x) for x in found)


def _binned(
    fit: Fit, experiments: Sequence[Experiment]
) -> tuple[float, float, FloatArray, FloatArray]:
    """Return lowest displacement and range [m]; samples and sum of the residual in bins of it.

    Of the record whose displacement, as the model has it, goes furthest; the residual is about its
    mean.
    """
    parts = []
    for k, (e, residual) in enumerate(zip(experiments, fit.residuals_of(experiments), strict=True)):
        shown = measured(e.record)[: e.stop][e.used[: e.stop]]
        parts.append((shown - residual - fit.offset(k), residual))
    x, residual = max(parts, key=lambda part: float(np.ptp(part[0])))
    low, span = float(x.min()), float(np.ptp(x))
    places = (_BINS * (x - low) / max(span, 1e-300)).astype(np.int64)
    places = np.minimum(places, _BINS - 1)
    count = np.bincount(places, minlength=_BINS).astype(float)
    total = np.bincount(places, residual - np.mean(residual), _BINS).astype(float)
    return low, span, count, total


def _probe_values(
    effect: Component, experiments: Sequence[Experiment], peaks: Mapping[str, tuple[float, ...]]
) -> Iterator[dict[str, float]]:
    longest = max(e.record.duration for e in experiments)
    grids: list[tuple[float, ...]] = []
    for name, grid in effect.probe.items():
        if grid == RECORD_DURATION:
            grids.append((longest,))
        elif isinstance(grid, str):
            low, high = next(p.bounds for p in effect.parameters if p.name == name)
            grids.append(tuple(f for f in peaks[grid] if low < f < high))
        else:
            grids.append(grid)
    for point in product(*grids):
        yield dict(zip(effect.probe, point, strict=True))


def _directions_at(
    fit: Fit,
    experiments: Sequence[Experiment],
    effect: Component,
    values: dict[str, float],
    finite_steps: bool,
) -> Iterator[Direction]:
    model = fit.model.with_effect(effect, values)
    gain = effect.gain or ""
    parameter = model.parameter(gain)
    scale = parameter.typical({**model.values, gain: 0.0})
    one_sided = parameter.bounds[0] >= 0
    for memory in _histories(fit, experiments, effect, model):
        steps = [s * scale for s in effect.finite_step if finite_steps] or [0.0]
        for step in steps:
            try:
                column = _column(fit, experiments, model, gain, memory, step, scale)
                further = _beside(fit, experiments, model, gain, memory, step, scale)
            except PsaError:
                continue
            every = np.concatenate([column, *further])
            if np.all(np.isfinite(every)) and np.any(every):
                yield Direction(
                    effect, values, memory, step or scale, column, one_sided, bool(step), further
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
            y = measured(e.record)[e.used]
            cycled.append({**memory, **dict.fromkeys(settling, float(np.mean(y) - y[0]))})
        variants.append(tuple(cycled))
    if effect.trial_starts:
        return [tuple({**k, **trial} for k in known) for trial in effect.trial_starts]
    return variants


def _column(
    fit: Fit,
    experiments: Sequence[Experiment],
    model: Model,
    gain: str,
    memory: tuple[dict[str, float], ...],
    step: float,
    scale: float,
) -> FloatArray:
    changed = model.with_values({gain: step}) if step else model
    names = memory_names(model.structure)
    parts: list[FloatArray] = []
    first = 0
    for e, start in zip(experiments, memory, strict=True):
        states = dict.fromkeys(names, 0.0) | start
        rtol = fit.way.rtol if step else _RTOL
        found = trace_record(
            changed, e.record, states, () if step else (gain,),
            stop=e.stop, way=Way(rtol, rtol), by_start=False,
        )  # fmt: skip
        used = e.used[: e.stop]
        count = int(used.sum())
        if step:
            index = len(parts)
            prediction = measured(e.record)[: e.stop][used] - fit.residuals[first : first + count]
            parts.append(found.output[used] + fit.offset(index) - prediction)
        else:
            parts.append(found.sensitivity[used, 0] * scale)
        first += count
    return np.concatenate(parts)


def _beside(
    fit: Fit,
    experiments: Sequence[Experiment],
    model: Model,
    gain: str,
    memory: tuple[dict[str, float], ...],
    step: float,
    scale: float,
) -> tuple[FloatArray, ...]:
    """Return what an effect changes in every further column, beyond offsets and factors."""
    changed = model.with_values({gain: step}) if step else model
    names = memory_names(model.structure)
    rtol = fit.way.rtol if step else _RTOL

    def change(f: Further, k: int) -> FloatArray:
        e, states = experiments[k], dict.fromkeys(names, 0.0) | memory[k]
        total = -measured_in(e, f.column) if step else np.zeros(int(e.used.sum()))
        for factor, output in zip(f.factors, COLUMNS[f.column].outputs, strict=True):
            found = trace_record(
                changed, e.record, states, () if step else (gain,),
                stop=e.stop, way=Way(rtol, rtol), by_start=False, output=output,
            )  # fmt: skip
            moved = found.output if step else found.sensitivity[:, 0] * scale
            total = total + factor * moved[e.used[: e.stop]]
        return total

    found = []
    for f in fit.further:
        each = [change(f, k) for k in with_column(experiments, f.column)]
        left = f.left_of(np.concatenate(each))
        found.append(left + f.residuals if step else left)
    return tuple(found)
