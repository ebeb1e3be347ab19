"""Simulate a model on a record's voltage, or on any voltage given as samples."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from psa_casadi.errors import Problems
from psa_casadi.model.compose import Model
from psa_casadi.records.record import Record
from psa_casadi.shown import Shown, frame, with_units
from psa_casadi.simulation.start import start_on
from psa_casadi.simulation.stepper import Steps
from psa_casadi.simulation.ways import accurate

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, repr=False)
class Trajectory(Shown):
    """A simulated experiment in SI units; arrays of shape (n,), one per state and output.

    `way` tells how it was integrated, by exact steps of the linear part or by the stepper; `units`
    are those of states and outputs.
    """

    time: FloatArray
    voltage: FloatArray
    states: Mapping[str, FloatArray]
    outputs: Mapping[str, FloatArray]
    steps: int
    way: str
    units: Mapping[str, str] = field(default_factory=dict)

    @property
    def shown(self) -> str:
        """The output that the sensor shows; without a sensor, the displacement."""
        name = "measured_displacement"
        return name if name in self.outputs else "displacement"

    @property
    def displacement(self) -> FloatArray:
        """Displacement that the sensor shows; without a sensor, that of the output [m]."""
        return self.outputs[self.shown]

    def to_frame(self) -> Any:
        """Return time, voltage, states and outputs as a pandas DataFrame: `time [s]`, ..."""
        columns = {"time": self.time, "voltage": self.voltage, **self.states, **self.outputs}
        return frame(with_units(columns, {"time": "s", "voltage": "V", **self.units}))


def simulate(
    model: Model,
    time: npt.ArrayLike,
    voltage: npt.ArrayLike,
    *,
    load_force: npt.ArrayLike | None = None,
    temperature: npt.ArrayLike | None = None,
    memory: Mapping[str, float] | None = None,
    as_exported: bool | None = None,
    from_rest_at_zero: bool = False,
    rtol: float = 1e-6,
    hold: str = "linear",
) -> Trajectory:
    """Simulate a model over samples of voltage [V] at strictly increasing times [s].

    `load_force` [N] and `temperature` [K] are samples of further inputs, each constant at its start
    value where not given. Between samples the voltage is linear (`hold="linear"`) or constant
    (`hold="zero"`). The displacement errs by at most `rtol` of its range.

    The model starts in the state that the first voltage and its rate imply, with `memory`
    deviations (see `start_state`). With `as_exported` it starts at its start values instead, as an
    FMU or a Modelica package of it does; a model that has start values of its own (`settled_at`,
    MODEL.json) does so unless a memory is given or `as_exported` is False. With `from_rest_at_zero`
    every state starts at 0. Sampled states always start at their start values.

    Raises SimulationError, and InputError for samples that do not fit the times or the model.
    """
    t, v = np.asarray(time, dtype=float), np.asarray(voltage, dtype=float)
    given = {"voltage": v}
    for name, samples in (("load_force", load_force), ("temperature", temperature)):
        if samples is not None:
            given[name] = np.asarray(samples, dtype=float)
    _check(model, t, given)
    u = input_samples(model, len(t), given)
    if as_exported is None:
        as_exported = memory is None and model.starts_itself
    if from_rest_at_zero:
        x0 = np.zeros(len(model.state_names))
    elif as_exported:
        x0 = np.array([s.start for s in model.structure.states])
    else:
        x0 = start_on(model, t, u, memory).x
    return _trajectory(model, t, v, *accurate(model, t, u, x0, rtol=rtol, hold=hold))


def input_samples(model: Model, n: int, given: Mapping[str, FloatArray]) -> FloatArray:
    """Return the samples (n, nu) of a model's inputs; those not given stay at their start value."""
    u = np.tile([i.start for i in model.structure.inputs], (n, 1))
    for name, samples in given.items():
        u[:, model.input_names.index(name)] = samples[:n]
    return u


def record_inputs(model: Model, record: Record, n: int) -> FloatArray:
    """Return the first n samples (n, nu) of a model's inputs that a record has columns for."""
    columns = {name: getattr(record, name, None) for name in model.input_names}
    return input_samples(model, n, {k: v for k, v in columns.items() if v is not None})


def _check(model: Model, t: FloatArray, given: Mapping[str, FloatArray]) -> None:
    problems = Problems()
    if t.ndim != 1 or t.size < 2 or not np.all(np.diff(t) > 0):
        problems.add("The times do not strictly increase; give two or more, sorted, in seconds.")
    for name, samples in given.items():
        if name not in model.input_names:
            problems.add(
                f"The model has no input '{name}', it has {model.input_names}; use `run` for models"
                " other than a stack."
            )
        if samples.shape != t.shape:
            problems.add(f"{name} has {samples.size} samples for {t.size} times; give one each.")
        elif not np.isfinite(samples).all():
            problems.add(f"{name} has samples that are not finite; remove or replace them.")
    problems.raise_if_any()


def simulate_record(
    model: Model,
    record: Record,
    memory: Mapping[str, float] | None = None,
    rtol: float = 1e-6,
    *,
    as_exported: bool | None = None,
) -> Trajectory:
    """Simulate a model on the voltage, and the load and temperature if there are any, of a record.

    Columns that are no input of the model have no influence. It starts as `simulate` has it.
    """
    extra = {n: getattr(record, n) for n in ("load_force", "temperature") if n in model.input_names}
    return simulate(
        model,
        record.time,
        record.voltage,
        memory=memory,
        as_exported=as_exported,
        rtol=rtol,
        **extra,
    )


def _trajectory(model: Model, t: FloatArray, v: FloatArray, steps: Steps, way: str) -> Trajectory:
    return Trajectory(
        time=t,
        voltage=v,
        states={
            **dict(zip(model.state_names, steps.x.T, strict=True)),
            **dict(zip(model.sampled_names, steps.z.T, strict=True)),
        },
        outputs=dict(zip(model.output_names, steps.y.T, strict=True)),
        steps=steps.steps,
        way=way,
        units={
            **{s.name: s.unit for s in (*model.structure.states, *model.structure.sampled)},
            **{o.name: o.unit for o in model.structure.outputs},
        },
    )
