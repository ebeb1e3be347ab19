"""What an FMU must give: an independent computation of the same model, and its equations."""

import math
from bisect import bisect_left
from dataclasses import replace

import casadi as ca
import numpy as np
import numpy.typing as npt

from psa_casadi.components import BASE, SIMPLIFIED
from psa_casadi.export.check.rows import BREAKDOWNS
from psa_casadi.export.check.truth import Run, Truth
from psa_casadi.export.common.markup import time_scale
from psa_casadi.export.common.variable_table import starts_at_voltage
from psa_casadi.export.importer.masters import Signals
from psa_casadi.model.compose import Model
from psa_casadi.reference import Signal, from_samples, simulate
from psa_casadi.simulation.history import settled_at
from psa_casadi.simulation.stepper import run
from psa_casadi.variables import nominal_value

FloatArray = npt.NDArray[np.float64]

#: Largest difference from the independent computation, as a share of the range.
LIMIT = 1e-6
#: The same where the importer asks for no tolerance (1e-6 by default).
DEFAULT_LIMIT = 1e-5

_TOLERANCE = 1e-10
_SLOW_STEPS = (1e-2, 1e-3, 1e-4)
_MOST_STEPS = 6000
_FAST_STEP, _FAST_COUNT = 1e-6, 3000
_SHAPE = (0.0, 0.8, 0.3, 1.0, 0.1, 0.6, 0.6)


def signals_of(model: Model, segment: float) -> Signals:
    """Return a test signal: six straight segments [s each] from 0 up to every input's nominal."""
    times = np.array([segment * k for k in range(len(_SHAPE))])
    columns = []
    for i, declared in enumerate(model.structure.inputs):
        shape = np.roll(_SHAPE[1:], 2 * i)
        columns.append(nominal_value(declared.nominal, model.values) * np.array([0.0, *shape]))
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
    cascade = "k_B" in model.values
    signals = {name: _signal(inputs, i) for i, name in enumerate(inputs.names)}
    found = simulate(
        model.values,
        signals["voltage"],
        times,
        load_force=signals["load_force"],
        initial={s.name: s.start for s in model.structure.states},
        breakpoints=list(inputs.times),
        mechanics="cascade" if cascade else "single_mass",
        rtol=_TOLERANCE,
    )
    return np.array(
        [
            getattr(found, "displacement" if n == "measured_displacement" else n)
            for n in model.output_names
        ]
    ).T


def _signal(inputs: Signals, column: int) -> Signal:
    if not inputs.held:
        return from_samples(inputs.times, inputs.values[:, column])
    times, values = inputs.times.tolist(), inputs.values[:, column].tolist()
    return lambda t: float(values[max(bisect_left(times, t) - 1, 0)])


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
    found = np.array(model.structure.f(grid[None, :], steps.x.T, before.T, p)[1])
    return found.T[np.isin(grid, times)]


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
    truth = Truth(
        model.state_names, model.input_names, model.parameter_names, model.output_names,
        tuple(s.switches), s.f, switches, _starts(model), bool(model.sampled_names), names,
        "reference" if has_reference(model) else "simulator", np.ones(len(names)), (),
    )  # fmt: skip
    return _with_settled_start(truth, model)


def _starts(model: Model) -> dict[str, float]:
    """Return the start values of states and inputs, and the outputs that follow from them."""
    s = model.structure
    groups = [np.array([v.start for v in group]) for group in (s.states, s.inputs)]
    held = [np.array([v.start for v in s.sampled])] if s.sampled else []
    y = np.array(s.f(0.0, *groups, model.parameter_vector(), *held)[1]).ravel()
    names = (model.state_names, model.input_names, model.output_names)
    values = (*groups, y)
    return {n: float(v) for k, own in enumerate(names) for n, v in zip(own, values[k], strict=True)}


def _with_settled_start(truth: Truth, model: Model) -> Truth:
    """Add the start at another voltage than that of the export, where there is one."""
    if not starts_at_voltage(model):
        return truth
    voltage = next(i for i in model.structure.inputs if i.name == "voltage")
    usual = nominal_value(voltage.nominal, model.values)
    chosen = max((0.4 * usual, 0.6 * usual), key=lambda v: abs(v - voltage.start))
    try:
        settled = settled_at(model, chosen).structure
    except BREAKDOWNS:  # it does not rest there
        return truth
    sizes = model.state_nominals().tolist()
    starts = {q.name: (q.start, v) for q, v in zip(settled.states, sizes, strict=True)}
    starts["voltage"] = chosen, usual
    return replace(truth, start_voltage=chosen, settled_starts=starts)


def _with_runs(truth: Truth, model: Model, *, held: bool) -> Truth:
    """Add runs of both interfaces, with communication steps of 1 us to 10 ms.

    A slow run has knots every 10 ms, or every multiple of 10 ms that lets the model settle; a fast
    run of 3 ms has knots every half millisecond. Inputs are linear between knots; in co-simulation
    of FMI 3.0, which has no input derivatives, they are held. The scale is the range of each output
    in the slow run; that of other outputs than displacement is at least their nominal.
    """
    segment = 1e-2 * max(1, math.ceil(time_scale(model) / 1e-2))
    slow, fast = signals_of(model, segment), signals_of(model, 5e-4)
    grids = {step: _grid(step, slow.times[-1]) for step in _SLOW_STEPS}
    times = np.unique(np.concatenate([*grids.values(), slow.times]))
    linear = expected_outputs(model, times, slow)
    scale = _scale(model, truth.compared, linear)
    grid = grids[1e-3]
    at = linear[np.searchsorted(times, grid)]
    runs = [Run("model exchange", grid, slow, at, LIMIT, _TOLERANCE, integrated=True)]
    if held:
        slow, fast = (replace(signals, held=True) for signals in (slow, fast))
    expected = expected_outputs(model, times, slow) if held else linear
    for step, grid in grids.items():
        at = expected[np.searchsorted(times, grid)]
        runs.append(Run(f"co-simulation, step {step:g} s", grid, slow, at, LIMIT, _TOLERANCE))
    grid = grids[1e-3]
    at = expected[np.searchsorted(times, grid)]
    runs.append(Run("co-simulation, default tolerance", grid, slow, at, DEFAULT_LIMIT))
    grid = _grid(_FAST_STEP, _FAST_STEP * _FAST_COUNT)
    at = expected_outputs(model, grid, fast)
    runs.append(Run(f"co-simulation, step {_FAST_STEP:g} s", grid, fast, at, LIMIT, _TOLERANCE))
    return replace(truth, scale=scale, runs=tuple(runs))


def _grid(step: float, end: float) -> FloatArray:
    count = min(_MOST_STEPS, round(end / step))
    return np.array([round(step * k, 12) for k in range(count + 1)])


def _scale(model: Model, names: tuple[str, ...], expected: FloatArray) -> FloatArray:
    ranges = np.ptp(expected, axis=0)
    nominals = model.output_nominals() if model.output_names else model.state_nominals()
    strict = np.array(["displacement" in n for n in names])
    scale: FloatArray = np.where(strict & (ranges > 0.0), ranges, np.maximum(ranges, nominals))
    return scale
