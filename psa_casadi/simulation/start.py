"""The state at the start of a record: at rest, or in steady motion, with an unknown memory.

All states without memory start where the voltage and its rate put them; memories start at their
rest value plus a deviation, 0 by default or estimated.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import casadi as ca
import numpy as np

from psa_casadi.common.errors import InputError, PsaError
from psa_casadi.common.symbolic import in_turn
from psa_casadi.common.units import BoolArray, ComplexArray, FloatArray
from psa_casadi.model.component import Expression
from psa_casadi.model.compose import Model, Structure

_NEWTON_STEPS, _FILTER_STEPS = 30, 8
#: Sets that one call of a function takes.
_CHUNK = 1024


@dataclass(frozen=True)
class Start:
    """Initial state (nx,), its derivatives by parameters (nx, np) and by deviations (nx, m)."""

    x: FloatArray
    by_parameter: FloatArray
    by_start: FloatArray


def memory_names(structure: Structure) -> tuple[str, ...]:
    """Names of the states whose start a record does not determine."""
    return tuple(s.name for s in structure.states if s.memory)


def initial_slope(t: FloatArray, v: FloatArray) -> float:
    """Rate of the voltage at the start [V/s]: the smallest of the first three, 0 if they disagree.

    So a record that starts in motion starts in motion, and one that starts with a step at rest.
    """
    rates = np.diff(v[:4]) / np.diff(t[:4])
    if np.all(rates > 0) or np.all(rates < 0):
        return float(rates[np.argmin(np.abs(rates))])
    return 0.0


def start_on(
    model: Model, t: FloatArray, u: FloatArray, memory: Mapping[str, float] | None = None
) -> Start:
    """Return the initial state for samples u (n, nu) at times t (n,) [s].

    The first inputs and the rates at which they begin put the model there (`start_state`). An
    imported FMU starts at its start values.
    """
    if model.structure.foreign:
        x = np.array([s.start for s in model.structure.states])
        none = np.zeros((len(x), len(memory_names(model.structure))))
        return Start(x, np.zeros((len(x), len(model.parameter_names))), none)
    rates = [initial_slope(t, u[:, i]) for i in range(u.shape[1])]
    return start_state(model, list(u[0]), rates, memory, float(t[0]))


def start_for(model: Model, t: FloatArray, u: FloatArray, deviations: Mapping[str, float]) -> Start:
    """Return the start for samples u (n, nu) at times t (n,) [s], and deviations of some states.

    A stack starts where the first inputs and their rates put it (`start_on`); any other model at
    its declared starts, but for the filters of effects, which begin where they would rest.
    """
    names = model.state_names
    if not is_stack(model):
        result = _declared(model, u[0], deviations)
        return Start(
            result.x, result.by_parameter, result.by_start[:, [*map(names.index, deviations)]]
        )
    memories = memory_names(model.structure)
    start = start_on(model, t, u, {n: deviations.get(n, 0.0) for n in memories})
    x, moved = start.x.copy(), np.zeros((len(names), len(deviations)))
    for column, (name, deviation) in enumerate(deviations.items()):
        if name in memories:
            moved[:, column] = start.by_start[:, memories.index(name)]
        else:
            x[names.index(name)] += deviation
            moved[names.index(name), column] = 1.0
    return Start(x, start.by_parameter, moved)


def is_stack(model: Model) -> bool:
    """Whether a model has a stack's voltage, and the sum that is its displacement."""
    s = model.structure
    return "voltage" in model.input_names and "displacement" in s.balances and not s.foreign


def resting_states(structure: Structure) -> tuple[str, ...]:
    """Return the states of effects that start where they would rest."""
    effects = [c for c in structure.components if c.gain is not None]
    return tuple(s.name for c in effects for s in c.states if not s.memory)


def _declared(model: Model, inputs: FloatArray, deviations: Mapping[str, float]) -> Start:
    """Return the start at the declared values and deviations, with derivatives by all states.

    x_0 = declared start + deviation; filters of effects start where they would rest, from there:
    g(x_s, x_0, u_0, p) = 0 with g their rates.
    """
    s = model.structure
    away = np.array([deviations.get(q.name, 0.0) for q in s.states])
    x = np.array([q.start for q in s.states]) + away
    p, nx = model.parameter_vector(), len(s.states)
    by_p, by_x = np.zeros((nx, len(p))), np.eye(nx)
    names = resting_states(s)
    resting = [k for k, q in enumerate(s.states) if q.name in names]
    if not resting:
        return Start(x, by_p, by_x)
    rest = _rest(s)
    for _ in range(_FILTER_STEPS):
        rates, slopes, _ = (np.array(a) for a in rest(0.0, x, inputs, p))
        move = np.linalg.lstsq(slopes[:, resting], -rates[:, 0], rcond=None)[0]
        x[resting] += move
        if np.max(np.abs(move) / np.maximum(np.abs(x[resting]), 1e-9)) < 1e-12:
            break
    _, slopes, by_parameter = (np.array(a) for a in rest(0.0, x, inputs, p))
    if not np.isfinite(x).all():
        raise PsaError("The effects' states have no rest at the start; change the values.")
    others = [k for k in range(nx) if k not in resting]
    inverse = np.linalg.pinv(slopes[:, resting])
    by_p[resting] = -inverse @ by_parameter
    by_x[np.ix_(resting, others)] = -inverse @ slopes[:, others]
    by_x[np.ix_(resting, resting)] = np.eye(len(resting))
    x[resting] += away[resting]
    return Start(x, by_p, by_x)


@cache
@in_turn
def _rest(structure: Structure) -> ca.Function:
    """Casadi function (t, x, u, p) -> rates of the resting states, their slopes by x and by p."""
    names = resting_states(structure)
    rows = [k for k, s in enumerate(structure.states) if s.name in names]
    rates = structure.xdot[rows]
    return ca.Function(
        "rest",
        [structure.time, structure.x, structure.u, structure.p],
        [rates, *(ca.densify(structure.jacobian(rates, by)) for by in (structure.x, structure.p))],
    )


def start_state(
    model: Model,
    inputs: Sequence[float],
    rates: Sequence[float] | None = None,
    memory: Mapping[str, float] | None = None,
    time: float = 0.0,
) -> Start:
    """Return the initial state for inputs (nu,) that change at `rates` (nu,).

    Solves f_s(x_s, m) = w_s for the states without memory, where w_s is the steady rate that the
    inputs' rates cause, by Newton's method; the derivatives follow from the same linear systems.
    The memories that settle are solved for first: their deviations count from where they would be.

    Raises PsaError where there is no equilibrium, InputError for an imported FMU.
    """
    structure = model.structure
    if structure.foreign:
        raise InputError(
            "An imported FMU has no second derivatives, which a settled start needs; it can only"
            " begin at its start values."
        )
    names = memory_names(structure)
    deviation = [(memory or {}).get(n, 0.0) for n in names]
    begin = [time], inputs, rates or [0.0] * len(inputs), deviation
    final, by_p, by_memory = _begin(
        model,
        _start_functions(structure),
        model.parameter_vector()[:, None],
        model.state_nominals()[:, None],
        [np.array(q, dtype=float)[:, None] for q in begin],
    )
    return Start(final[:, 0], by_p, by_memory)


def starts_on(
    model: Model, p: FloatArray, nominal: FloatArray, t: FloatArray, u: FloatArray
) -> FloatArray:
    """Return initial states (nx, m) for parameters p (np, m) and inputs u (n, nu) at times t (n,).

    `nominal` (nx, m) are the states' usual sizes. A column has the bits of `start_on` for a model
    with these parameters, in a fraction of its time. Raises PsaError where a set has no
    equilibrium.
    """
    structure = model.structure
    if structure.foreign:
        return np.tile([[s.start] for s in structure.states], p.shape[1])
    rates = np.array([initial_slope(t, column) for column in u.T])
    begin = t[:1], u[0], rates, np.zeros(len(memory_names(structure)))
    x = np.empty((len(structure.states), p.shape[1]))
    for first in range(0, p.shape[1], _CHUNK):
        part = slice(first, first + _CHUNK)
        sets = p[:, part].shape[1]
        columns = [np.repeat(a[:, None], sets, axis=1) for a in begin]
        functions = _functions_of_many(structure, sets)
        x[:, part] = _begin(model, functions, p[:, part], nominal[:, part], columns)[0]
    return x


def _begin(
    model: Model,
    functions: tuple[ca.Function, ca.Function, ca.Function],
    p: FloatArray,
    nominal: FloatArray,
    begin: Sequence[FloatArray],
) -> list[FloatArray]:
    """Return what the last of `_start_functions` gives, a column for each of p (np, m).

    `begin` holds time, inputs, rates and memory deviations, in columns.
    """
    settle, rest, moving = functions
    time, u, rates, deviation = begin
    gains = [model.parameter_names.index(c.gain) for c in model.effects if c.gain]
    without = p.copy()
    without[gains] = 0.0  # a saturating effect would lead Newton's method astray from far away
    every = np.ones(p.shape[1], dtype=bool)
    x = np.zeros(nominal.shape, order="F")
    if np.any(p[gains]):
        strong = np.any(p[gains] != 0.0, axis=0)
        _to_rest(_Call(settle, time, x, u, without, deviation), x, nominal, strong)
    _to_rest(_Call(settle, time, x, u, p, deviation), x, nominal, every)
    settled = x.copy(order="F")
    if any(s.memory and s.settles for s in model.structure.states):
        _to_rest(_Call(rest, time, x, u, p, deviation, settled), x, nominal, every)
    return _Call(moving, time, x, u, p, deviation, settled, rates)()


class _Call:
    """One function with dense results, evaluated in place for what its arguments hold now.

    An ordinary call takes five times as long, most of it for its arguments. A call belongs to one
    thread. Arguments are taken column by column, as CasADi has its numbers.
    """

    def __init__(self, function: ca.Function, *arguments: FloatArray) -> None:
        self._buffer: Any
        self._buffer, self._run = function.buffer()
        self._arguments = [np.asfortranarray(a) for a in arguments]
        shapes = [function.size_out(i) for i in range(function.n_out())]
        self._results = [np.zeros(shape, order="F") for shape in shapes]
        for i, argument in enumerate(self._arguments):
            self._buffer.set_arg(i, argument.reshape(-1, order="F").data)
        for i, result in enumerate(self._results):
            self._buffer.set_res(i, result.reshape(-1, order="F").data)

    def __call__(self) -> list[FloatArray]:
        self._run()
        return self._results


def _to_rest(newton: _Call, x: FloatArray, nominal: FloatArray, moves: BoolArray) -> None:
    """Follow Newton's method from each column of x that moves, in place, to where it ends."""
    moves = moves.copy()
    change = np.where(moves, np.inf, 0.0)
    for _ in range(_NEWTON_STEPS):
        new = newton()[0]
        with np.errstate(invalid="ignore"):  # overflow ends in nan, which is no equilibrium
            step = np.max(np.abs(new - x) / (np.abs(new) + nominal), axis=0, initial=0.0)
        change[moves] = step[moves]
        x[:, moves] = new[:, moves]
        moves &= change > 1e-13
        if not moves.any():
            break
    if not (change < 1e-9).all():
        raise PsaError(
            "The state at the start of the record has no equilibrium; the parameter values are the"
            " likely cause: check them."
        )


def settling_time(model: Model) -> float:
    """Return the slowest time constant [s] of the states without memory, at rest.

    The inputs have their start values.
    """
    time, _, *others = model.at_start()
    fast = [i for i, state in enumerate(model.structure.states) if not state.memory]
    slopes = np.array(model.structure.slopes(time, 0.0, *others)[0])[np.ix_(fast, fast)]
    decay = -np.linalg.eigvals(slopes).real
    return float(1.0 / np.min(decay)) if np.all(decay > 0) else float("inf")


@cache
@in_turn
def _start_functions(structure: Structure) -> tuple[ca.Function, ca.Function, ca.Function]:
    """Return a Newton step for all that settles, one for the states without memory, the motion."""
    s = structure
    memory = [i for i, state in enumerate(s.states) if state.memory]
    settling = [i for i, state in enumerate(s.states) if not state.memory or state.settles]
    fast = [i for i, state in enumerate(s.states) if not state.memory]
    deviation = ca.SX.sym("deviation", len(memory))
    known = ca.SX.sym("settled", len(s.states))
    where = [s.time, s.x, s.u, s.p, deviation]
    slopes = _slopes(s)
    by_x, by_u = ca.jacobian(slopes, s.x), ca.jacobian(slopes, s.u)

    def newton(rows: list[int], x: Expression) -> Expression:
        """A Newton step for the rows' derivatives to vanish; its derivative is the implicit one."""
        return _moved(x, rows, -ca.solve(_at(s, by_x[rows, rows], x), _at(s, slopes, x)[rows]))

    # memories that do not settle are at their deviation, those that do count it from where they do
    held = {i: deviation[k] for k, i in enumerate(memory) if not s.states[i].settles}
    placed = _put(s.x, held)
    first = newton(settling, placed)
    settle = ca.Function("settle", where, [ca.densify(first)])
    settled = ca.substitute([first], [s.x], [known])[0]
    free = {i: settled[i] + deviation[k] for k, i in enumerate(memory) if s.states[i].settles}
    start = newton(fast, _put(placed, free))
    rest = ca.Function("rest", [*where, known], [ca.densify(start)])
    rate = ca.SX.sym("rate", len(s.inputs))
    moving: Expression = start
    jacobian, by_input = _at(s, by_x, start), _at(s, by_u, start)
    of_fast = jacobian[fast, fast]
    for _ in range(2):
        drive = by_input[fast, :] @ rate
        if memory:
            drive += jacobian[fast, memory] @ _at(s, slopes, moving)[memory]
        # a steady motion lags behind the rest by the rates it takes
        moving = _moved(start, fast, _solved(of_fast, -_solved(of_fast, drive)))
    derivatives: list[Expression] = [ca.jacobian(moving, s.p), ca.jacobian(moving, deviation)]
    results = [ca.densify(e) for e in (moving, *derivatives)]
    return settle, rest, ca.Function("moving", [*where, known, rate], results)


@lru_cache(maxsize=64)
@in_turn
def _functions_of_many(
    structure: Structure, sets: int
) -> tuple[ca.Function, ca.Function, ca.Function]:
    """Return the functions of `start_state` for `sets` columns, the last without derivatives."""
    settle, rest, moving = _start_functions(structure)
    inputs = moving.sx_in()
    start = ca.Function("start", inputs, [moving.call(inputs)[0]])
    return settle.map(sets), rest.map(sets), start.map(sets)


def _slopes(s: Structure) -> Expression:
    """Return x' with the sampled states at their start values."""
    if not s.sampled:
        return s.xdot
    return ca.substitute([s.xdot], [s.z], [ca.SX([q.start for q in s.sampled])])[0]


def _at(s: Structure, expression: Expression, x: Expression) -> Expression:
    return ca.substitute([expression], [s.x], [x])[0]


def _put(x: Expression, values: Mapping[int, Expression]) -> Expression:
    """Return x with values in some places."""
    return ca.vertcat(*[values.get(i, part) for i, part in enumerate(ca.vertsplit(x))])


def _moved(x: Expression, places: list[int], by: Expression) -> Expression:
    """Return x with some places moved."""
    return _put(x, {i: x[i] + by[k] for k, i in enumerate(places)})


def _solved(matrix: Expression, right: Expression) -> Expression:
    """Return matrix^-1 right, refined once.

    CasADi orthogonalises the columns one by one, which loses digits as the condition grows (to 3e11
    with every effect). A rest is corrected by the next step; nothing corrects a motion.
    """
    first = ca.solve(matrix, right)
    return first + ca.solve(matrix, right - matrix @ first)


@dataclass(frozen=True, eq=False)
class LinearPart:
    """x' = a x + b v, d = c x: voltage to displacement, hysteresis forces held at rest."""

    a: FloatArray
    b: FloatArray
    c: FloatArray

    def response(self, omega: FloatArray) -> ComplexArray:
        """Return displacement over voltage [m/V] at angular frequencies (n,) [rad/s]."""
        identity = np.eye(len(self.a))
        systems = 1j * omega[:, None, None] * identity - self.a
        right = np.broadcast_to(self.b[:, None].astype(complex), (len(omega), len(self.b), 1))
        return np.asarray(np.linalg.solve(systems, right)[:, :, 0] @ self.c)


def linear_part(model: Model) -> LinearPart:
    """Linearise a stack at rest at 0 V; states that rest at any value (hysteresis) are left out."""
    kept = [k for k, s in enumerate(model.structure.states) if not s.memory or s.settles]
    a, b, c = slopes_at_rest(model)
    return LinearPart(a[np.ix_(kept, kept)], b[kept], c[kept])


def slopes_at_rest(model: Model) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return d xdot / d x (nx, nx), d xdot / d voltage (nx,), d displacement / d x (nx,)."""
    starts = [i.start for i in model.structure.inputs]
    x = start_state(model, starts).x
    a, b, c, _ = model.structure.slopes(0.0, x, starts, model.parameter_vector())
    row, column = model.output_names.index("displacement"), model.input_names.index("voltage")
    return np.array(a), np.array(b)[:, column], np.array(c)[row]
