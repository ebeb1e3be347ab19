"""What one more effect adds to a model's outputs, along the model's trajectory.

An effect with the gain g and the states z, at the balances b of a model x' = f(x), y = h(x),

    x' = f(x) + sum_b f_b T_b(x, z),    z' = A z + r(x),    T_b = 0 at g = 0

is not compiled: z and T_b come from the model's states at the samples, and the model, compiled once
with an input at each of the balances, answers to them. For the derivatives by g the inputs are
those of T_b, and the answer is the tangent of the model (the variational equation of x); for a
finite g they are T_b itself, where nothing that the effect reads follows from what it adds. Between
samples, inputs and r are straight lines.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import scipy

from psa_casadi.common.symbolic import in_turn, instructions
from psa_casadi.common.units import FloatArray
from psa_casadi.model.component import Component, Equations, Expression, Symbols
from psa_casadi.model.compose import Model
from psa_casadi.model.structure import Structure, structure_of
from psa_casadi.model.variables import Input, Parameter
from psa_casadi.simulation.exact.run import time_steps
from psa_casadi.simulation.exact.split import closure, dependence, split_of
from psa_casadi.simulation.simulate import Way, trace
from psa_casadi.simulation.start import start_for

_GAIN, _INPUT = "tangent_gain", "tangent_"

#: Rates of r at a sample count up to this many times its change from one sample to the next, there
#: or at a neighbour: beyond is a jump, which the samples do not show.
_STEEPEST = 2.0
_SAME = (
    "sqrt", "exp", "log", "fabs", "fmin", "fmax", "fmod", "sin", "cos", "tan", "sinh", "cosh",
    "tanh", "sign", "floor", "ceil", "log1p", "expm1", "hypot",
)  # fmt: skip
_OTHERS = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "neg": np.negative,
    "sq": np.square, "twice": lambda a: 2.0 * a, "inv": lambda a: 1.0 / a, "assign": lambda a: a,
    "pow": np.power, "constpow": np.power, "asin": np.arcsin, "acos": np.arccos,
    "atan": np.arctan, "atan2": np.arctan2, "lt": np.less, "le": np.less_equal, "eq": np.equal,
    "ne": np.not_equal, "not": np.logical_not, "and": np.logical_and, "or": np.logical_or,
    "if_else_zero": lambda c, a: np.where(c, a, 0.0),
}  # fmt: skip
_OPERATIONS: dict[int, Callable[..., Any]] = {
    getattr(ca, f"OP_{name.upper()}"): operation
    for name, operation in ({n: getattr(np, n) for n in _SAME} | _OTHERS).items()
}


class Along:
    """Expressions (size,) of symbols, evaluated for many samples at once. Raises KeyError.

    An operation that numpy does not have is none of these.
    """

    def __init__(self, arguments: Sequence[Expression], expression: Expression) -> None:
        f = ca.Function("f", list(arguments), ca.cse([ca.densify(ca.vec(ca.SX(expression)))]))
        self.size = f.numel_out(0)
        self._steps: list[tuple[Any, Any, Any]] = []
        for op, inputs, kept in instructions(f):
            if op in (ca.OP_CONST, ca.OP_INPUT, ca.OP_OUTPUT):
                self._steps.append((op, inputs, kept[-1]))
            else:
                self._steps.append((_OPERATIONS[op], inputs, kept[0]))

    def __call__(self, n: int, *arguments: FloatArray) -> FloatArray:
        """Return the values (n, size); arguments (elements, n), or (elements,) where constant."""
        slots: dict[int, Any] = {}
        values = np.empty((n, self.size))
        with np.errstate(all="ignore"):  # the caller checks that all is finite
            for op, inputs, kept in self._steps:
                if op == ca.OP_CONST:
                    slots[kept] = inputs[0]
                elif op == ca.OP_INPUT:
                    slots[kept] = arguments[inputs[0]][inputs[1]]
                elif op == ca.OP_OUTPUT:
                    values[:, kept] = slots[inputs[0]]
                else:
                    slots[kept] = op(*(slots[a] for a in inputs))
        return values


@dataclass(frozen=True, eq=False)
class Law:
    """An effect that is looked for in a model: what it adds, as functions of (t, x, u, p).

    `slopes` returns A (nz, nz), `rest` r (nz,); `added` the terms (balances,), `by_gain` their
    derivatives by the parameters `moved`. One that reaches no state of the model has the outputs
    (ny,) in their place, and no `balances`. `forward`: it reads nothing that it moves.
    """

    structure: Structure
    moved: tuple[str, ...]
    states: tuple[int, ...]
    balances: tuple[str, ...]
    forward: bool
    slopes: Along
    rest: Along
    turning: Along
    added: Along
    by_gain: Along


@cache
@in_turn
def law_of(structure: Structure, effect: Component) -> Law | None:
    """Return the law of an effect of a composed model; None of one that must be simulated in full.

    Those are the effects whose states are not linear in themselves with constant coefficients,
    that are sampled, jump or call an FMU, and those at whose balances no input leaves the model its
    exact steps.
    """
    s, names = structure, [q.name for q in structure.states]
    if s.sampled or s.foreign or effect.outputs or effect.gain is None:
        return None
    written = effect.equations(Symbols(s.symbols))
    balances, terms = tuple(written.add), ca.vertcat(ca.SX(0, 1), *written.add.values())
    states = tuple(names.index(q.name) for q in effect.states)
    others = [k for k in range(len(names)) if k not in states]
    moved = effect.linear or (effect.gain,)
    by = ca.vertcat(*(s.symbols[n] for n in moved))
    z, rates = s.x[list(states), 0], s.xdot[list(states), 0]
    slopes = s.jacobian(rates, z)
    if written.switches or ca.depends_on(slopes, ca.vertcat(s.x, s.u, s.time)):
        return None
    sums = ca.vertcat(*(s.symbols[n] for n in s.sums)), ca.vertcat(*s.sums.values())
    added, by_gain = ca.substitute([terms, s.jacobian(terms, by)], [sums[0]], [sums[1]])
    reach = closure(dependence(s.xdot, s.x))
    reached = [k for k in others if ca.depends_on(s.xdot[k], by)]
    # an output is the rate of the displacement, which inputs there have not
    if reached and ("displacement" in balances or not _stays_exact(s, effect, balances)):
        return None
    behind = [k for k in others if k in reached or any(reach[k, j] for j in reached)]
    forward = not ca.depends_on(ca.vertcat(rates, added), s.x[behind])
    if not reached:
        balances, added, by_gain = (), s.y, s.jacobian(s.y, by)
    rest = ca.substitute([rates], [z], [ca.SX.zeros(len(states))])[0]
    ramp = ca.SX.sym("ramp", s.u.shape[0])
    every, moves = ca.vertcat(s.time, s.x, s.u), ca.vertcat(1, s.xdot, ramp)
    functions = (slopes, rest, ca.jtimes(rest, every, moves), added, by_gain)
    try:
        made = [Along([*s.arguments, ramp], e) for e in functions]
    except KeyError:
        return None
    return Law(s, moved, states, balances, forward, *made)


def _stays_exact(structure: Structure, effect: Component, balances: tuple[str, ...]) -> bool:
    """Whether inputs at balances leave a model without an effect the way that it is run."""
    parts = tuple(c for c in structure.components if c is not effect)
    if isinstance(split_of(structure_of(parts)), str):
        return True
    table = structure.balance_table
    opened = structure_of((*parts, _inputs_at(tuple((b, table[b].unit) for b in balances))))
    return not isinstance(split_of(opened), str)


@cache
def _inputs_at(balances: tuple[tuple[str, str], ...]) -> Component:
    """Return the component that adds an input, times a gain, to each of some balances."""

    def equations(s: Symbols) -> Equations:
        return Equations(add={b: getattr(s, _GAIN) * getattr(s, _INPUT + b) for b, _ in balances})

    return Component(
        name="tangent",
        description="inputs at the balances that effects add to",
        source="variational equation of the model",
        equations=equations,
        parameters=(Parameter(_GAIN, 0.0, "1", (0.0, 1.0), "1 with the inputs"),),
        inputs=tuple(Input(_INPUT + b, unit, f"what is added to {b}") for b, unit in balances),
        gain=_GAIN,
    )


@dataclass(frozen=True, eq=False)
class Course:
    """A model's states `x` (n, nx) over times `t` (n,) with inputs `u` (n, nu), held as `hold`."""

    t: FloatArray
    u: FloatArray
    x: FloatArray
    hold: str


def course_of(
    model: Model, t: FloatArray, u: FloatArray, start: Mapping[str, float], *, way: Way, hold: str,
    outputs: Sequence[str],
) -> Course:  # fmt: skip
    """Return a model's course over times t (n,) [s], inputs u (n, nu); `start` as in `start_for`.

    Raises SimulationError.
    """
    x0 = start_for(model, t, u, start).x
    x = trace(model, t, u, x0, way=way, outputs=outputs, hold=hold, everything=True).x
    return Course(t, u, x, hold)


def opened(model: Model, laws: Iterable[Law]) -> Model:
    """Return a model with an input at every balance to which one of the laws adds."""
    table = model.structure.balance_table
    balances = sorted({b for law in laws for b in law.balances})
    if not balances:
        return model
    units = tuple((b, table[b].unit) for b in balances)
    return model.with_components((*model.components, _inputs_at(units)))


@dataclass(frozen=True, eq=False)
class Answer:
    """What an effect makes of the outputs (n, outputs, moved), and the share it may err by.

    That is what straight lines between the samples miss of the terms, over their size: a quarter of
    what lines between every second one miss, and the change of the terms where the effect's
    states come from every second one.
    """

    y: FloatArray
    error: float


def answer(
    model: Model,
    law: Law,
    effect: Model,
    course: Course,
    u: FloatArray,
    start: Mapping[str, float],
    *,
    finite: bool,
    way: Way,
    outputs: Sequence[str],
) -> Answer:
    """Return what an effect makes of the outputs of an `opened` model along its course.

    That is their derivatives by what the law moves, or, of a `finite` gain, the outputs. `effect`
    is the model with the effect, at its values, `u` (n, inputs) are the samples of its inputs,
    `start` deviations as in `start_for`. Raises NotExact where the times are too uneven for the
    effect's states, and SimulationError.
    """
    t, names = course.t, effect.state_names
    others = [k for k in range(len(names)) if k not in law.states]
    x = np.zeros((len(names), len(t)))
    x[others] = course.x.T
    begin = start_for(effect, t, u, start) if law.states else None
    z0, p = begin.x[list(law.states)] if begin else np.zeros(0), effect.parameter_vector()
    terms = _terms(law, t, x, u.T, p, z0, finite=finite)
    if not law.balances:
        rows = [effect.output_names.index(name) for name in outputs]
        return Answer(terms[:, :, rows].transpose(0, 2, 1), 0.0)
    misfit = 0.25 * _size(0.5 * (terms[:-2:2] + terms[2::2]) - terms[1:-1:2])
    if law.states:
        half = _terms(law, t[::2], x[:, ::2], u[::2].T, p, z0, finite=finite)
        misfit = max(misfit, _size(terms[::2] - half))
    places = [model.input_names.index(_INPUT + b) for b in law.balances]
    answers = []
    for k, columns in enumerate(terms.transpose(1, 0, 2)):
        inputs = np.zeros((len(t), len(model.input_names)))
        inputs[:, : course.u.shape[1]] = course.u
        inputs[:, places] = columns
        run_with = model.with_values({_GAIN: float(finite)})
        if begin:
            x0, slopes, gain = begin.x[others], begin.by_parameter[others], law.moved[k]
            s0 = slopes[:, [effect.parameter_names.index(gain)]]
        else:
            first = start_for(run_with, t, inputs, start)
            x0, s0 = first.x, first.by_parameter[:, [model.parameter_names.index(_GAIN)]]
        traced = trace(
            run_with, t, inputs, x0, way=way, outputs=outputs, hold=course.hold,
            unknowns=() if finite else (_GAIN,), s0=None if finite else s0,
        )  # fmt: skip
        answers.append(traced.y if finite else traced.sensitivity[:, :, 0])
    size = _size(terms - np.mean(terms, axis=0))
    return Answer(np.stack(answers, axis=2), misfit / max(size, 1e-300))


def _size(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0


def _terms(
    law: Law, t: FloatArray, x: FloatArray, u: FloatArray, p: FloatArray, z0: FloatArray,
    *, finite: bool,
) -> FloatArray:  # fmt: skip
    """Return the terms of a law (n, moved, size) along x (nx, n) and u (nu, n), from z0 on."""
    x = x.copy()
    x[list(law.states)] = 0.0
    if law.states:
        x[list(law.states)] = _own_states(law, t, x, u, p, z0).T
    function, count = (law.added, 1) if finite else (law.by_gain, len(law.moved))
    return function(len(t), t[None], x, u, p).reshape(len(t), count, -1)


def _own_states(
    law: Law, t: FloatArray, x: FloatArray, u: FloatArray, p: FloatArray, z0: FloatArray
) -> FloatArray:
    """Return an effect's states (n, nz) along x (nx, n), in which they are 0, and u (nu, n)."""
    n, m, ramps = len(t), len(law.states), np.diff(u) / np.diff(t)
    ends = slice(None, -1), slice(1, None)
    rest = law.rest(n, t[None], x, u, p)
    turns = [law.turning(n - 1, t[None, at], x[:, at], u[:, at], p, ramps) for at in ends]
    slopes = law.slopes(1, t[None, :1], x[:, :1], u[:, :1], p).reshape(m, m).T
    return _followed(slopes, rest, turns, z0, t)


def _followed(
    slopes: FloatArray, rest: FloatArray, turns: Sequence[FloatArray], z0: FloatArray, t: FloatArray
) -> FloatArray:
    """Return z (n, nz) of z' = A z + r(t) from z0 on.

    Between samples r (n, nz) is the cubic with the rates `turns` (n - 1, nz) at either end,
    r = sum_j c_j s^j. With E = exp(h A) and the integrals P_j = int exp((h - s) A) s^j ds all steps
    z_(k+1) = E z_k + sum_j P_j c_j are one triangular system of equations.
    """
    n, m = rest.shape
    lengths, which = time_steps(t)
    band = np.zeros((2 * m, n * m))
    right = np.empty((n, m))
    right[0] = z0
    moved = np.abs(np.diff(rest, axis=0))
    others = np.pad(moved, ((1, 1), (0, 0)))
    most = _STEEPEST * np.maximum(moved, np.maximum(others[:-2], others[2:]))
    for k, h in enumerate(lengths):
        at = np.flatnonzero(which == k)
        begin, end, up, down = rest[at], rest[at + 1], h * turns[0][at], h * turns[1][at]
        up, down = (np.where(np.abs(q) > most[at], end - begin, q) for q in (up, down))
        powers = begin, up, 3 * (end - begin) - 2 * up - down, 2 * (begin - end) + up + down
        whole = np.zeros((5 * m, 5 * m))
        whole[:m, :m] = h * slopes
        for j in range(4):  # s/h: chain of integrators, whose last one is 1
            whole[j * m : (j + 1) * m, (j + 1) * m : (j + 2) * m] = max(j, 1) * np.eye(m)
        e, *integrals = np.split(scipy.linalg.expm(whole)[:m], 5, axis=1)
        right[at + 1] = h * sum(c @ q.T for c, q in zip(powers, integrals, strict=True))
        for i in range(m):
            for j in range(m):
                band[m + i - j, at * m + j] = -e[i, j]
    result, _ = scipy.linalg.lapack.dtbtrs(band, right.reshape(-1, 1), uplo="L", diag="U")
    states: FloatArray = result.reshape(n, m)
    return states
