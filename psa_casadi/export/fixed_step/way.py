"""States along a driver's way over one step: two legs, whatever the driver does.

The legs meet where the driver turns, found by linear interpolation of its rate in the half of the
step in which the rate changes sign, else in the middle. A leg is one Rosenbrock step of fourth
order over the way, at the leg's mean rate: three evaluations, and L-stable, so that a jump of the
voltage across the whole range does not throw the states out of bounds.

Source of the method: Hairer and Wanner, Solving Ordinary Differential Equations II, section IV.7,
the L-stable one of Table 7.2.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

from psa_casadi.component import Expression

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
    """A step of `step` [s] from time, states x and inputs u, which change by `du`.

    `half` and `whole` are what the states known so far have changed by there.
    """

    step: float
    time: Expression
    x: Expression
    u: Expression
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
    half, count = ends.half[driver], ends.x.numel()
    turned, share, turn = _turn(rates, half, ends.whole[driver], ends.step)
    # where the legs meet: parabolas in time, but the driver's own value
    change = 4.0 * share * (1.0 - share) * ends.half + share * (2.0 * share - 1.0) * ends.whole
    parts = [ends.x[i] + change[i] for i in range(count)]
    parts[driver] = ends.x[driver] + turn
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

        States beside the way go on a line from `origin` to `target`, from `begin` on for `share`.
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
        given = (ends.time + when * ends.step, x, ends.u + when * ends.du, rate)
        return way, *rosenbrock(duration * slopes(*given), theta, gone)

    first = leg(ends.x, meeting, ca.SX(0), share)
    last = leg(shifted(meeting, first[2]), ends.x + ends.whole, share, 1.0 - share)
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
