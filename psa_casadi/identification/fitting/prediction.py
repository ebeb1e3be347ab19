"""Predictions of a model for a set of experiments, their exact derivatives, and further channels.

Further channels are fitted as outputs: a stack's current, charge and so on. A channel may have an
offset in each record and factors of its outputs, the same in all records; both are linear, so that
they are projected out of the residual instead of being searched (variable projection; Golub and
Pereyra 1973, with the Jacobian of Kaufman 1975).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from psa_casadi.common.notes import Note, note
from psa_casadi.common.units import FloatArray
from psa_casadi.identification.fitting.unknowns import Unknowns
from psa_casadi.model.compose import Model
from psa_casadi.records.record import Record
from psa_casadi.records.split import Channel, Experiment
from psa_casadi.simulation.side_by_side import side_by_side
from psa_casadi.simulation.simulate import Traced, Way, record_inputs, trace
from psa_casadi.simulation.start import (
    initial_slope,
    memory_names,
    settling_time,
    start_for,
    start_state,
)

#: Steps between two samples, and mean ones of a record, beyond which a trial point has failed.
#: Dozens are ordinary: of 74 runs in 19 diagnoses the means were 25 and less, but for two. The mean
#: is meant at this tolerance of a step, and grows as the root of the method's order below.
_STEPS, _MEAN_STEPS, _AT, _ORDER = 2000, 60, 1e-5, 4
OUTPUT = "measured_displacement"


@dataclass(frozen=True)
class Prediction:
    """Predicted first channel (n,) of one record and its derivative (n, size) by theta.

    `further` are the same of the further channels' outputs of the model by name, if they were
    requested. `way` is the name of the integration.
    """

    displacement: FloatArray
    jacobian: FloatArray
    way: str
    further: Mapping[str, tuple[FloatArray, FloatArray]] = field(default_factory=dict)


def predict_record(
    model: Model,
    record: Record,
    start: Mapping[str, float],
    wanted: Sequence[str],
    *,
    stop: int,
    rtol: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the sensor's output (n,), its derivatives by `wanted` (n, k), and by `start` (n, m).

    `start` holds deviations of the initial states from where the first inputs and their rates put
    them, in the states' units. Time counts from the record's first sample. `rtol` is the tolerance
    of a step.
    """
    traced = trace_record(model, record, start, wanted, stop=stop, way=Way(rtol, rtol))
    count, slopes = len(wanted), traced.sensitivity[:, 0]
    return traced.y[:, 0], slopes[:, :count], slopes[:, count:]


def record_start(model: Model, record: Record, start: Mapping[str, float]) -> FloatArray:
    """Return the states (nx,) at a record's first sample; `start` as in `predict_record`."""
    time, u = record.time - record.time[0], record_inputs(model, record, record.n)
    return start_for(model, time, u, start).x


def trace_record(
    model: Model,
    record: Record,
    start: Mapping[str, float],
    wanted: Sequence[str],
    *,
    stop: int,
    way: Way,
    by_start: bool = True,
    outputs: Sequence[str] = (OUTPUT,),
) -> Traced:
    """Return outputs (n, m) and their derivatives by `wanted` and `start` (n, m, k + s).

    By `wanted` (n, m, k) alone without `by_start`.
    """
    t, u = record.time[:stop] - record.time[0], record_inputs(model, record, stop)
    begin = start_for(model, t, u, start)
    s0 = begin.by_parameter[:, [model.parameter_names.index(n) for n in wanted]]
    unknowns: list[str | int] = list(wanted)
    if by_start:
        s0 = np.hstack([s0, begin.by_start])
        unknowns += [model.state_names.index(n) for n in start]
    return trace(
        model,
        t,
        u,
        begin.x,
        way=way,
        outputs=outputs,
        unknowns=unknowns,
        s0=s0,
        hold=record.hold,
        steps_limit=_STEPS,
        steps_most=int(_MEAN_STEPS * max(1.0, _AT / way.step_rtol) ** (1.0 / _ORDER) * stop),
    )


def motions_of(model: Model, record: Record, noise: float) -> dict[str, float]:
    """Return the states, other than memories, whose start a record leaves open, with their size.

    A record starts where its first voltage and rate put the stack. That is wrong for one that
    starts amid motion which changes within the stack's settling time T by more than the noise [m]:
    gain |v(t+T) - 2 v(t) + v(t-T)| > 3 noise. Sizes are what a steady motion at the record's rms
    rate changes, in the states' units. Empty for a record that starts at rest or changes slowly.
    """
    u = record_inputs(model, record, record.n)
    v, column = record.voltage, model.input_names.index("voltage")
    settling = settling_time(model)
    lag = int(min(settling / record.sample_time, record.n))  # an undamped one never settles
    if lag < 2 or 2 * lag >= record.n or initial_slope(record.time, v) == 0.0:
        return {}
    bend = v[2 * lag :] - 2.0 * v[lag:-lag] + v[: -2 * lag]
    rest = start_state(model, list(u[0]))
    rates = np.zeros(u.shape[1])
    rates[column] = float(np.sqrt(np.mean((np.diff(v) / np.diff(record.time)) ** 2)))
    moving = start_state(model, list(u[0]), rates.tolist())
    gain = float(np.nanstd(record.measured)) / max(float(np.std(v)), 1e-300)
    if not gain * float(np.sqrt(np.mean(bend**2))) > 3.0 * noise:
        return {}
    memories = memory_names(model.structure)
    nominal = model.state_nominals()
    return {
        name: max(abs(float(moving.x[i] - rest.x[i])), 1e-6 * float(nominal[i]))
        for i, name in enumerate(model.state_names)
        if name not in memories
    }


def outputs_of(channels: Sequence[Channel]) -> tuple[str, ...]:
    """Return the outputs of the model that channels have, each once, the first one foremost."""
    return tuple(dict.fromkeys(name for c in channels for name in c.outputs))


def predict(
    model: Model,
    experiments: Sequence[Experiment],
    unknowns: Unknowns,
    theta: FloatArray,
    *,
    way: Way,
    everything: bool = False,
    differentiated: bool = True,
    further: bool = False,
) -> list[Prediction]:
    """Predict every experiment at theta, up to its last used sample, or in full (`everything`).

    Records are simulated side by side; `differentiated` or not, in which case the Jacobian has no
    columns. With `further`, the outputs of the further channels as well.
    """
    slopes, current = unknowns.slopes(theta), model.with_values(unknowns.values(theta))
    count = len(unknowns.names)

    def one(index: int) -> Prediction:
        e = experiments[index]
        outputs = outputs_of(e.channels if further else e.channels[:1])
        stop = e.record.n if everything else e.stop
        if not stop:
            none = np.zeros(0), np.zeros((0, unknowns.size))
            return Prediction(*none, "", dict.fromkeys(outputs, none))
        traced = trace_record(
            current, e.record, unknowns.start(theta, index),
            unknowns.names if differentiated else (),
            stop=stop, way=way, by_start=differentiated, outputs=outputs,
        )  # fmt: skip
        sensitivity, by_offset = traced.sensitivity, np.zeros(0)
        if differentiated:
            by_start, by_offset = unknowns.place_slopes(theta, index)
            by_theta = np.vstack([np.zeros((count, unknowns.size)), by_start])
            by_theta[:count, :count] = slopes
            with np.errstate(all="ignore"):  # the fit rejects what is not finite
                flat = sensitivity.reshape(-1, len(by_theta)) @ by_theta  # one product for all
            sensitivity = flat.reshape(*traced.y.shape, unknowns.size)
        table = {n: (traced.y[:, k], sensitivity[:, k]) for k, n in enumerate(outputs)}
        x, jacobian = table[outputs[0]]
        jacobian = jacobian + by_offset
        return Prediction(x + unknowns.offset(theta, index), jacobian, traced.way, table)

    return side_by_side(one, range(len(experiments)))


@dataclass(frozen=True)
class Simulated:
    """How a record was run, and what a finer run differs by (rms of its used samples).

    `errors` are those of the channels without factors, the first one
    foremost, in their units. `way` is "" for a record that is held out whole.
    """

    way: str
    errors: tuple[float, ...]


def simulated(
    model: Model,
    experiments: Sequence[Experiment],
    unknowns: Unknowns,
    theta: FloatArray,
    *,
    way: Way,
) -> list[Simulated]:
    """Return how every record is run, and its error: a finer run has a tenth of the tolerance."""
    current = model.with_values(unknowns.values(theta))

    def one(index: int) -> Simulated:
        e, start = experiments[index], unknowns.start(theta, index)
        if not e.stop:
            return Simulated("", ())
        plain = [k for k, c in enumerate(e.channels) if not c.factors]
        outputs = [e.channels[k].outputs[0] for k in plain]
        rough, finer = (
            trace_record(
                current, e.record, start, (), stop=e.stop, way=w, by_start=False, outputs=outputs
            )
            for w in (way, way.finer)
        )
        gap, at = rough.y - finer.y, [e.at(k)[: e.stop] for k in plain]
        same = rough.way == finer.way
        errors = [
            float(np.sqrt(np.mean(g[samples] ** 2))) if samples.any() else 0.0
            for g, samples in zip(gap.T, at, strict=True)
        ]
        return Simulated(rough.way, tuple(errors) if same else (float("inf"),) * len(plain))

    return side_by_side(one, range(len(experiments)))


@dataclass(frozen=True, eq=False)
class Further:
    """The fit of one channel, in its unit; samples of all records that have it, stacked.

    `residuals` (n,) are measured minus predicted; `jacobian` (n, size) d prediction / d theta, both
    over the records' shares of the noise, and without what offsets and factors can follow: `basis`
    (n, k) is orthonormal. `factors` belong to the outputs, `level` weighted the channel, `spread`
    is its size (`Channel`), `lengths` are the samples of each of the `records`, of which `number`
    is the place among the channels.
    """

    channel: Channel
    number: int
    level: float
    spread: float
    residuals: FloatArray
    jacobian: FloatArray
    basis: FloatArray
    factors: FloatArray
    lengths: tuple[int, ...]
    records: tuple[int, ...]

    @property
    def column(self) -> str:
        """Name of the column."""
        return self.channel.column

    @property
    def parts(self) -> list[FloatArray]:
        """The residuals of each of the `records`."""
        return np.split(self.residuals, np.cumsum(self.lengths)[:-1])

    def left_of(self, change: FloatArray) -> FloatArray:
        """Return what offsets and factors leave of a change of the prediction (n,)."""
        left: FloatArray = change - self.basis @ (self.basis.T @ change)
        return left

    @property
    def straight(self) -> float:
        """Rms error below which nothing is known of the channel, in its unit."""
        return self.channel.straight * self.spread

    def relevelled(self) -> Channel:
        """Return the channel with what the fit leaves as its noise level."""
        return replace(self.channel, level=max(self.rms, self.straight))

    @property
    def notes(self) -> tuple[Note, ...]:
        """What is left of the column, and what is odd about it."""
        unit, share = self.channel.unit, 100.0 * self.rms / max(self.spread, 1e-300)
        named = "" if unit == "1" else f" {unit}"
        left = note("column", column=self.column, rms=self.rms, unit=named, share=share)
        return left, *self.turned

    @property
    def turned(self) -> tuple[Note, ...]:
        """Say so where a column falls while what it shows rises."""
        falls = self.channel.scale is None and self.factors[0] < 0.0
        return (note("turned_column", column=self.column),) if falls else ()

    @property
    def rms(self) -> float:
        """Root mean square of the residuals."""
        return float(np.sqrt(np.mean(self.residuals**2)))


def further_of(
    experiments: Sequence[Experiment], predictions: Sequence[Prediction]
) -> tuple[Further, ...]:
    """Return the fit of every further channel from what a model shows in the records' used samples.

    The predictions hold the further channels' outputs.
    """
    channels = experiments[0].further if experiments else ()
    return tuple(_fitted(k, experiments, predictions) for k, _ in enumerate(channels, 1))


def _fitted(
    number: int, experiments: Sequence[Experiment], predictions: Sequence[Prediction]
) -> Further:
    """Return the fit of one channel; offsets and factors are projected out where it is free."""
    channel = experiments[0].channels[number]
    at = {k: e.at(number) for k, e in enumerate(experiments)}
    records = tuple(k for k, samples in at.items() if samples.any())
    rows = [(k, experiments[k], experiments[k].share(number)) for k in records]
    lengths = tuple(int(np.count_nonzero(at[k])) for k in records)
    target = np.concatenate([e.measured(number)[at[k]] / share for k, e, share in rows])

    def predicted(name: str, part: int) -> FloatArray:
        return np.concatenate(
            [predictions[k].further[name][part][at[k][: e.stop]] / share for k, e, share in rows]
        )

    values = np.column_stack([predicted(name, 0) for name in channel.outputs])
    slopes = [predicted(name, 1) for name in channel.outputs]
    factors, basis = np.ones(1), np.zeros((len(target), 0))
    if channel.offset:
        values, target = _centred(values, lengths), _centred(target, lengths)
        basis = np.zeros((len(target), len(lengths)))
        for k, last in enumerate(np.cumsum(lengths)):
            basis[last - lengths[k] : last, k] = 1.0 / np.sqrt(lengths[k])
    if channel.factors:
        size = np.maximum(np.linalg.norm(values, axis=0), 1e-300)
        factors = np.linalg.lstsq(values / size, target, rcond=1e-10)[0] / size
        u, s, _ = np.linalg.svd(values / size, full_matrices=False)
        basis = np.hstack([basis, u[:, s > 1e-10 * max(float(s[0]), 1e-300)]])
        left = target - basis @ (basis.T @ target)
        spread = float(np.sqrt(np.mean(target**2)))
    else:
        left, spread = target - values[:, 0], span_of(experiments, number)
    moved = sum(f * slope for f, slope in zip(factors, slopes, strict=True))
    moved = moved - basis @ (basis.T @ moved)
    return Further(
        channel=channel, number=number, level=channel.level, spread=spread, residuals=left,
        jacobian=moved, basis=basis, factors=factors, lengths=lengths, records=records,
    )  # fmt: skip


def span_of(experiments: Sequence[Experiment], number: int) -> float:
    """Return the range of a channel's readings over the fitted samples of all records."""
    parts = [e.measured(number)[e.at(number)] for e in experiments]
    return float(np.ptp(np.concatenate(parts))) if any(p.size for p in parts) else 0.0


def scaled(model: Model, furthers: Sequence[Further]) -> tuple[Model, tuple[Further, ...]]:
    """Return a model whose sensors have the fitted scales, and the factors that remain."""
    values, others = {}, []
    for each in furthers:
        name, factors = each.channel.scale, each.factors
        if name is not None and factors[0] != 0.0:
            low, high = model.parameter(name).bounds
            values[name] = float(np.clip(factors[0] * model.values[name], low, high))
            factors = factors * model.values[name] / values[name]
        others.append(replace(each, factors=factors))
    return model.with_values(values), tuple(others)


def predicted_further(
    experiments: Sequence[Experiment], predictions: Sequence[Prediction], fitted: Further
) -> dict[int, FloatArray]:
    """Return a further channel of whole records (n,) as predicted, by the index of the record.

    Factors are those of the fit, offsets those of the known samples. The predictions are those of
    whole records, with the further channels' outputs.
    """
    table = {}
    for k, (e, p) in enumerate(zip(experiments, predictions, strict=True)):
        known = e.at(fitted.number, e.known)
        if not known.any():
            continue
        rows = zip(fitted.factors, fitted.channel.outputs, strict=True)
        total = sum((f * p.further[name][0] for f, name in rows), np.zeros(e.record.n))
        if fitted.channel.offset:
            total = total + np.mean((e.measured(fitted.number) - total)[known])
        table[k] = total
    return table


def _centred(values: FloatArray, lengths: Sequence[int]) -> FloatArray:
    """Return values (n,) or columns less their mean in every record."""
    parts = np.split(values, np.cumsum(lengths)[:-1])
    return np.concatenate([part - np.mean(part, axis=0) for part in parts])
