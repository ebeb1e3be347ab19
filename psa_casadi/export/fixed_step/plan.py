"""What is generated for a fixed step, and the names that C takes for it."""

import math
from dataclasses import dataclass

import casadi as ca

from psa_casadi.component import Expression
from psa_casadi.errors import InputError
from psa_casadi.export.fixed_step.expressions import Precision
from psa_casadi.export.fixed_step.step import StepExpression, with_numbers
from psa_casadi.model.compose import Model

#: Words that C keeps for itself.
_KEYWORDS = """
    auto break case char const continue default do double else enum extern float for goto if inline
    int long register restrict return short signed sizeof static struct switch typedef union
    unsigned void volatile while
"""


@dataclass(frozen=True, eq=False)
class CodePlan:
    """What is to be generated: a model's step, how often it is taken in a call, and how it looks.

    `step` is the time between two calls [s], `substeps` how many `expression`s it takes. With
    `held` inputs a value holds over the step that it is given for; else it is reached at its end,
    along a line from the value before. An instant of the sampled states ends `every` so many
    calls, 0 where there are none. A voltage beyond `limit` [V], up or down, is limited to it.
    """

    model: Model
    expression: StepExpression
    name: str
    step: float
    substeps: int
    held: bool
    precision: Precision
    every: int = 0
    limit: float = math.inf


def bounded(plan: CodePlan) -> bool:
    """Whether there is a voltage that is limited."""
    return math.isfinite(plan.limit)


def limit_words(limit: float) -> str:
    """Say up to which voltage [V] a step was measured; nothing where there is none."""
    if not math.isfinite(limit):
        return ""
    return (
        f"A voltage beyond {limit:.6g} V, in either direction, is limited to it; up to there jumps"
        " err no more than is stated, or 0.1 % of the range."
    )


def timed(plan: CodePlan) -> bool:
    """Whether the equations depend on the time itself."""
    e, s = plan.expression, plan.model.structure
    every = (e.change, e.port_end, outputs_of(plan.model), sampled_of(plan.model))
    return bool(ca.depends_on(ca.vertcat(*every), s.time))


def moves(plan: CodePlan) -> bool:
    """Whether there is something to do between sample instants: states, or the clock."""
    return bool(plan.model.structure.states) or timed(plan)


def outputs_of(model: Model) -> Expression:
    """Return the outputs of a model with its values."""
    return with_numbers(model, model.structure.y)


def sampled_of(model: Model) -> Expression:
    """Return the sampled states of a model after an instant, with its values."""
    return with_numbers(model, model.structure.znext)


def check_names(plan: CodePlan) -> None:
    """Refuse names that C does not take as fields.

    Raises:
        InputError: a state, an input or an output has the name of a keyword or of another field.
    """
    s = plan.model.structure
    own = ["last_input", "steps_done", "steps_to_instant", "unused"]
    own += [f"low_of_{q.name}" for q in s.states]
    own += [f"port_of_{q}" for q in plan.expression.port_names]
    names = [q.name for table in (s.states, s.sampled, s.inputs, s.outputs) for q in table]
    wrong = sorted({n for n in names if n in _KEYWORDS.split() or n in own})
    if wrong:
        raise InputError(
            f"{', '.join(wrong)} cannot name a field in C, where it is a keyword or taken; rename"
            " it in the effect that declares it."
        )
