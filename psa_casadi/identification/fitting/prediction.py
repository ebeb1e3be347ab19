"""Predictions of a model for a set of experiments, and their exact derivatives."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from psa_casadi.errors import InputError
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
from psa_casadi.units import FloatArray

#: Steps between two samples, and mean ones of a record, beyond which a trial point has failed.
#: Dozens are ordinary: of 74 runs in 19 diagnoses the means were 25 and less, but for two. The mean
#: is meant at this tolerance of a step, and grows as the root of the method's order below.
_STEPS, _MEAN_STEPS, _AT, _ORDER = 2000, 60, 1e-5, 4
OUTPUT = "measured_displacement"


@dataclass(frozen=True)
class Prediction:
    """Predicted first channel (n,) of one record and its derivative (n, size) by theta.

    `further` are the same of the further channels' outputs by name, where they were asked for, as
    the model shows them. `way` tells how the record was integrated.
    """

    displacement: FloatArray
    jacobian: FloatArray
    way: str
    further: Mapping[str, tuple[FloatArray, FloatArray]] = field(default_factory=dict)


def measured(record: Record) -> FloatArray:
    """Return the measured displacement [m]; raises InputError when a record has none."""
    if record.displacement is None:
        raise InputError([f"Record '{record.name}' has no displacement; a fit compares with one."])
    return record.displacement


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

    By `wanted` (n, m, k) alone if those `by_start` are not asked for.
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
    """Return the states beside the memories whose start a record leaves open, with their size.

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
    gain = float(np.nanstd(measured(record))) / max(float(np.std(v)), 1e-300)
    if not gain * float(np.sqrt(np.mean(bend**2))) > 3.0 * noise:
        return {}
    memories = memory_names(model.structure)
    nominal = model.state_nominals()
    return {
        name: max(abs(float(moving.x[i] - rest.x[i])), 1e-6 * float(nominal[i]))
        for i, name in enumerate(model.state_names)
        if name not in memories
    }


def traced_by_theta(
    model: Model,
    record: Record,
    unknowns: Unknowns,
    theta: FloatArray,
    index: int,
    *,
    stop: int,
    way: Way,
    slopes: FloatArray,
    outputs: Sequence[str] = (OUTPUT,),
) -> Traced:
    """Return outputs (stop, m) of one record and their derivatives by theta (stop, m, size).

    Without the sensor's offset. `slopes` are `unknowns.slopes(theta)`.
    """
    current = model.with_values(unknowns.values(theta))
    start = unknowns.start(theta, index)
    traced = trace_record(
        current, record, start, unknowns.names, stop=stop, way=way, outputs=outputs
    )
    count = len(unknowns.names)
    start_slopes = unknowns.place_slopes(theta, index)[0]
    by_theta = np.vstack([np.zeros((count, unknowns.size)), start_slopes])
    by_theta[:count, :count] = slopes
    with np.errstate(all="ignore"):  # what is not finite is seen by the fit
        flat = (
            traced.sensitivity.reshape(-1, len(by_theta)) @ by_theta
        )  # one product for all samples
    return Traced(traced.y, flat.reshape(*traced.y.shape, unknowns.size), traced.way)


def outputs_of(channels: Sequence[Channel]) -> tuple[str, ...]:
    """Return the model's outputs that channels show, each once, those of the first one first."""
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
    columns. The outputs of `further` channels come too if they are asked for.
    """
    slopes, current = unknowns.slopes(theta), model.with_values(unknowns.values(theta))

    def one(index: int) -> Prediction:
        e = experiments[index]
        record, start = e.record, unknowns.start(theta, index)
        outputs = outputs_of(e.channels if further else e.channels[:1])
        stop = record.n if everything else e.stop
        if not stop:
            none = np.zeros(0), np.zeros((0, unknowns.size))
            return Prediction(*none, "", dict.fromkeys(outputs, none))
        if not differentiated:
            traced = trace_record(
                current, record, start, (), stop=stop, way=way, by_start=False, outputs=outputs
            )
        else:
            traced = traced_by_theta(
                model, record, unknowns, theta, index,
                stop=stop, way=way, slopes=slopes, outputs=outputs,
            )  # fmt: skip
        table = {n: (traced.y[:, k], traced.sensitivity[:, k]) for k, n in enumerate(outputs)}
        x, jacobian = table[outputs[0]]
        if differentiated:
            jacobian = jacobian + unknowns.place_slopes(theta, index)[1]
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

    @property
    def error(self) -> float:
        """That of the first channel."""
        return self.errors[0] if self.errors else 0.0


def simulated(
    model: Model,
    experiments: Sequence[Experiment],
    unknowns: Unknowns,
    theta: FloatArray,
    *,
    way: Way,
) -> list[Simulated]:
    """Tell how every record is run; a tenth of the tolerance and half the step show its error."""
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
            float(np.sqrt(np.mean(g[item] ** 2))) if item.any() else 0.0
            for g, item in zip(gap.T, at, strict=True)
        ]
        return Simulated(rough.way, tuple(errors) if same else (float("inf"),) * len(plain))

    return side_by_side(one, range(len(experiments)))
