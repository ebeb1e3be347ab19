"""The source of a fixed step in C99: start, step and outputs in straight lines of numbers.

For a controller it is `name_init` and `name_step`, for an FMU a function of the states that
remembers nothing between calls.
"""

import math
from dataclasses import dataclass

import casadi as ca
import numpy as np

from psa_casadi.component import Expression
from psa_casadi.errors import InputError
from psa_casadi.export.common.templates import filled
from psa_casadi.export.fixed_step.expressions import Precision, Printer
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
    after = with_numbers(plan.model, ca.vertcat(s.y, s.znext))
    return bool(ca.depends_on(ca.vertcat(e.change, e.port_end, after), s.time))


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


#: Size over a state's usual one below which it counts as 0: next to it numbers become slow ones.
NOTHING = 1e-15


def source_code(plan: CodePlan) -> str:
    """Return the source: the start, the step and the outputs."""
    s, literal = plan.model.structure, plan.precision.literal
    advance = sample = None
    if s.states or timed(plan):
        advance = _block(plan, *_without_change(plan))
    if s.sampled:
        sample = _block(plan, with_numbers(plan.model, s.znext))
    return filled(
        "fixed_step.c",
        **names_of(plan),
        start=_start(plan),
        advance=advance,
        sample=sample,
        outputs=_block(plan, with_numbers(plan.model, s.y)),
        nothing=_nothing(plan),
        limit=literal(plan.limit) if bounded(plan) else "",
    )


def function_code(plan: CodePlan, function: str) -> str:
    """Return `void function(t, x, u, change)`: a step of states that remembers nothing else.

    The ports are evaluated at the start of every substep, so that the states are all there is.
    """
    e, s = plan.expression, plan.model.structure
    (change,) = ca.substitute(
        [e.change], [e.low, e.port], [ca.SX.zeros(e.low.numel()), e.port_start]
    )
    printer = Printer(
        plan.precision,
        {"t": s.time, "x": s.x, "v": ca.vertcat(s.u, e.du)},
        {
            "t": ["t"],
            "x": [f"x[{k}]" for k in range(len(s.states))],
            "v": [f"{of}[{k}]" for of in ("u", "change") for k in range(len(s.inputs))],
        },
    )
    lines, texts = printer.lines([change])
    given = "double t, double *x, const double *u, const double *change"
    return filled(
        "fixed_function.c", function=function, given=given, lines=lines, texts=texts, plan=plan,
        nothing=_nothing(plan), inputs=len(s.inputs),
    )  # fmt: skip


def probe_code(plan: CodePlan) -> str:
    """Return a function that plays the step on inputs in an array."""
    return filled("fixed_probe.c", **names_of(plan))


def names_of(plan: CodePlan) -> dict[str, object]:
    """Return what all texts of a step speak of."""
    return {
        "plan": plan,
        "name": plan.name,
        "s": plan.model.structure,
        "real": plan.precision.ctype,
        "literal": plan.precision.literal,
        "bounded": bounded(plan),
        "timed": timed(plan),
    }


@dataclass(frozen=True)
class _Block:
    """Expressions as code: assignments, the text of each result, whether it reads anything."""

    lines: list[str]
    texts: list[str]
    reads: bool

    def uses(self, word: str) -> bool:
        """Whether a word stands in the code."""
        return any(word in text for text in (*self.lines, *self.texts))


def _block(plan: CodePlan, *expressions: Expression) -> _Block:
    e, s = plan.expression, plan.model.structure
    step = plan.precision.literal(plan.step / plan.substeps)
    printer = Printer(
        plan.precision,
        {"t": s.time, "x": s.x, "v": ca.vertcat(e.low, s.u, e.du, e.port, s.z)},
        {
            "t": [f"({step} * state->steps_done)"],
            "x": [f"state->{q.name}" for q in s.states],
            "v": [
                *(f"state->low_of_{q.name}" for q in s.states),
                *(f"state->last_input.{q.name}" for q in s.inputs),
                *(f"change->{q.name}" for q in s.inputs),
                *(f"state->port_of_{q}" for q in e.port_names),
                *(f"state->{q.name}" for q in s.sampled),
            ],
        },
    )
    return _Block(*printer.lines(expressions), reads=bool(printer.used))


def _nothing(plan: CodePlan) -> list[str]:
    """Return the size of each state that counts as 0."""
    return [plan.precision.literal(NOTHING * abs(q)) for q in plan.model.state_nominals()]


def _start(plan: CodePlan) -> list[tuple[str, str]]:
    """Return the fields of the state and what they start with."""
    s, literal = plan.model.structure, plan.precision.literal
    at_start = ca.Function("start", s.arguments, [plan.expression.port_start, s.znext])
    ports, sampled = (np.array(q).ravel().tolist() for q in at_start(*plan.model.at_start()))
    names = [f"port_of_{q}" for q in plan.expression.port_names]
    fields = [(q.name, literal(q.start)) for q in s.states]
    if plan.precision.single:
        fields += [(f"low_of_{q.name}", literal(0.0)) for q in s.states]
    fields += [(name, literal(v)) for name, v in zip(names, ports, strict=True)]
    fields += [(q.name, literal(v)) for q, v in zip(s.sampled, sampled, strict=True)]
    if plan.every > 1:
        fields.append(("steps_to_instant", str(plan.every)))
    fields += [(f"last_input.{q.name}", literal(q.start)) for q in s.inputs]
    return fields + ([("steps_done", literal(0.0))] if timed(plan) else [])


def _without_change(plan: CodePlan) -> list[Expression]:
    """Return a step's expressions as they are needed: without what is not there.

    That is the change of inputs that hold, and in double precision what rounding takes. Ports that
    read such an input or a sampled state jump with it, so that they are evaluated at the
    start.
    """
    e, s = plan.expression, plan.model.structure
    away = [*([] if plan.precision.single else [e.low]), *([e.du] if plan.held else [])]
    given = [ca.SX.zeros(q.numel()) for q in away]
    still = ca.vertcat(s.u, s.z) if plan.held else s.z
    if still.numel():
        jump = [k for k in range(e.port.numel()) if ca.depends_on(e.port_start[k], still)]
        values = [e.port_start[k] if k in jump else e.port[k] for k in range(e.port.numel())]
        away.append(e.port)
        given.append(ca.vertcat(ca.SX(0, 1), *values))
    both = [e.change, e.port_end]
    return list(ca.substitute(both, away, given)) if away else both
