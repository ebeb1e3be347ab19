"""Simulate a model on a record's voltage, or on the samples of any voltage."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from psa_casadi.common.display import Lined, Plotted, frame, with_units
from psa_casadi.common.errors import InputError, Problems, quoted
from psa_casadi.common.units import FloatArray
from psa_casadi.model.compose import Model
from psa_casadi.records.record import Record
from psa_casadi.simulation.exact.run import NotExact, run_exact
from psa_casadi.simulation.start import start_on, start_state
from psa_casadi.simulation.stepper import Steps, run

#: Outputs that are the displacement a model shows, the first that it has.
SHOWN = ("measured_displacement", "displacement")
#: Names of the two ways in results.
EXACT, STEPPER = "exact steps", "stepper"
#: The stepper's tolerance of a step over that of the whole run: with the 0.003 of the FMU
#: (`fmu_src/instance.c`) clipped voltages and light resonances erred by 3 times the latter.
STEP_SHARE, SMALLEST_STEP_RTOL = 0.0005, 1e-12
#: Exact steps for `accurate`: tolerance of a step over that of the run, least halvings of a sample.
#: Each is judged by the one before; a turn that one halving misses as well shows after two.
LADDER = ((0.03, 0), (0.01, 2), (3e-3, 4), (3e-3, 6))
#: Share of the tolerance to which two runs agree: the finer one may err by a part of it that both
#: have in common.
AGREE = 0.5
#: Below this tolerance two runs may share an error that is of its size: the stepper is taken.
TIGHTEST = 1e-6
#: Loosest tolerance of exact steps: beyond it nothing is won.
LOOSEST = 1e-5
#: Range below which a displacement counts as constant, over its nominal size.
STILL = 1e-3


@dataclass(frozen=True)
class Way:
    """How a record is run: tolerance of an exact step, and of a step of the stepper.

    Exact steps divide every sample by 2^`halved` at least; `stepped` rules them out.
    """

    rtol: float
    step_rtol: float
    halved: int = 0
    stepped: bool = False

    @property
    def finer(self) -> "Way":
        """A way whose error is far smaller: what this one's is judged by."""
        return Way(0.1 * self.rtol, 0.1 * self.step_rtol, self.halved + 1, self.stepped)


@dataclass(frozen=True)
class Traced:
    """Outputs (n, m), their derivatives (n, m, k), the way, and all states (n, nx) if requested."""

    y: FloatArray
    sensitivity: FloatArray
    way: str
    x: FloatArray = field(default_factory=lambda: np.empty((0, 0)))


def output_of(model: Model) -> str | None:
    """Return the name of the displacement that a model shows, None if it has none."""
    return next((n for n in SHOWN if n in model.output_names), None)


def trace(
    model: Model,
    t: FloatArray,
    u: FloatArray,
    x0: FloatArray,
    *,
    way: Way,
    outputs: Sequence[str],
    unknowns: Sequence[str | int] = (),
    s0: FloatArray | None = None,
    hold: str = "linear",
    steps_limit: int = 0,
    steps_most: int = 0,
    everything: bool = False,
) -> Traced:
    """Return outputs of a run and their derivatives by `unknowns`, with `s0` and `hold` of `run`.

    `everything` asks for all states. `steps_limit` bounds the stepper's work between two samples,
    `steps_most` that of the run. Raises SimulationError where both ways fail.
    """
    if not way.stepped:
        try:
            exact_steps = run_exact(
                model, t, u, x0, tolerance=min(way.rtol, LOOSEST), coarsest=way.halved,
                hold=hold, unknowns=unknowns, s0=s0, outputs=outputs, everything=everything,
            )  # fmt: skip
            return Traced(exact_steps.requested, exact_steps.sensitivity, EXACT, exact_steps.x)
        except NotExact:
            pass
    steps = run(
        model, t, u, x0, rtol=way.step_rtol, hold=hold, steps_limit=steps_limit,
        steps_most=steps_most, unknowns=unknowns, s0=s0, outputs=outputs,
    )  # fmt: skip
    rows = [model.output_names.index(n) for n in outputs]
    return Traced(steps.y[:, rows], steps.sensitivity, STEPPER, steps.x)


def accurate(
    model: Model, t: FloatArray, u: FloatArray, x0: FloatArray, *, rtol: float, hold: str
) -> tuple[Steps, str]:
    """Return a run whose displacement errs by less than `rtol` of its range, and the way taken.

    Exact steps get finer until two runs agree to that; where they do not, or for tolerances below
    1e-6, the stepper takes steps of 0.0005 `rtol`.
    """
    output = output_of(model) or ""
    before: FloatArray | None = None
    for share, coarsest in LADDER if output and rtol >= TIGHTEST else ():
        try:
            exact_steps = run_exact(
                model, t, u, x0, tolerance=max(share * rtol, 1e-13), coarsest=coarsest, hold=hold,
                outputs=(output,), everything=before is not None,
            )  # fmt: skip
        except NotExact:
            break
        if before is not None and not exact_steps.forced:
            nominal = model.output_nominals()[model.output_names.index(output)]
            size = max(float(np.ptp(exact_steps.requested)), STILL * nominal)
            if np.max(np.abs(exact_steps.requested - before)) <= AGREE * rtol * size:
                z = np.empty((len(t), 0))
                cost = exact_steps.steps, exact_steps.rejected, 0
                return Steps(exact_steps.x, z, exact_steps.y, exact_steps.sensitivity, *cost), EXACT
        before = exact_steps.requested
    step_rtol = max(STEP_SHARE * rtol, SMALLEST_STEP_RTOL)
    return run(model, t, u, x0, rtol=step_rtol, hold=hold), STEPPER


@dataclass(frozen=True, repr=False)
class Trajectory(Plotted, Lined):
    """A simulated experiment in SI units; arrays of shape (n,), one per state and output.

    `way` is how it was integrated, by exact steps of the linear part or by the stepper; `units`
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
    def sensor_output(self) -> str:
        """The output that the sensor shows; without a sensor, the displacement."""
        return SHOWN[0] if SHOWN[0] in self.outputs else SHOWN[1]

    @property
    def displacement(self) -> FloatArray:
        """Displacement that the sensor shows; without a sensor, that of the output [m]."""
        return self.outputs[self.sensor_output]

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

    `load_force` [N] and `temperature` [K] are samples of further inputs, each by default constant
    at its start value. Between samples the voltage is linear (`hold="linear"`) or constant
    (`hold="zero"`). The displacement errs by at most `rtol` of its range.

    The model starts in the state that the first voltage and its rate imply, with `memory`
    deviations (see `start_state`). With `as_exported` it starts at its start values instead, as an
    FMU or a Modelica package of it does; a model with start values that differ from its components'
    (`settled_at`, MODEL.json) does so unless `memory` is set or `as_exported` is False. With
    `from_rest_at_zero` every state starts at 0. Sampled states always start at their start values.

    Raises SimulationError, and InputError for samples that do not fit the times or the model.
    """
    t, v = np.asarray(time, dtype=float), np.asarray(voltage, dtype=float)
    more = {"load_force": load_force, "temperature": temperature}
    table = {"voltage": v, **{n: np.asarray(q, float) for n, q in more.items() if q is not None}}
    _check(model, t, table)
    u = input_samples(model, len(t), table)
    if as_exported is None:
        as_exported = memory is None and model.starts_itself
    if from_rest_at_zero:
        x0 = np.zeros(len(model.state_names))
    elif as_exported:
        x0 = np.array([s.start for s in model.structure.states])
    else:
        x0 = start_on(model, t, u, memory).x
    steps, way = accurate(model, t, u, x0, rtol=rtol, hold=hold)
    s, state_names = model.structure, (*model.state_names, *model.sampled_names)
    return Trajectory(
        time=t,
        voltage=v,
        states=dict(zip(state_names, (*steps.x.T, *steps.z.T), strict=True)),
        outputs=dict(zip(model.output_names, steps.y.T, strict=True)),
        steps=steps.steps,
        way=way,
        units=dict(zip(state_names, (q.unit for q in (*s.states, *s.sampled)), strict=True))
        | {o.name: o.unit for o in s.outputs},
    )


def input_samples(model: Model, n: int, values: Mapping[str, FloatArray]) -> FloatArray:
    """Return the samples (n, nu) of a model's inputs; others stay at their start value."""
    u = np.tile([i.start for i in model.structure.inputs], (n, 1))
    for name, samples in values.items():
        u[:, model.input_names.index(name)] = samples[:n]
    return u


def record_inputs(model: Model, record: Record, n: int) -> FloatArray:
    """Return the first n samples (n, nu) of a model's inputs that a record has columns for."""
    columns = {name: record.column(name) for name in model.input_names}
    return input_samples(model, n, {k: v for k, v in columns.items() if v is not None})


def _check(model: Model, t: FloatArray, values: Mapping[str, FloatArray]) -> None:
    problems = Problems()
    if t.ndim != 1 or t.size < 2 or not np.all(np.diff(t) > 0):
        problems.add("The times do not strictly increase; give two or more, sorted, in seconds.")
    for name, samples in values.items():
        if name not in model.input_names:
            problems.add(
                f"The model has no input '{name}', it has {quoted(model.input_names)}; use `run`"
                " for models other than a stack."
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
        model, record.time, record.voltage, memory=memory, as_exported=as_exported, rtol=rtol,
        **extra,
    )  # fmt: skip


#: Samples of a sweep and of a rest.
_SAMPLES = 200


def memory_after(
    model: Model, voltages: Sequence[float], *, at: float, sweep: float = 1.0, rest: float = 0.0
) -> dict[str, float]:
    """Return the `memory` (see `simulate`) of a model after a virtual history.

    A stack's hysteresis and creep start a record where the voltage before it has left them. A
    model that starts relaxed instead errs by up to half its loop at first, and by all of it at the
    end of the range. So the history is played into the same equations:

        0 V, relaxed -> V_1 -> V_2 -> ... -> V(0), one sweep each -> rest

    Of the hysteresis only the paper's asymmetry delta depends on the duration of a sweep, and much
    on a slow one; creep does, and on the rest. A voltage slower than `hold_rate` counts as held.

    From relaxed at 0 V the voltage goes to each of the `voltages` [V] in turn and then to `at`, the
    record's first one, in `sweep` [s] each, and stays there for `rest` [s]. Equal voltages in a row
    count once. Take sweeps as long as those that the stack has made: `delta` and creep see them.

    Raises InputError for bad numbers; SimulationError where the model cannot follow.
    """
    problems = Problems()
    if not np.all(np.isfinite([*voltages, at])):
        problems.add("The history has a voltage that is not finite; give numbers in V.")
    if not (np.isfinite(sweep) and sweep > 0.0):
        problems.add(f"A sweep of the history takes {sweep:g} s; give a duration above 0.")
    if not (np.isfinite(rest) and rest >= 0.0):
        problems.add(f"The rest after the history takes {rest:g} s; give a duration of 0 or more.")
    problems.raise_if_any()
    turns = [0.0, *voltages, at]
    share = np.linspace(0.0, 1.0, _SAMPLES + 1)
    parts = [a + (b - a) * share[1:] for a, b in pairwise(turns) if a != b]
    steps = [sweep / _SAMPLES] * (_SAMPLES * len(parts))
    if rest > 0.0:
        parts.append(np.full(_SAMPLES, at))
        steps += [rest / _SAMPLES] * _SAMPLES
    memories = [s for s in model.structure.states if s.memory]
    if not parts:
        return {s.name: 0.0 for s in memories}
    times, played_voltage = np.append(0.0, np.cumsum(steps)), np.concatenate([[0.0], *parts])
    played = simulate(model, times, played_voltage, as_exported=False)
    ended = {s.name: float(played.states[s.name][-1]) for s in memories}
    stays = {s.name: ended[s.name] for s in memories if not s.settles}
    settled = start_state(model, _held(model, at), memory=stays).x
    for s in memories:
        if s.settles:
            ended[s.name] -= float(settled[model.state_names.index(s.name)])
    return ended


def settled_at(
    model: Model,
    voltage: float,
    history: Sequence[float] = (),
    *,
    sweep: float = 1.0,
    rest: float = 0.0,
) -> Model:
    """Return the model with start values where a `voltage` [V] holds it, for an export.

    States and the voltage input start there: the memory after a virtual `history` (see
    `memory_after`), all other continuous ones settled; sampled states keep theirs. Raises as
    `memory_after`, and InputError without a voltage.
    """
    if "voltage" not in model.input_names:
        raise InputError(
            f"The model has no input 'voltage' to be held at; it has {quoted(model.input_names)}."
        )
    memory = memory_after(model, history, at=voltage, sweep=sweep, rest=rest)
    x = start_state(model, _held(model, voltage), memory=memory).x
    starts = dict(zip(model.state_names, x.tolist(), strict=True))
    return model.with_starts({**starts, "voltage": voltage})


def _held(model: Model, voltage: float) -> list[float]:
    """Return the inputs of a model at a voltage [V], the others at their start values."""
    return [voltage if i.name == "voltage" else i.start for i in model.structure.inputs]
