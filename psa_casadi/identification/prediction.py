"""Predictions of a model for a set of experiments, and their exact derivatives."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from psa_casadi.errors import InputError
from psa_casadi.experiment.record import Record
from psa_casadi.experiment.split import Experiment
from psa_casadi.identification.unknowns import Unknowns
from psa_casadi.model.compose import Model
from psa_casadi.simulation.start import initial_slope, start_state
from psa_casadi.simulation.stepper import run

FloatArray = npt.NDArray[np.float64]

#: Steps between two samples beyond which a trial point counts as failed; dozens are ordinary.
_STEPS = 2000
OUTPUT = "measured_displacement"


@dataclass(frozen=True)
class Prediction:
    """Predicted displacement (n,) [m] of one record and its derivative (n, size) by theta."""

    displacement: FloatArray
    jacobian: FloatArray


def measured(record: Record) -> FloatArray:
    """Return the measured displacement [m]; raises InputError when a record has none."""
    if record.displacement is None:
        raise InputError([f"Record '{record.name}' has no displacement; a fit compares with one."])
    return record.displacement


def inputs_of(model: Model, record: Record, stop: int) -> FloatArray:
    """Return the input samples (stop, nu) of a record."""
    u = np.zeros((stop, len(model.input_names)))
    u[:, model.input_names.index("voltage")] = record.voltage[:stop]
    if record.load_force is not None:
        u[:, model.input_names.index("load_force")] = record.load_force[:stop]
    return u


def predict_record(
    model: Model,
    record: Record,
    memory: FloatArray,
    wanted: Sequence[str],
    *,
    stop: int,
    rtol: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return displacement (n,), its derivatives by `wanted` (n, k), and by memory (n, m)."""
    structure = model.structure
    t, u = record.time[:stop], inputs_of(model, record, stop)
    memories = [i for i, s in enumerate(structure.states) if s.memory]
    names = [structure.states[i].name for i in memories]
    rates = [initial_slope(t, u[:, i]) for i in range(u.shape[1])]
    start = start_state(
        model, list(u[0]), rates, dict(zip(names, memory.tolist(), strict=True)), float(t[0])
    )
    columns = [model.parameter_names.index(n) for n in wanted]
    s0 = np.hstack([start.by_parameter[:, columns], start.by_memory])
    unknowns: list[str | int] = [*wanted, *memories]
    steps = run(
        model, t, u, start.x, rtol=rtol, steps_limit=_STEPS, unknowns=unknowns, s0=s0, output=OUTPUT
    )
    displacement = steps.y[:, model.output_names.index(OUTPUT)]
    sensitivity = steps.sensitivity
    if sensitivity is None:
        sensitivity = np.zeros((stop, 0))
    return displacement, sensitivity[:, : len(wanted)], sensitivity[:, len(wanted) :]


def predict(
    model: Model,
    experiments: Sequence[Experiment],
    unknowns: Unknowns,
    theta: FloatArray,
    *,
    rtol: float,
    everything: bool = False,
) -> list[Prediction]:
    """Predict every experiment at theta, up to its last used sample, or in full (`everything`)."""
    current = model.with_values(unknowns.values(theta))
    slopes = unknowns.slopes(theta)
    predictions = []
    for index, experiment in enumerate(experiments):
        stop = experiment.record.n if everything else experiment.stop
        y, by_parameter, by_memory = predict_record(
            current,
            experiment.record,
            unknowns.memory(theta, index),
            unknowns.names,
            stop=stop,
            rtol=rtol,
        )
        jacobian = np.zeros((stop, unknowns.size))
        jacobian[:, : len(unknowns.names)] = by_parameter @ slopes
        first = len(unknowns.names) + index * unknowns.per_record
        last = first + len(unknowns.memories)
        jacobian[:, first:last] = by_memory * unknowns.memory_scale
        jacobian[:, last] = unknowns.offset_scale
        predictions.append(Prediction(y + unknowns.offset(theta, index), jacobian))
    return predictions
