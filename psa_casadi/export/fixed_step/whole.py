"""The step of a model that has no exact one: all states by one Rosenbrock step of fourth order.

A hysteresis that acts back on its own voltage (a compensator), a limit of an amplifier, a stop:
what does not split into a linear part and states along a way (`simulation/exact/split`) is stepped
as a whole. The step is L-stable, so that fast lags settle and jumps of an input stay bounded. A
kink inside a step is not looked for: the step has order two there, which the comparison at export
measures, and substeps make small.
"""

from dataclasses import replace
from functools import cache

import casadi as ca

from psa_casadi.component import Expression
from psa_casadi.export.fixed_step.step import StepExpression, step_expression, with_numbers
from psa_casadi.export.fixed_step.way import rosenbrock
from psa_casadi.model.compose import Model
from psa_casadi.model.structure import Structure
from psa_casadi.simulation.exact.split import jumps, split_of
from psa_casadi.variables import Input


def step_of(model: Model, step: float) -> StepExpression | str:
    """Return the step of `step` [s] of a model between its sample instants, or why it has none."""
    s = model.structure
    between = _between(s)
    held = replace(model, structure=between)
    split = split_of(between)
    if not isinstance(split, str):
        found = step_expression(held, split, step)
    elif between.states and jumps(between):
        return split
    else:
        found = whole_step(held, step)
    count = s.u.numel()
    still = found.du[count:, 0]

    def resting(expression: Expression) -> Expression:
        return ca.substitute(expression, still, ca.SX.zeros(still.numel()))

    return replace(
        found, u=s.u, du=found.du[:count, 0],
        change=resting(found.change), port_end=resting(found.port_end),
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
    return StepExpression(
        time=s.time, x=s.x, low=low, u=s.u, du=du, port=none,
        change=change, port_end=none, port_start=none, port_names=(),
    )  # fmt: skip
