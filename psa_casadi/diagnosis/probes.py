"""Trial directions: what each effect would add to the prediction at its trial values.

There is one direction for each weight, at its ordinary size. With the whitened directions W over
the noise level, the residual r over it, and weights g with the prior N(0, s^2 I), s =
`LINEAR_PRIOR` (Bayesian linear regression),

    g = (W'W + I/s^2)^-1 W'r,    D = r'W g,

D the decrease of the sum of squares, that of the prior included. Noise alone makes D nearly a
chi-square variable of as many degrees of freedom as (W'W + I/s^2)^-1 W'W has trace.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
import scipy

from psa_casadi.common.errors import PsaError
from psa_casadi.common.units import FloatArray
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.fitting.prediction import outputs_of, trace_record
from psa_casadi.identification.fitting.unknowns import LINEAR_PRIOR
from psa_casadi.model.component import (
    DISPLACEMENT_PEAKS,
    DISPLACEMENT_STEPS,
    RECORD_DURATION,
    SPECTRAL_PEAKS,
    Component,
)
from psa_casadi.model.compose import Model
from psa_casadi.records.drive import is_tone_separable
from psa_casadi.records.noise import peaks as highest_peaks
from psa_casadi.records.record import Record
from psa_casadi.records.split import Experiment
from psa_casadi.simulation import tangent
from psa_casadi.simulation.exact.run import NotExact, time_steps
from psa_casadi.simulation.side_by_side import compiled, side_by_side
from psa_casadi.simulation.simulate import Way, record_inputs
from psa_casadi.simulation.start import is_stack, memory_names

#: Peaks that are tried, and how much finer than 1/duration their frequencies are resolved.
_PEAKS, _FINER = 4, 8
#: Bins of the displacement; fewest and most periods over the range that are tried.
_BINS, _FEWEST_PERIODS, _MOST_PERIODS = 2048, 4, 256
#: Number of bins on either side whose means differ by a jump.
_SIDE = 64


def residual_peaks(fit: Fit) -> tuple[float, ...]:
    """Frequencies [Hz] of the highest peaks in the spectrum of the first record's residual.

    Samples that do not count are 0, so that a line keeps its phase across them. The range of a
    periodic drive's harmonics is left out, since it may be distortion, but for the mains.
    """
    first = fit.experiments[0]
    record, count, used = first.record, first.stop, first.used[: first.stop]
    residual = np.zeros(count)
    residual[used] = fit.residuals[: int(used.sum())]
    residual[used] -= np.mean(residual[used])
    power = np.abs(np.fft.rfft(residual * np.hanning(count), _FINER * count)) ** 2
    frequency = np.fft.rfftfreq(_FINER * count, record.sample_time)
    lowest, apart = _FINER * max(8, count // 200), _FINER * max(3, count // 200)
    order = highest_peaks(power[lowest:], apart, 5 * _PEAKS) + lowest
    tones = [k for k in order if is_tone_separable(frequency[k], record, hum=True)]
    strongest = np.sort(frequency[np.array(tones[:_PEAKS], dtype=int)])
    return tuple(strongest.tolist()) or (0.1 / record.sample_time,)


def residual_periods(fit: Fit) -> tuple[float, ...]:
    """Periods [m] with which the residual of the largest record repeats over the displacement.

    Of the mean residual in bins of the predicted displacement, under a Hann window.
    """
    _, span, count, total = _binned(fit)
    if span <= 0.0:
        return ()
    mean = total / np.maximum(count, 1)
    power = np.abs(np.fft.rfft(mean * np.hanning(_BINS), _FINER * _BINS)) ** 2
    first = _FINER * _FEWEST_PERIODS
    order = highest_peaks(power[first : _FINER * _MOST_PERIODS], 3 * _FINER, _PEAKS) + first
    return tuple(np.sort(span * _FINER / order).tolist())


def residual_jumps(fit: Fit) -> tuple[float, ...]:
    """Places [m] at which the residual of the largest record jumps over the displacement.

    Where the difference of its means on either side is largest over what equal noise would make of
    it; places are displacements of the model, without the record's offset.
    """
    low, span, count, total = _binned(fit)
    if span <= 0.0:
        return ()
    below, sums = (np.append(0.0, np.cumsum(q)) for q in (count, total))
    edges = np.arange(_SIDE, _BINS - _SIDE + 1)
    left, right = (below[edges + k] - below[edges + k - _SIDE] for k in (0, _SIDE))
    before, after = (sums[edges + k] - sums[edges + k - _SIDE] for k in (0, _SIDE))
    both = np.minimum(left, right) > 0
    jump = after / np.maximum(right, 1) - before / np.maximum(left, 1)
    power = np.where(both, jump**2 * left * right / np.maximum(left + right, 1), 0.0)
    places = edges[highest_peaks(power, _SIDE, _PEAKS)]
    return tuple((low + span * np.sort(places) / _BINS).tolist())


def _binned(fit: Fit) -> tuple[float, float, FloatArray, FloatArray]:
    """Return lowest displacement and range [m]; samples and sum of the residual in bins of it.

    Of the record whose displacement, as the model has it, goes furthest; the residual is about its
    mean.
    """
    parts = []
    for k, (e, residual) in enumerate(zip(fit.experiments, fit.record_residuals, strict=True)):
        if e.held_out_whole:
            continue
        reading = e.record.measured[: e.stop][e.used[: e.stop]]
        parts.append((reading - residual - fit.offset(k), residual))
    x, residual = max(parts, key=lambda part: float(np.ptp(part[0])))
    low, span = float(x.min()), float(np.ptp(x))
    places = (_BINS * (x - low) / max(span, 1e-300)).astype(np.int64)
    places = np.minimum(places, _BINS - 1)
    count = np.bincount(places, minlength=_BINS).astype(float)
    total = np.bincount(places, residual - np.mean(residual), _BINS).astype(float)
    return low, span, count, total


#: What is read off the residual, by the name that a probe has for it.
_FROM_RESIDUAL = {
    SPECTRAL_PEAKS: residual_peaks,
    DISPLACEMENT_PEAKS: residual_periods,
    DISPLACEMENT_STEPS: residual_jumps,
}
_RTOL = 1e-4  # of derivatives; finite steps are differences and need the fit's tolerance
#: Smallest ratio of what the fitted parameters leave of a column along the course of a fit to what
#: it may err by; below it the effect is simulated.
_CLEAR = 3.0
#: A tangent that may err by this share of its size is no tangent.
_ROUGH = 0.05
#: A difference below this share of the readings is rounding, which looks like the residual's.
_ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class Direction:
    """One effect at one set of trial values.

    `columns` (samples,) are the changes of the prediction of every channel for the gain `unit_gain`
    (a derivative times the gain's scale, or a finite step), in the channel's unit, without what its
    offsets can follow; `values` are the trial values, `memory` the assumed history. `one_sided`:
    only positive multiples make sense. `weight` names the parameter that moves, of several that an
    effect is linear in (see `spans`).
    """

    effect: Component
    values: dict[str, float]
    memory: tuple[dict[str, float], ...]
    unit_gain: float
    columns: tuple[FloatArray, ...]
    one_sided: bool
    finite: bool
    weight: str = ""


def directions(
    fit: Fit, effects: Sequence[Component], *, finite_steps: bool = True
) -> list[Direction]:
    """Return the directions of all effects over their probe values, at the fitted model.

    Without `finite_steps` only derivatives are taken, which some effects have not at their null.
    They are simulated side by side.
    """
    grids = [grid for e in effects for grid in e.probe.values()]
    peaks = {n: of(fit) for n, of in _FROM_RESIDUAL.items() if n in grids}
    tasks = [(e, values) for e in effects for values in _probe_values(e, fit.experiments, peaks)]
    composed = {e.name: fit.model.with_effect(e) for e in effects}
    # else all cores wait for the first one's model, of which there are several tasks
    fitted = [e.record for e in fit.experiments if e.stop]
    laws = laws_of(fit.model, fitted, effects, finite_steps=finite_steps)
    compiled(screened_with(fit.model, effects, laws))
    others = _Beside(fit, laws)

    def one(task: tuple[Component, dict[str, float]]) -> list[Direction]:
        effect, values = task
        model = composed[effect.name].with_values(values)
        return list(_directions_at(fit, effect, model, values, finite_steps, others))

    return [d for result in side_by_side(one, tasks) for d in result]


def tangents(fit: Fit, effects: Sequence[Component]) -> dict[str, tuple[FloatArray, ...]]:
    """Return what each of many effects without states changes, for its gain's ordinary size.

    In the fitted samples (samples,) of every channel. All at once in one model, or along the fit's
    course, where they have laws; without those that may err by more than `_ROUGH`.
    """
    laws = laws_of(fit.model, [e.record for e in fit.experiments if e.stop], effects)
    model = fit.model.with_components((*fit.model.components, *effects))
    gains = [e.gain or "" for e in effects]
    sizes = {n: model.parameter(n).typical(model.values) for n in gains}
    memory = tuple(fit.starts())
    if len(laws) < len(effects):
        columns, _ = changes(fit, model, sizes, memory, 0.0)
        return {e.name: tuple(c[:, k] for c in columns) for k, e in enumerate(effects)}
    others, table = _Beside(fit, laws), {}
    for e, gain in zip(effects, gains, strict=True):
        model, moved = fit.model.with_effect(e), {gain: sizes[gain]}
        columns, error = changes(fit, model, moved, memory, 0.0, others)
        if error < _ROUGH:
            table[e.name] = tuple(c[:, 0] for c in columns)
    return table


def laws_of(
    model: Model,
    records: Sequence[Record],
    effects: Sequence[Component],
    *,
    finite_steps: bool = True,
) -> dict[str, tangent.Law]:
    """Return the laws of the effects that are not simulated in full, by name.

    Of records on even times with straight lines between the samples alone; of effects that are
    looked for with finite gains those that read nothing of what they move.
    """
    table = {}
    with suppress(NotExact):
        for r in records:
            time_steps(r.time)
        for e in effects if all(r.hold == "linear" for r in records) else ():
            law = tangent.law_of(model.with_effect(e).structure, e)
            steps = finite_steps and any(e.finite_step)
            if law is not None and (law.forward or not steps):
                table[e.name] = law
    return table


def screened_with(
    model: Model, effects: Sequence[Component], laws: Mapping[str, tangent.Law]
) -> list[Model]:
    """Return the models that a screening simulates, besides the one that it is of."""
    added = tangent.opened(model, laws.values())
    whole = [model.with_effect(e) for e in effects if e.name not in laws]
    return [added, *whole] if added is not model else whole


class _Beside:
    """What effects add along the course of a fit, those of the `laws` without a model of theirs."""

    def __init__(self, fit: Fit, laws: Mapping[str, tangent.Law]) -> None:
        experiments = fit.experiments
        self.laws, self.opened = laws, tangent.opened(fit.model, laws.values())
        self.outputs, starts = outputs_of(experiments[0].channels), fit.starts()
        jacobian = fit.jacobian / np.maximum(np.linalg.norm(fit.jacobian, axis=0), 1e-300)
        self.fitted = np.linalg.qr(jacobian)[0]

        def course(k: int) -> tangent.Course | None:
            e = experiments[k]
            if not e.stop or not laws:
                return None
            t, u = e.record.time[: e.stop], record_inputs(fit.model, e.record, e.stop)
            return tangent.course_of(
                fit.model, t - t[0], u, starts[k],
                way=fit.way, hold=e.record.hold, outputs=self.outputs,
            )  # fmt: skip

        self.courses = side_by_side(course, range(len(experiments)))

    def answer(
        self, model: Model, e: Experiment, k: int, memory: Mapping[str, float], way: Way,
        *, finite: bool,
    ) -> tangent.Answer:  # fmt: skip
        """Return what the last effect of a model makes of one record's outputs."""
        course = self.courses[k]
        if course is None:
            raise ValueError("a record that is held out whole has no course")
        law = self.laws[model.components[-1].name]
        return tangent.answer(
            self.opened, law, model, course, record_inputs(model, e.record, e.stop), memory,
            finite=finite, way=way, outputs=self.outputs,
        )  # fmt: skip

    def is_clear(self, columns: FloatArray, error: float) -> bool:
        """Whether what the fitted parameters leave of every column is clear of its error."""
        left = columns - self.fitted @ (self.fitted.T @ columns)
        sizes = np.linalg.norm(left, axis=0) - _CLEAR * error * np.linalg.norm(columns, axis=0)
        return bool(np.all(sizes >= 0.0))


def _probe_values(
    effect: Component, experiments: Sequence[Experiment], peaks: Mapping[str, tuple[float, ...]]
) -> Iterator[dict[str, float]]:
    grids: list[tuple[float, ...]] = []
    probe = {n: grid for n, grid in effect.probe.items() if n not in effect.linear}
    for name, grid in probe.items():
        if grid == RECORD_DURATION:
            grids.append((max(e.record.duration for e in experiments),))
        elif isinstance(grid, str):
            low, high = next(p.bounds for p in effect.parameters if p.name == name)
            places = tuple(f for f in peaks[grid] if low < f < high)
            if grid == SPECTRAL_PEAKS and effect.belongs_to != "environment":
                first = experiments[0].record  # a resonance answers at the drive's harmonics only
                places = tuple(f for f in places if is_tone_separable(f, first, hum=False))
            grids.append(places)
        else:
            grids.append(grid)
    for point in product(*grids):
        yield dict(zip(probe, point, strict=True))


def _directions_at(
    fit: Fit,
    effect: Component,
    model: Model,
    values: dict[str, float],
    finite_steps: bool,
    alongside: _Beside,
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
    for memory in _histories(fit, effect, model):
        for step in steps:
            try:
                arguments, clear = (fit, model, moved, memory, step), False
                if effect.name in alongside.laws:
                    columns, error = changes(*arguments, alongside)
                    clear = alongside.is_clear(columns[0], error)
                if not clear:
                    columns, _ = changes(*arguments)
            except PsaError:
                continue
            for k, (name, size) in enumerate(moved.items()):
                each = tuple(c[:, k] for c in columns)
                every = np.concatenate(each)
                if not np.all(np.isfinite(every)) or not np.any(every):
                    continue
                weight, unit = (name, 1.0) if effect.linear else ("", step or size)
                trial = {**values, name: size} if effect.linear else values
                yield Direction(effect, trial, memory, unit, each, one_sided, bool(step), weight)


def _histories(fit: Fit, effect: Component, model: Model) -> list[tuple[dict[str, float], ...]]:
    """The effect's memories at rest, and for settling ones also as after long cycling."""
    known = fit.starts()
    if effect.trial_starts:
        return [tuple({**k, **trial} for k in known) for trial in effect.trial_starts]
    settling = [s.name for s in effect.states if s.memory and s.settles and s.unit == "m"]
    if not settling or not is_stack(model):
        return [tuple(known)]
    cycled = []
    for memory, e in zip(known, fit.experiments, strict=True):
        y = e.record.measured[e.known]
        cycled.append({**memory, **dict.fromkeys(settling, float(np.mean(y) - y[0]))})
    return [tuple(known), tuple(cycled)]


def changes(
    fit: Fit,
    model: Model,
    moved: Mapping[str, float],
    memory: tuple[dict[str, float], ...],
    step: float,
    others: _Beside | None = None,
) -> tuple[tuple[FloatArray, ...], float]:
    """Return what parameters change in every channel's fitted samples (samples, m).

    In its unit, over the records' shares of the noise, beyond offsets and factors. They are `moved`
    along their derivatives, by their sizes, or the one by a finite `step`. With it comes the share
    that they may err by, where `others` has the effect's law.
    """
    stepped = model.with_values(dict.fromkeys(moved, step)) if step else model
    experiments, rtol = fit.experiments, fit.way.rtol if step else _RTOL
    rest, sizes = dict.fromkeys(memory_names(stepped.structure), 0.0), np.array([*moved.values()])

    def changed(k: int) -> tangent.Answer:
        """Return outputs after the step, or their changes along the derivatives (n, outputs, m)."""
        e, way = experiments[k], Way(rtol, rtol)
        if not e.stop:
            return tangent.Answer(np.zeros((0, len(outputs), len(moved))), 0.0)
        if others is not None:
            tangent_change = others.answer(stepped, e, k, rest | memory[k], way, finite=bool(step))
            return tangent_change if step else replace(tangent_change, y=tangent_change.y * sizes)
        traced = trace_record(
            stepped, e.record, rest | memory[k], () if step else tuple(moved),
            stop=e.stop, way=way, by_start=False, outputs=outputs,
        )  # fmt: skip
        return tangent.Answer(traced.y[:, :, None] if step else traced.sensitivity * sizes, 0.0)

    outputs = outputs_of(experiments[0].channels)
    every, columns = [changed(k) for k in range(len(experiments))], []
    for f in fit.channels:
        parts = []
        for k, residual in zip(f.records, f.parts, strict=True):
            e, at = experiments[k], experiments[k].at(f.number)
            rows = zip(f.factors, f.channel.outputs, strict=True)
            total = sum(
                factor * every[k].y[at[: e.stop], outputs.index(name)] for factor, name in rows
            )
            if step:  # the output beyond that of the fit
                offset = 0.0 if f.number else fit.offset(k)
                readings = e.measured(f.number)[at]
                total = total + (offset - readings)[:, None]
                beyond = total / e.share(f.number) + residual[:, None]
                least = _ROUNDING * float(np.max(np.abs(readings))) / e.share(f.number)
                parts.append(beyond if np.max(np.abs(beyond)) > least else np.zeros_like(beyond))
            else:
                parts.append(total / e.share(f.number))
        columns.append(f.left_of(np.concatenate(parts)))
    return tuple(columns), max(a.error for a in every)


def spans(trials: Sequence[Direction]) -> list[list[int]]:
    """Return the places of directions that belong together: those of a span, or single ones."""
    table: dict[object, list[int]] = {}
    for k, d in enumerate(trials):
        others = tuple(v for n, v in d.values.items() if n not in d.effect.linear)
        table.setdefault((d.effect.name, others) if d.weight else k, []).append(k)
    return list(table.values())


def combined(directions: Sequence[Direction], gains: FloatArray) -> Direction:
    """Return the direction along which all weights of a span move at once by their gains (m,)."""
    first = directions[0]
    values = {**first.values, **dict.fromkeys(first.effect.linear, 0.0)}
    for d, gain in zip(directions, gains, strict=True):
        values[d.weight] = float(gain) * d.values[d.weight]
    every = zip(*(d.columns for d in directions), strict=True)
    columns = tuple(np.column_stack(each) @ gains for each in every)
    return Direction(
        first.effect, values, first.memory, 1.0, columns, one_sided=False, finite=False
    )


def declared(directions: Sequence[Direction]) -> FloatArray:
    """Return the gains (m,) of a span's directions at the effect's declared weights."""
    table = {p.name: p.value for p in directions[0].effect.parameters}
    return np.array([table[d.weight] / d.values[d.weight] for d in directions])


@dataclass(frozen=True, eq=False)
class Span:
    """Directions of a span: the `gram` (m, m) of their unit vectors, their `norms` over the noise.

    `false_alarm` is the chance that noise makes a direction significant.

    Residuals come as projections t (..., m) on the unit vectors, over the noise level.
    """

    gram: FloatArray
    norms: FloatArray
    false_alarm: float

    @cached_property
    def information(self) -> FloatArray:
        """W'W (m, m)."""
        return self.norms[:, None] * self.gram * self.norms

    @cached_property
    def covariance(self) -> FloatArray:
        """That of the weights (m, m), with their prior."""
        weighted = self.information + np.eye(len(self.norms)) / LINEAR_PRIOR**2
        return np.linalg.inv(weighted).astype(np.float64)

    def gains(self, t: FloatArray) -> FloatArray:
        """Return the weights (..., m), in ordinary sizes, that fit best."""
        return (t * self.norms) @ self.covariance

    def decrease(self, t: FloatArray) -> FloatArray:
        """Return D (...), less what noise makes of more weights than one, at least 0.

        Compared with the threshold for single directions, noise passes it as rarely.
        """
        removed = np.sum(self.gains(t) * t * self.norms, axis=-1)
        values: FloatArray = np.maximum(removed - self.surplus, 0.0).astype(np.float64)
        return values

    @cached_property
    def surplus(self) -> float:
        """What a chi-square that is passed as rarely as a false alarm is above that of one."""
        freedom = max(float(np.sum(self.covariance * self.information)), 1.0)
        halves = np.array([0.5 * freedom, 0.5])
        largest, of_one = 2.0 * scipy.special.gammainccinv(halves, self.false_alarm)
        return float(largest - of_one)

    @cached_property
    def penalties(self) -> FloatArray:
        """What the evidence loses by each combination of the weights (m,), rising."""
        values = np.linalg.eigvalsh(self.information)
        result: FloatArray = 0.5 * np.log1p(LINEAR_PRIOR**2 * np.maximum(values, 0.0))
        return result

    def detectable(self, gains: FloatArray) -> float:
        """Return the multiple of these weights (m,) that is as large as the noise."""
        power = float(gains @ self.information @ gains)
        return 1.0 / math.sqrt(power) if power > 0.0 else math.inf
