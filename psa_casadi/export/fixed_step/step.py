"""One step of fixed length as an expression: a model's exact step with nothing left to decide.

The linear part is taken exactly: with L' = M L + g(t) and g = r + s t + q t^2 added to M L(0), the
change over h is E_1 r + E_2 s + 2 E_3 q, where E_k is the k-fold integral of exp(M t) over the
step: one exponential of M with three integrators (van Loan, IEEE Trans. Automatic Control 23 (1978)
395). States along a driver's way (hysteresis) take two Rosenbrock steps of fourth order over it,
which meet where the driver turns, else in the middle. A port's values at start, half and end make a
parabola in time. Ports that feed back to what they depend on take two Newton steps. So every step
costs the same, whatever happens in it.

What does not split into a linear part and states along a way (a hysteresis that acts back on
its voltage, a limit of an amplifier, a stop) takes one Rosenbrock step as a whole. It is L-stable,
so that fast lags settle and jumps of an input stay bounded. A kink inside a step is not looked for:
the step has order two there, which the comparison at export measures, and substeps make small.

Source: the exact steps of `simulation/exact`, whose choices are made once, at export.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import casadi as ca
import numpy as np
import scipy

from psa_casadi.common.units import FloatArray
from psa_casadi.model.component import Expression
from psa_casadi.model.compose import Model
from psa_casadi.model.structure import Structure
from psa_casadi.model.variables import Input
from psa_casadi.simulation.exact.split import Split, closure, jumping, split_of

#: Shortest leg over a step: below it a rate has no meaning, and nothing happens.
_SHORTEST = 1e-6
#: The Rosenbrock method, in the form without products of the Jacobian: 1/gamma, instants of the
#: stages, weights of earlier stages in their states and in their right sides, of the derivative by
#: time, and of the stages in the end. The last stage has the value of the one before.
_DIAGONAL = 1.0 / 0.57282
_AT = (0.0, 1.14564, 0.65521686381559)
_STATES = ((), (2.0,), (1.867943637803922, 0.2344449711399156))
_RIGHT = (
    (),
    (-7.137615036412310,),
    (2.580708087951457, 0.6515950076447975),
    (-2.137148994382534, -0.3214669691237626, -0.6949742501781779),
)
_BY_TIME = (0.57282, -1.769193891319233, 0.7592633437920482, -0.1049021087100450)
_END = (2.255570073418735, 0.2870493262186792, 0.4353179431840180, 1.093502252409163)


@dataclass(frozen=True, eq=False)
class Ends:
    """A step of `step` [s] from time, states x and inputs u of `of`, which change by `du`.

    `half` and `whole` are what the states known so far have changed by there.
    """

    of: Structure
    step: float
    du: Expression
    half: Expression
    whole: Expression


def along_the_way(
    ends: Ends,
    driver: int,
    states: Sequence[int],
    rates: tuple[Expression, Expression, Expression],
    slopes: ca.Function,
) -> tuple[Expression, Expression]:
    """Return what the states along a driver's way have changed by at half and end, (n,) each.

    `driver` and `states` are indices, `rates` the driver's at start, half and end, `slopes` is the
    function (time, x, u, rate) of the states' derivatives.
    """
    s, half, count = ends.of, ends.half[driver], ends.of.x.numel()
    turned, share, turn = _turn(rates, half, ends.whole[driver], ends.step)
    # where the legs meet: parabolas in time, but for the driver
    change = 4.0 * share * (1.0 - share) * ends.half + share * (2.0 * share - 1.0) * ends.whole
    parts = [s.x[i] + change[i] for i in range(count)]
    parts[driver] = s.x[driver] + turn
    meeting = ca.vertcat(*parts)

    def shifted(x: Expression, moved: Expression) -> Expression:
        """Return states of which those along the way have changed by so much."""
        parts = [x[i] for i in range(count)]
        for place, i in enumerate(states):
            parts[i] = parts[i] + moved[place]
        return ca.vertcat(*parts)

    def leg(
        origin: Expression, target: Expression, begin: Expression, share: Expression
    ) -> tuple[Expression, Expression, Expression]:
        """Return the driver's way over a leg, the states' changes at its begin's slopes, and all.

        States that are not along the way go on a line from `origin` to `target`, from `begin` on
        for `share`.
        """
        duration = share * ends.step
        way = target[driver] - origin[driver]
        rate = way / ca.fmax(duration, _SHORTEST * ends.step)
        theta, gone = ca.SX.sym("theta"), ca.SX.sym("gone", len(states))
        when = begin + theta * share
        parts = [origin[i] + theta * (target[i] - origin[i]) for i in range(count)]
        for i in states:
            parts[i] = origin[i]
        x = shifted(ca.vertcat(*parts), gone)
        inputs = (s.time + when * ends.step, x, s.u + when * ends.du, rate)
        return way, *rosenbrock(duration * slopes(*inputs), theta, gone)

    first = leg(s.x, meeting, ca.SX(0), share)
    last = leg(shifted(meeting, first[2]), s.x + ends.whole, share, 1.0 - share)
    # at the half: a parabola over the way of the leg that it lies on
    inside = share > 0.5
    way, straight, moved = (ca.if_else(inside, a, b) for a, b in zip(first, last, strict=True))
    gone = ca.if_else(inside, half, half - turn)
    done = ca.fmin(ca.fmax(gone / ca.if_else(way == 0.0, 1.0, way), 0.0), 1.0)
    behind = ca.if_else(inside, 0.0, first[2])
    on_leg = done * (straight + done * (moved - straight))
    return ca.if_else(turned, behind + on_leg, first[2]), first[2] + last[2]


def _turn(
    rates: tuple[Expression, Expression, Expression],
    half: Expression,
    whole: Expression,
    step: float,
) -> tuple[Expression, Expression, Expression]:
    """Return whether the driver turns, at which share of the step, and its change by then.

    The turn is the rate's zero in a half of the step, the change Hermite's cubic there.
    """
    start, middle, end = rates
    early, late = start * middle < 0.0, middle * end < 0.0
    turned = ca.logic_or(early, late)
    before, after = ca.if_else(early, start, middle), ca.if_else(early, middle, end)
    low, high = ca.if_else(early, 0.0, half), ca.if_else(early, half, whole)
    local = before / ca.if_else(turned, before - after, 1.0)
    rest, length = 1.0 - local, 0.5 * step
    way = (
        rest * rest * (1.0 + 2.0 * local) * low
        + local * local * (3.0 - 2.0 * local) * high
        + local * rest * length * (rest * before - local * after)
    )
    share = ca.if_else(turned, ca.if_else(early, 0.0, 0.5) + 0.5 * local, 0.5)
    return turned, share, ca.if_else(turned, way, half)


def rosenbrock(
    value: Expression, theta: Expression, gone: Expression
) -> tuple[Expression, Expression]:
    """Return the change of states at their slopes of the begin, and over one Rosenbrock step.

    `value` (n,) are the derivatives by a share `theta` of the step, of which a change `gone` (n,)
    of the states has been made.
    """
    by_states, by_time = ca.jacobian(value, gone), ca.jacobian(value, theta)

    def at(share_of_leg: float, change: Expression, *wanted: Expression) -> list[Expression]:
        here = [ca.SX(share_of_leg), change]
        return list(ca.substitute(list(wanted), [theta, gone], here))

    start, j, slope = at(0.0, ca.SX.zeros(gone.numel()), value, by_states, by_time)
    system = _DIAGONAL * ca.SX.eye(gone.numel()) - j
    stages: list[Expression] = []
    last = start
    for i, right in enumerate(_RIGHT):
        if 0 < i < len(_STATES):
            (last,) = at(_AT[i], _weighted(_STATES[i], stages), value)
        stages.append(solved(system, last + _weighted(right, stages) + _BY_TIME[i] * slope))
    return start, _weighted(_END, stages)


def _weighted(weights: Sequence[float], stages: Sequence[Expression]) -> Expression:
    return sum((w * k for w, k in zip(weights, stages, strict=True)), ca.SX(0))


def solved(a: Expression, b: Expression) -> Expression:
    """Solve a small system by Gauss elimination without exchanges: its diagonal is the largest."""
    n = b.numel()
    rows = [[*(a[i, j] for j in range(n)), b[i]] for i in range(n)]
    for k in range(n):
        for i in range(k + 1, n):
            factor = rows[i][k] / rows[k][k]
            rows[i] = [q - factor * r for q, r in zip(rows[i], rows[k], strict=True)]
    x: list[Expression] = [ca.SX(0)] * n
    for k in reversed(range(n)):
        known = sum((rows[k][j] * x[j] for j in range(k + 1, n)), ca.SX(0))
        x[k] = (rows[k][n] - known) / rows[k][k]
    return ca.vertcat(*x)


def _responses(
    m: FloatArray, nominal: FloatArray, step: float, share: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return E_1, E_2 / step and 2 E_3 / step^2 (n, n each) at `share` of a `step` [s].

    `nominal` (n,) are the states' usual sizes, which scale the exponential. What M
    does not join is exactly 0.
    """
    n = len(m)
    scaled = m * nominal / nominal[:, None]
    system = np.zeros((4 * n, 4 * n))
    system[:n, :n] = scaled * step * share
    for k in range(3):
        system[k * n : (k + 1) * n, (k + 1) * n : (k + 2) * n] = np.eye(n)
    full = scipy.linalg.expm(system)
    joined = closure(m != 0.0)
    one, two, three = (
        np.where(joined, full[:n, k * n : (k + 1) * n] * nominal[:, None] / nominal, 0.0)
        for k in (1, 2, 3)
    )
    return one * step * share, two * step * share**2, 2.0 * three * step * share**3


#: Newton steps of ports that feed back.
_NEWTON = 2
#: Instants of a step, after its start, at which the ports are evaluated.
HALF, WHOLE = 0, 1
SHARES = (0.5, 1.0)


@dataclass(frozen=True, eq=False)
class StepExpression:
    """A step as expressions of its symbols; parameters are numbers.

    From time, states x (nx,), inputs u (nu,), all of the model's structure, the inputs' change
    `du` over the step and ports `port` (np,) at the start follow the states' `change` (nx,) and the
    ports `port_end` (np,). `low` (nx,) is what rounding took off x. `port_start` gives the ports
    from time, x and u.
    `port_names` are the states whose derivatives they are part of.
    """

    low: Expression
    du: Expression
    port: Expression
    change: Expression
    port_end: Expression
    port_start: Expression
    port_names: tuple[str, ...]


def with_numbers(model: Model, expression: Expression) -> Expression:
    """Return an expression with a model's values in place of its parameters."""
    p = model.structure.p
    return ca.substitute([ca.SX(expression)], [p], [ca.DM(model.parameter_vector())])[0]


class _Builder:
    """A step under construction: how each state has changed by the half and the end."""

    def __init__(self, model: Model, split: Split, step: float) -> None:
        self.model, self.split, self.step = model, split, step
        s = split.structure
        # the linear part L' = m L + b u + c + ports, with the model's values
        linear = ca.Function("linear", [s.p], list(split.matrices))
        self.m, self.b, self.c = (q.full() for q in linear(model.parameter_vector()))
        nominal = model.state_nominals()[list(split.linear)]
        self.responses = [_responses(self.m, nominal, step, share) for share in SHARES]
        self.low, self.du = ca.SX.sym("low", s.x.numel()), ca.SX.sym("du", s.u.numel())
        self.port = ca.SX.sym("port", len(split.ports))
        self.slope = self._first_slopes()
        # what the linear states have changed by, in their order, and all others in the model's
        self.moved = [
            _times(constant, self.slope) + _times(ramp, _times(self.b, self.du))
            for constant, ramp, _ in self.responses
        ]
        self.turned = [ca.SX.zeros(s.x.numel()) for _ in SHARES]
        self.ports = [ca.SX(self.port) for _ in SHARES]

    def built(self) -> StepExpression:
        s, split = self.split.structure, self.split
        for kind, members in split.order:
            if kind == "group":
                self._group(members[0])
            elif kind == "port":
                for node in range(len(SHARES)):
                    value = split.ports[members[0]].value
                    self.ports[node][members[0]] = self._at(node, value)
                self._respond(members[0])
            else:
                self._loop(members)
        start = [with_numbers(self.model, q.value) for q in split.ports]
        return StepExpression(
            low=self.low, du=self.du, port=self.port,
            change=self._change(WHOLE), port_end=self.ports[WHOLE],
            port_start=ca.vertcat(ca.SX(0, 1), *start),
            port_names=tuple(s.states[q.state].name for q in split.ports),
        )  # fmt: skip

    def _first_slopes(self) -> Expression:
        """Return L' at the start; the diagonal is taken out, so that rest is rest when rounded."""
        s, m, b = self.split.structure, self.m, self.b
        rows = list(self.split.linear)
        x, low = s.x[rows], self.low[rows]
        slopes = []
        for i in range(len(rows)):
            scale = m[i, i] or 1.0
            diagonal = x[i] if m[i, i] else ca.SX(0)
            others = sum(
                (m[i, j] / scale * x[j] for j in range(len(rows)) if j != i and m[i, j]), ca.SX(0)
            )
            inputs = sum((b[i, j] / scale * s.u[j] for j in range(b.shape[1]) if b[i, j]), ca.SX(0))
            rest = diagonal + inputs + others + self.c[i, 0] / scale
            slopes.append(scale * (rest + low[i] if m[i, i] else rest))
        for k, port in enumerate(self.split.ports):
            slopes[rows.index(port.state)] += self.port[k]
        return ca.vertcat(*slopes)

    def _change(self, node: int) -> Expression:
        """Return what all states have changed by at a node, as far as it is known."""
        parts = [self.turned[node][i] for i in range(self.split.structure.x.numel())]
        for k, i in enumerate(self.split.linear):
            parts[i] = self.moved[node][k]
        return ca.vertcat(*parts)

    def _at(self, node: int, expression: Expression) -> Expression:
        """Return an expression at a node, where the states have changed as far as it is known."""
        s, share = self.split.structure, SHARES[node]
        there = [s.time + share * self.step, s.x + self._change(node), s.u + share * self.du]
        numeric = with_numbers(self.model, expression)
        return ca.substitute([numeric], [s.time, s.x, s.u], there)[0]

    def _respond(self, k: int) -> None:
        """Add the response to a port, once its values at the half and the end are known."""
        first, second = self.ports[HALF][k] - self.port[k], self.ports[WHOLE][k] - self.port[k]
        ramp, square = 4.0 * first - second, 2.0 * (second - 2.0 * first)
        place = self.split.linear.index(self.split.ports[k].state)
        for node, (_, *both) in enumerate(self.responses):
            sloped, bent = (ca.sparsify(ca.DM(np.ascontiguousarray(q[:, place]))) for q in both)
            self.moved[node] += sloped * ramp + bent * square

    def _loop(self, members: Sequence[int]) -> None:
        """Take ports that depend on their responses: Newton steps from the start's values."""
        places = [(node, k) for k in members for node in range(len(SHARES))]
        guess = ca.SX.sym("guess", len(places))
        before = [ca.SX(q) for q in self.moved]
        self._take(places, guess)
        ports = [self._at(node, self.split.ports[k].value) for node, k in places]
        miss = ca.vertcat(*ports) - guess
        slopes = ca.jacobian(miss, guess)
        values = ca.vertcat(*[self.port[k] for _, k in places])
        for _ in range(_NEWTON):
            at, by = ca.substitute([miss, slopes], [guess], [values])
            values -= solved(by, at)
        self.moved = before
        self._take(places, values)

    def _take(self, places: Sequence[tuple[int, int]], values: Expression) -> None:
        """Give ports their values at the nodes, and add the responses to them."""
        for place, (node, k) in enumerate(places):
            self.ports[node][k] = values[place]
            if node == WHOLE:
                self._respond(k)

    def _group(self, g: int) -> None:
        """Take the states along a driver's way."""
        s, group = self.split.structure, self.split.groups[g]
        slopes = ca.Function(
            "slopes", [s.time, s.x, s.u, group.rate], [with_numbers(self.model, group.slopes)]
        )
        ends = Ends(s, self.step, self.du, self._change(HALF), self._change(WHOLE))
        result = along_the_way(ends, group.driver, group.states, self._rates(group.driver), slopes)
        for node, change in enumerate(result):
            for place, i in enumerate(group.states):
                self.turned[node][i] = change[place]

    def _rates(self, driver: int) -> tuple[Expression, Expression, Expression]:
        """Return a driver's rate at start, half and end, from its changes: rest is exactly 0."""
        place = self.split.linear.index(driver)
        m, b = self.m[[place], :], self.b[[place], :]
        rates = [self.slope[place]]
        for node, share in enumerate(SHARES):
            rate = rates[0] + _times(m, self.moved[node]) + _times(b, share * self.du)
            for k, port in enumerate(self.split.ports):
                if port.state == driver:
                    rate += self.ports[node][k] - self.port[k]
            rates.append(rate)
        return rates[0], rates[1], rates[2]


def _times(matrix: FloatArray, column: Expression) -> Expression:
    """Return a product in which zeros of the matrix leave nothing."""
    return ca.mtimes(ca.sparsify(ca.DM(matrix)), ca.SX(column))


def step_of(model: Model, step: float) -> StepExpression | str:
    """Return the step of `step` [s] of a model between its sample instants, or why it has none."""
    s = model.structure
    between = _between(s)
    if between.states and jumping(between, between.xdot):
        return "its equations jump"
    held, split = replace(model, structure=between), split_of(between)
    if isinstance(split, str):
        step_expression = whole_step(held, step)
    else:
        step_expression = _Builder(held, split, step).built()
    count = s.u.numel()
    still = step_expression.du[count:, 0]

    def resting(expression: Expression) -> Expression:
        return ca.substitute(expression, still, ca.SX.zeros(still.numel()))

    return replace(
        step_expression, du=step_expression.du[:count, 0],
        change=resting(step_expression.change), port_end=resting(step_expression.port_end),
    )  # fmt: skip


@cache
def _between(s: Structure) -> Structure:
    """Return equations whose sampled states are inputs that hold: what is between instants."""
    if not s.sampled:
        return s
    held = tuple(Input(q.name, q.unit, q.description, q.start) for q in s.sampled)
    none = ca.SX(0, 1)
    return replace(
        s, inputs=(*s.inputs, *held), u=ca.vertcat(s.u, s.z),
        sampled=(), period=None, z=none, next={}, znext=none,
    )  # fmt: skip


def whole_step(model: Model, step: float) -> StepExpression:
    """Return the step of `step` [s] of a model with its values, whatever its equations are."""
    s = model.structure
    n, theta = s.x.numel(), ca.SX.sym("theta")
    gone, low = ca.SX.sym("gone", n), ca.SX.sym("low", n)
    du, none = ca.SX.sym("du", s.u.numel()), ca.SX(0, 1)
    there = [s.time + theta * step, s.x + low + gone, s.u + theta * du]
    value = ca.substitute(step * with_numbers(model, s.xdot), ca.vertcat(s.time, s.x, s.u),
                          ca.vertcat(*there))  # fmt: skip
    _, change = rosenbrock(value, theta, gone) if n else (none, none)
    return StepExpression(low, du, none, change, none, none, ())
