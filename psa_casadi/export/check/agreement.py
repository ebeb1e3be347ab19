"""What an FMU must give: an independent computation of the same model, and its equations."""

import math
from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from psa_casadi.common.errors import InputError
from psa_casadi.common.strict_json import read_json
from psa_casadi.common.units import FloatArray
from psa_casadi.export.check.rows import BREAKDOWNS, CheckRow
from psa_casadi.export.common.variable_table import starts_at_voltage
from psa_casadi.export.fixed_step.export import STEPS, VOLTAGES, main_output, played_inputs
from psa_casadi.export.fmu import reference_run
from psa_casadi.export.fmu.sources import FIXED_ENTRY, fixed_step_of
from psa_casadi.export.importer.fmu import Fmu
from psa_casadi.export.importer.masters import Signals, co_simulate
from psa_casadi.model.components import BASE, SIMPLIFIED
from psa_casadi.model.compose import Model
from psa_casadi.model.variables import nominal_value
from psa_casadi.reference import Signal, from_samples, simulate
from psa_casadi.simulation.simulate import settled_at
from psa_casadi.simulation.stepper import run


@dataclass(frozen=True)
class Run:
    """One run: where its inputs and points are, what must come of it, how far off it may be.

    `expected` (n, ny) at `times` (n,); `integrated` is true for model exchange; a `tolerance`
    of None is the importer's. `scale` (ny,) and `by` are those of the truth by default.
    """

    name: str
    times: FloatArray
    inputs: Signals
    expected: FloatArray
    limit: float
    tolerance: float | None = None
    integrated: bool = False
    scale: FloatArray | None = None
    by: str = ""


@dataclass(frozen=True)
class Truth:
    """The equations of a model, the runs to compare with, and why there are no more of them.

    `f` and `switches` take time and the vectors of states, inputs, parameters and sampled states.
    `starts` are the values of states, inputs and outputs before anything is set, `settled_starts`
    those of states and voltage, each with its usual size, where the FMU starts settled at
    `start_voltage` [V]; None if they are not known. `compared` names what the runs compare, `scale`
    (ny,) its size, `by` who computed it.
    """

    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    parameter_names: tuple[str, ...]
    output_names: tuple[str, ...]
    switch_names: tuple[str, ...]
    f: ca.Function
    switches: ca.Function
    starts: dict[str, float]
    settled: bool
    compared: tuple[str, ...]
    by: str
    scale: FloatArray
    runs: tuple[Run, ...]
    problem: str = ""
    start_voltage: float = 0.0
    settled_starts: dict[str, tuple[float, float]] | None = None


#: Largest difference from the independent computation, as a share of the range.
LIMIT = 1e-6
#: The same where the importer asks for no tolerance (1e-6 by default).
DEFAULT_LIMIT = 1e-5

_TOLERANCE = 1e-10
_SLOW_STEPS = (1e-2, 1e-3, 1e-4)
_MOST_STEPS = 6000
_FAST_STEP, _FAST_COUNT = 1e-6, 3000


def signals_of(model: Model, segment: float) -> Signals:
    """Return a test signal: six straight segments [s each] from 0 up to every input's nominal."""
    times = np.array([segment * k for k in range(len(reference_run.SHAPE))])
    columns = [
        nominal_value(declared.nominal, model.values) * reference_run.shifted(i)
        for i, declared in enumerate(model.structure.inputs)
    ]
    return Signals(model.input_names, times, np.array(columns).T.reshape(len(times), -1))


def has_reference(model: Model) -> bool:
    """Say whether the model is the paper's, which `psa_casadi.reference` computes independently."""
    names = {c.name for c in model.components}
    base, simplified = ({c.name for c in family} for family in (BASE, SIMPLIFIED))
    return any(f - {"sensor"} <= names <= f for f in (base, simplified))


def expected_outputs(model: Model, times: FloatArray, inputs: Signals) -> FloatArray:
    """Return the outputs (n, ny) by the reference, or by the simulator for a model with effects.

    Of a model without outputs: its states (n, nx).

    At a jump of inputs that are held the outputs are those before it; with sampled states, which
    take their samples after it, those after it.
    """
    if not has_reference(model):
        return simulated(model, times, inputs)
    knots = inputs.times.tolist()

    def held(values: list[float]) -> Signal:
        return lambda t: float(values[max(bisect_left(knots, t) - 1, 0)])

    signals = {
        name: held(column.tolist()) if inputs.held else from_samples(inputs.times, column)
        for name, column in zip(inputs.names, inputs.values.T, strict=True)
    }
    result = simulate(
        model.values,
        signals["voltage"],
        times,
        load_force=signals["load_force"],
        initial={s.name: s.start for s in model.structure.states},
        breakpoints=list(inputs.times),
        mechanics="cascade" if "k_B" in model.values else "single_mass",
        rtol=_TOLERANCE,
    )
    names = ("displacement" if n == "measured_displacement" else n for n in model.output_names)
    return np.array([getattr(result, name) for name in names]).T


def simulated(model: Model, times: FloatArray, inputs: Signals) -> FloatArray:
    """Return the same by the simulator."""
    quiet = not model.output_names
    grid = np.union1d(times, inputs.times[inputs.times <= times[-1]])
    start = np.array([s.start for s in model.structure.states])
    hold = "zero" if inputs.held else "linear"
    steps = run(model, grid, inputs.at(grid), start, rtol=1e-11, hold=hold)
    if quiet or not inputs.held or model.sampled_names:
        return (steps.x if quiet else steps.y)[np.isin(grid, times)]
    p = np.array([[model.values[n]] * len(grid) for n in model.parameter_names])
    before = inputs.at(grid, before=True)
    result = np.array(model.structure.f(grid[None, :], steps.x.T, before.T, p)[1])
    return result.T[np.isin(grid, times)]


def truth_of(model: Model, version: int) -> Truth:
    """Return what an FMU of a version of FMI is compared with; runs that fail are a problem."""
    truth = bare_truth(model)
    try:
        return _with_runs(truth, model, held=version == 3)
    except BREAKDOWNS as error:
        return replace(truth, problem=str(error))


def bare_truth(model: Model) -> Truth:
    """Return what an FMU is compared with, without runs."""
    s = model.structure
    switches = ca.Function("z", s.arguments, [ca.vertcat(*s.switches.values())])
    names = model.output_names or model.state_names
    groups = [np.array([v.start for v in group]) for group in (s.states, s.inputs)]
    held = [np.array([v.start for v in s.sampled])] if s.sampled else []
    y = np.array(s.f(0.0, *groups, model.parameter_vector(), *held)[1]).ravel()
    names_of_starts = (*model.state_names, *model.input_names, *model.output_names)
    starts = dict(zip(names_of_starts, np.concatenate([*groups, y]).tolist(), strict=True))
    truth = Truth(
        model.state_names, model.input_names, model.parameter_names, model.output_names,
        tuple(s.switches), s.f, switches, starts, bool(model.sampled_names), names,
        "reference" if has_reference(model) else "simulator", np.ones(len(names)), (),
    )  # fmt: skip
    if not starts_at_voltage(model):
        return truth
    voltage = next(i for i in s.inputs if i.name == "voltage")
    usual = nominal_value(voltage.nominal, model.values)
    chosen = max((0.4 * usual, 0.6 * usual), key=lambda v: abs(v - voltage.start))
    try:
        settled = settled_at(model, chosen).structure
    except BREAKDOWNS:  # it does not rest there
        return truth
    sizes = model.state_nominals().tolist()
    others = {q.name: (q.start, v) for q, v in zip(settled.states, sizes, strict=True)}
    others["voltage"] = chosen, usual
    return replace(truth, start_voltage=chosen, settled_starts=others)


def _with_runs(truth: Truth, model: Model, *, held: bool) -> Truth:
    """Add runs of both interfaces, with communication steps of 1 us to 10 ms.

    A slow run has knots every 10 ms, or every multiple of 10 ms that lets the model settle; a fast
    run of 3 ms has knots every half millisecond. Inputs are linear between knots; in co-simulation
    of FMI 3.0, which has no input derivatives, they are held. The scale is the range of each output
    in the slow run; that of other outputs than displacement is at least their nominal.
    """
    slow, fast = signals_of(model, reference_run.segment(model)), signals_of(model, 5e-4)
    grids = {step: _grid(step, slow.times[-1]) for step in _SLOW_STEPS}
    times = np.unique(np.concatenate([*grids.values(), slow.times]))
    linear = expected_outputs(model, times, slow)
    ranges = np.ptp(linear, axis=0)
    nominals = model.output_nominals() if model.output_names else model.state_nominals()
    strict = np.array(["displacement" in n for n in truth.compared])
    scale = np.where(strict & (ranges > 0.0), ranges, np.maximum(ranges, nominals))
    expected = linear

    def run(name: str, step: float, limit: float = LIMIT, **options: Any) -> Run:
        at = expected[np.searchsorted(times, grids[step])]
        return Run(name, grids[step], slow, at, limit, **options)

    runs = [run("model exchange", 1e-3, tolerance=_TOLERANCE, integrated=True)]
    if held:
        slow, fast = (replace(signals, held=True) for signals in (slow, fast))
        expected = expected_outputs(model, times, slow)
    runs += [run(f"co-simulation, step {q:g} s", q, tolerance=_TOLERANCE) for q in _SLOW_STEPS]
    runs.append(run("co-simulation, default tolerance", 1e-3, DEFAULT_LIMIT))
    grid = _grid(_FAST_STEP, _FAST_STEP * _FAST_COUNT)
    at = expected_outputs(model, grid, fast)
    runs.append(Run(f"co-simulation, step {_FAST_STEP:g} s", grid, fast, at, LIMIT, _TOLERANCE))
    return replace(truth, scale=scale, runs=tuple(runs))


def _grid(step: float, end: float) -> FloatArray:
    count = min(_MOST_STEPS, round(end / step))
    return np.array([round(step * k, 12) for k in range(count + 1)])


#: Errors are stated with two digits, and what they are compared with errs too.
_ROUNDING, _REFERENCE_ERROR = 1.06, 1e-8
#: Steps of the run with longer communication steps, and the voltage that is straight in between.
_AT_ONCE, _STRAIGHT = 10, "ramps and holds"
#: The reference restarts at every knot of a voltage; with more of them the simulator computes it.
_MOST_KNOTS = 50


@dataclass(frozen=True)
class StatedStep:
    """The stated fixed step [s] of an FMU, and the largest error over the range by voltage."""

    step: float
    errors: Mapping[str, float]


def stated_step(directory: Path) -> StatedStep | None:
    """Return the stated fixed step of an unpacked FMU; None if it has none.

    Raises InputError if it does not state an error for each reference voltage, as JSON.
    """
    step = fixed_step_of(directory)
    if step is None:
        return None
    try:
        result = read_json(directory / FIXED_ENTRY, "export the FMU again.", FIXED_ENTRY)["errors"]
        errors = {name: float(result[name]) for name in VOLTAGES}
    except (KeyError, OSError, TypeError, ValueError) as error:
        raise InputError(
            f"{FIXED_ENTRY}: does not state the error for each reference voltage ({error});"
            " export the FMU again."
        ) from error
    if not all(math.isfinite(e) and e >= 0.0 for e in (*errors.values(), step)) or step == 0.0:
        raise InputError(f"{FIXED_ENTRY}: its numbers are impossible; export the FMU again.")
    return StatedStep(step, errors)


def fixed_truth(model: Model, version: int, stated: StatedStep) -> Truth:
    """Return what an FMU with a fixed step is compared with; runs that fail are a problem."""
    truth = bare_truth(model)
    try:
        names = (main_output(model),)
        runs = [_run(model, name, stated, held=version == 3) for name in VOLTAGES]
        runs.append(_run(model, _STRAIGHT, stated, held=version == 3, every=_AT_ONCE))
    except BREAKDOWNS as error:
        return replace(truth, problem=str(error))
    return replace(truth, compared=names, scale=np.ones(1), runs=tuple(runs))


def _run(model: Model, name: str, stated: StatedStep, *, held: bool, every: int = 1) -> Run:
    """Return the run of a reference voltage, in communication steps of some fixed ones.

    Where inputs are held over several, they jump more often: by less than in the worst of them.
    """
    _, shape = VOLTAGES[name]
    grid = np.arange(0, STEPS + 1, every)
    times = stated.step * grid.astype(np.float64)
    inputs = played_inputs(model, shape(np.linspace(0.0, 1.0, STEPS + 1)))[grid]
    rounding = 1e-9 * np.max(np.abs(inputs), initial=0.0)
    moved = inputs[1:-1] - inputs[:-2]
    bends = moved if held else inputs[2:] - 2.0 * inputs[1:-1] + inputs[:-2]
    kept = np.ones(len(inputs), dtype=bool)  # but for knots at which nothing bends or jumps
    kept[1:-1] = np.any(np.abs(bends) > rounding, axis=1)
    signals = Signals(model.input_names, times[kept], inputs[kept], held)
    exact = has_reference(model) and len(signals.times) <= _MOST_KNOTS
    compute = expected_outputs if exact else simulated
    column = model.output_names.index(main_output(model))
    expected = compute(model, times, signals)[:, column : column + 1]
    scale = np.ptp(expected, axis=0)
    error = max(stated.errors.values()) if held and every > 1 else stated.errors[name]
    return Run(
        f"fixed step, {name}" + (f", {every} at once" if every > 1 else ""),
        times,
        signals,
        expected,
        _ROUNDING * error + _REFERENCE_ERROR,
        scale=np.where(scale > 0.0, scale, model.output_nominals()[column]),
        by="reference" if exact else "simulator",
    )


#: How far a repeated run may be off, as a share of its range, by the version of FMI: in FMI 3.0
#: inputs cannot move within a step, see `_played`.
RUN_LIMITS = {2: 1e-5, 3: 5e-4}
#: How far a repeated error may be off, as a share of what is stated.
ERROR_LIMIT = 0.02
_PLAYED_TOLERANCE = 1e-9
#: What a held input may move in a step, over its range; the most steps between two samples.
_STEP, _MOST_PARTS = 1e-3, 1000


@dataclass(frozen=True)
class Playback:
    """Inputs, linear between n knots, start values, and what an output must be at these (n,).

    With `stated`, the rms over finite samples of what is expected must be that [m]; else the
    output itself must be equal.
    """

    name: str
    inputs: Signals
    start: Mapping[str, float]
    output: str
    expected: FloatArray
    stated: float | None = None


def played_again(fmu: Fmu, playback: Playback) -> CheckRow:
    """Return the row of a run that is repeated."""
    result = _played(fmu, playback)
    valid = np.isfinite(playback.expected)
    error = result[valid] - playback.expected[valid]
    if playback.stated is None:
        size = float(np.ptp(playback.expected[valid])) or 1.0
        largest = float(np.max(np.abs(error))) / size
        remark = f"largest difference of {playback.output} over its range"
        limit = RUN_LIMITS[fmu.version]
        return CheckRow(playback.name, largest, limit, largest <= limit, remark)
    rms = float(np.sqrt(np.mean(error**2)))
    off = abs(rms / playback.stated - 1.0) if playback.stated > 0.0 else float("inf")
    remark = f"{1e6 * rms:.4g} um rms, stated {1e6 * playback.stated:.4g} um"
    return CheckRow(playback.name, off, ERROR_LIMIT, off <= ERROR_LIMIT, remark)


def _played(fmu: Fmu, p: Playback) -> FloatArray:
    """Return the output (n,) at the knots, inputs linear between them.

    Co-simulation of FMI 3.0 has no such inputs. There they are held at the mean over a step, which
    leaves the end of the step late by half of it; from steps and half steps follows what none is.
    """
    knots = p.inputs.times

    def stepped(points: FloatArray) -> FloatArray:
        values = co_simulate(
            fmu, points, p.inputs, [p.output], tolerance=_PLAYED_TOLERANCE, values=p.start,
            centred=True,
        )  # fmt: skip
        return np.asarray(values[np.isin(points, knots), 0])

    def divided(parts: int) -> FloatArray:
        """Return points between which inputs move little; `parts` multiplies their number."""
        counts = parts * np.clip(np.ceil(moved / _STEP), 1, _MOST_PARTS).astype(int)
        ends = zip(knots, knots[1:], counts, strict=False)
        steps = [np.linspace(a, b, m, endpoint=False) for a, b, m in ends]
        return np.concatenate([*steps, knots[-1:]])

    if fmu.takes_lines:
        return stepped(knots)
    size = np.maximum(np.ptp(p.inputs.values, axis=0), 1e-300)
    moved = np.max(np.abs(np.diff(p.inputs.values, axis=0)) / size, axis=1)
    return 2.0 * stepped(divided(2)) - stepped(divided(1))
