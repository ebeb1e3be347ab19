"""Predictions of a model for a set of experiments, and their exact derivatives."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from psa_casadi.errors import InputError
from psa_casadi.identification.fitting.unknowns import Unknowns
from psa_casadi.model.compose import Model
from psa_casadi.records.record import Record
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.side_by_side import side_by_side
from psa_casadi.simulation.simulate import Traced, Way, record_inputs, trace
from psa_casadi.simulation.start import (
    initial_slope,
    memory_names,
    settling_time,
    start_on,
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
    """Predicted displacement (n,) [m] of one record and its derivative (n, size) by theta.

    `way` tells how the record was integrated.
    """

    displacement: FloatArray
    jacobian: FloatArray
    way: str


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
    found = trace_record(model, record, start, wanted, stop=stop, way=Way(rtol, rtol))
    count = len(wanted)
    slopes = found.sensitivity[:, 0]
    return found.y[:, 0], slopes[:, :count], slopes[:, count:]


def record_start(model: Model, record: Record, start: Mapping[str, float]) -> FloatArray:
    """Return the states (nx,) at a record's first sample; `start` as in `predict_record`."""
    time, memories = record.time - record.time[0], memory_names(model.structure)
    memory = {n: start.get(n, 0.0) for n in memories}
    x0 = start_on(model, time, record_inputs(model, record, record.n), memory).x.copy()
    for name, deviation in start.items():
        if name not in memories:
            x0[model.state_names.index(name)] += deviation
    return x0


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
    """Return outputs (n, r) and their derivatives by `wanted` and `start` (n, r, k + m).

    By `wanted` (n, r, k) alone if those `by_start` are not asked for.
    """
    names = model.state_names
    t, u = record.time[:stop] - record.time[0], record_inputs(model, record, stop)
    memories = memory_names(model.structure)
    found = start_on(model, t, u, {n: start.get(n, 0.0) for n in memories})
    x0, searched = found.x.copy(), [names.index(n) for n in start]
    moved = np.zeros((len(names), len(start)))
    for column, name in enumerate(start):
        if name in memories:
            moved[:, column] = found.by_memory[:, memories.index(name)]
        else:
            x0[searched[column]] += start[name]
            moved[searched[column], column] = 1.0
    columns = [model.parameter_names.index(n) for n in wanted]
    s0 = found.by_parameter[:, columns]
    unknowns: list[str | int] = list(wanted)
    if by_start:
        s0, unknowns = np.hstack([s0, moved]), [*wanted, *searched]
    return trace(
        model,
        t,
        u,
        x0,
        way=way,
        outputs=outputs,
        unknowns=unknowns,
        s0=s0,
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
    output: str = OUTPUT,
) -> tuple[FloatArray, FloatArray, str]:
    """Return an output (stop,) of one record, its derivative by theta, and the way it was run.

    Without the sensor's offset. `slopes` are `unknowns.slopes(theta)`.
    """
    current = model.with_values(unknowns.values(theta))
    start = unknowns.start(theta, index)
    found = trace_record(
        current, record, start, unknowns.names, stop=stop, way=way, outputs=(output,)
    )
    count = len(unknowns.names)
    start_slopes = unknowns.place_slopes(theta, index)[0]
    by_theta = np.vstack([np.zeros((count, unknowns.size)), start_slopes])
    by_theta[:count, :count] = slopes
    return found.y[:, 0], found.sensitivity[:, 0] @ by_theta, found.way


def predict(
    model: Model,
    experiments: Sequence[Experiment],
    unknowns: Unknowns,
    theta: FloatArray,
    *,
    way: Way,
    everything: bool = False,
    differentiated: bool = True,
) -> list[Prediction]:
    """Predict every experiment at theta, up to its last used sample, or in full (`everything`).

    Records are simulated side by side; `differentiated` or not, in which case the Jacobian has no
    columns.
    """
    slopes, current = unknowns.slopes(theta), model.with_values(unknowns.values(theta))

    def one(index: int) -> Prediction:
        record, start = experiments[index].record, unknowns.start(theta, index)
        stop = record.n if everything else experiments[index].stop
        if not stop:
            return Prediction(np.zeros(0), np.zeros((0, unknowns.size)), "")
        if not differentiated:
            found = trace_record(current, record, start, (), stop=stop, way=way, by_start=False)
            x, jacobian, way_taken = found.y[:, 0], found.sensitivity[:, 0], found.way
        else:
            x, jacobian, way_taken = traced_by_theta(
                model, record, unknowns, theta, index, stop=stop, way=way, slopes=slopes
            )
            jacobian += unknowns.place_slopes(theta, index)[1]
        return Prediction(x + unknowns.offset(theta, index), jacobian, way_taken)

    return side_by_side(one, range(len(experiments)))


@dataclass(frozen=True)
class Simulated:
    """How a record was run, and what a finer run differs by (rms of its used samples) [m].

    `way` is "" for a record that is held out whole.
    """

    way: str
    error: float


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
        experiment, start = experiments[index], unknowns.start(theta, index)
        used = experiment.used[: experiment.stop]
        if not used.size:
            return Simulated("", 0.0)
        plain, finer = (
            trace_record(
                current, experiment.record, start, (), stop=experiment.stop, way=w, by_start=False
            )
            for w in (way, way.finer)
        )
        gap = (plain.y[:, 0] - finer.y[:, 0])[used]
        error = float(np.sqrt(np.mean(gap**2))) if gap.size else 0.0
        return Simulated(plain.way, error if plain.way == finer.way else float("inf"))

    return side_by_side(one, range(len(experiments)))
