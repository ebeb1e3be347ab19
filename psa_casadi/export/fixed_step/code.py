"""The source of a fixed step in C99: start, step and outputs in straight lines of numbers.

For a controller it is `name_init` and `name_step`, for an FMU a function of the states that
remembers nothing between calls.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from psa_casadi.component import Expression
from psa_casadi.errors import InputError
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


#: Size over a state's usual one below which it counts as 0: next to it numbers become slow ones.
NOTHING = 1e-15


def source_code(plan: CodePlan) -> str:
    """Return the source: the start, the step and the outputs."""
    name = plan.name
    rounded = _rounding(plan) if plan.precision.single and plan.model.structure.states else []
    return "\n".join(
        [
            f"/* {name}.h tells what this is */",
            f'#include "{name}.h"',
            "",
            "#include <math.h>",
            "",
            *rounded,
            *_init(plan),
            "",
            *(_advance(plan) if moves(plan) else []),
            *_sample(plan),
            *_outputs_code(plan),
            "",
            *_step(plan),
            "",
        ]
    )


def _init(plan: CodePlan) -> list[str]:
    s, literal = plan.model.structure, plan.precision.literal
    inputs = [q.start for q in s.inputs]
    start = [0.0, [q.start for q in s.states], inputs, plan.model.parameter_vector()]
    start += [[q.start for q in s.sampled]] if s.sampled else []
    at_start = ca.Function("start", s.arguments, [plan.expression.port_start, s.znext])
    values, sampled = (np.array(q).ravel().tolist() for q in at_start(*start))
    lines = [f"void {plan.name}_init({plan.name}_state *state) {{"]
    lines += [f"    state->{q.name} = {literal(q.start)};" for q in s.states]
    if plan.precision.single:
        lines += [f"    state->low_of_{q.name} = {literal(0.0)};" for q in s.states]
    lines += [
        f"    state->port_of_{q} = {literal(v)};"
        for q, v in zip(plan.expression.port_names, values, strict=True)
    ]
    lines += [
        f"    state->{q.name} = {literal(v)};" for q, v in zip(s.sampled, sampled, strict=True)
    ]
    if plan.every > 1:
        lines.append(f"    state->steps_to_instant = {plan.every};")
    lines += [f"    state->last_input.{q.name} = {literal(q.start)};" for q in s.inputs]
    if timed(plan):
        lines.append(f"    state->steps_done = {literal(0.0)};")
    return [*lines, "}"]


def _rounding(plan: CodePlan) -> list[str]:
    """Return the sum that keeps what rounding takes: slow changes add up in single precision."""
    real = plan.precision.ctype
    return [
        "/* x + change; what rounding takes is kept in low and added the next time */",
        f"static void gain({real} *x, {real} *low, {real} change, {real} nothing) {{",
        f"    const {real} sum = change + *low, next = *x + sum;",
        "    *low = (sum - (next - *x) + nothing) - nothing;",
        "    *x = (next + nothing) - nothing;",
        "}",
        "",
    ]


def _printer(plan: CodePlan, states: str) -> Printer:
    e, s = plan.expression, plan.model.structure
    last, du = f"{states}->last_input", "change"
    step = plan.precision.literal(plan.step / plan.substeps)
    return Printer(
        plan.precision,
        {"t": s.time, "x": s.x, "v": ca.vertcat(e.low, s.u, e.du, e.port, s.z)},
        {
            "t": [f"({step} * {states}->steps_done)"],
            "x": [f"{states}->{q.name}" for q in s.states],
            "v": [
                *(f"{states}->low_of_{q.name}" for q in s.states),
                *(f"{last}.{q.name}" for q in s.inputs),
                *(f"{du}->{q.name}" for q in s.inputs),
                *(f"{states}->port_of_{q}" for q in e.port_names),
                *(f"{states}->{q.name}" for q in s.sampled),
            ],
        },
    )


def _advance(plan: CodePlan) -> list[str]:
    """Return the function that takes one step of the expression."""
    e, s, p = plan.expression, plan.model.structure, plan.precision
    gone = [] if p.single else [e.low]
    change, ports = _without_change(plan, [e.change, e.port_end], gone)
    lines, texts = _printer(plan, "state").lines([change, ports])
    n, nominal = len(s.states), plan.model.state_nominals()
    head = f"static void advance({plan.name}_state *state"
    if not plan.held:
        head += f", const {plan.name}_input *change"
    body = [f"    {line}" for line in lines]
    body += [f"    const {p.ctype} end{k} = {text};" for k, text in enumerate(texts)]
    for k, q in enumerate(s.states):
        nothing = p.literal(NOTHING * abs(nominal[k]))
        body.append(
            f"    gain(&state->{q.name}, &state->low_of_{q.name}, end{k}, {nothing});"
            if p.single
            else f"    state->{q.name} = (state->{q.name} + end{k} + {nothing}) - {nothing};"
        )
    body += [f"    state->port_of_{q} = end{n + k};" for k, q in enumerate(e.port_names)]
    if timed(plan):
        body.append(f"    state->steps_done += {p.literal(1.0)};")
    used = " ".join([*lines, *texts])
    unused = [] if plan.held or "change->" in used else ["    (void)change;"]
    told = "/* One step, from last_input along its change */"
    return [told, head + ") {", *unused, *body, "}", ""]


def _without_change(
    plan: CodePlan, expressions: Sequence[Expression], gone: Sequence[Expression]
) -> list[Expression]:
    """Return a step's expressions as they are needed: without the change of inputs that hold.

    Ports that read such an input or a sampled state jump with it, so that they are evaluated at the
    start.
    """
    e, s = plan.expression, plan.model.structure
    away = [*gone, *([e.du] if plan.held else [])]
    given = [ca.SX.zeros(q.numel()) for q in away]
    still = ca.vertcat(s.u, s.z) if plan.held else s.z
    if still.numel():
        jump = [k for k in range(e.port.numel()) if ca.depends_on(e.port_start[k], still)]
        values = [e.port_start[k] if k in jump else e.port[k] for k in range(e.port.numel())]
        away.append(e.port)
        given.append(ca.vertcat(ca.SX(0, 1), *values))
    return list(ca.substitute(list(expressions), away, given)) if away else list(expressions)


def _sample(plan: CodePlan) -> list[str]:
    """Return the function that takes a sample instant, where there are any."""
    s = plan.model.structure
    if not s.sampled:
        return []
    lines, texts = _printer(plan, "state").lines([sampled_of(plan.model)])
    ctype = plan.precision.ctype
    return [
        "/* A sample instant */",
        f"static void sample({plan.name}_state *state) {{",
        *(f"    {line}" for line in lines),
        *(f"    const {ctype} next{k} = {text};" for k, text in enumerate(texts)),
        *(f"    state->{q.name} = next{k};" for k, q in enumerate(s.sampled)),
        "}",
        "",
    ]


def _outputs_code(plan: CodePlan) -> list[str]:
    s, name = plan.model.structure, plan.name
    printer = _printer(plan, "state")
    lines, texts = printer.lines([outputs_of(plan.model)])
    head = f"static void outputs(const {name}_state *state, {name}_output *output) {{"
    body = [f"    {line}" for line in lines]
    body += [f"    output->{q.name} = {t};" for q, t in zip(s.outputs, texts, strict=True)]
    unused = [
        f"    (void){what};"
        for what, there in (("state", bool(printer.used)), ("output", bool(s.outputs)))
        if not there
    ]
    return [head, *unused, *body, "}"]


def _step(plan: CodePlan) -> list[str]:
    s, name, p, count = plan.model.structure, plan.name, plan.precision, plan.substeps
    head = f"int {name}_step({name}_state *state, const {name}_input *{_wanted(plan)},"
    head += f" {name}_output *output)"
    loop = f"    for (int k = 0; k < {count}; ++k) " if count > 1 else "    "
    if not moves(plan):
        lines = ["    state->last_input = *input;" if s.inputs else "    (void)input;"]
    elif not s.inputs:
        call = "advance(state);" if plan.held else "advance(state, input);"
        lines = ["    (void)input;", loop + call]
    elif plan.held:
        lines = ["    state->last_input = *input;", loop + "advance(state);"]
    else:
        lines = [f"    {name}_input change;"]
        share = f" * {p.literal(1.0 / count)}" if count > 1 else ""
        for q in s.inputs:
            difference = f"input->{q.name} - state->last_input.{q.name}"
            value = f"({difference}){share}" if share else difference
            lines.append(f"    change.{q.name} = {value};")
        if count > 1:
            moved = [f"        state->last_input.{q.name} += change.{q.name};" for q in s.inputs]
            lines += [loop + "{", "        advance(state, &change);", *moved, "    }"]
        else:
            lines.append("    advance(state, &change);")
        lines.append("    state->last_input = *input;")
    if plan.every == 1:
        lines.append("    sample(state);")
    elif plan.every:
        lines += [
            "    if (--state->steps_to_instant == 0) {",
            "        sample(state);",
            f"        state->steps_to_instant = {plan.every};",
            "    }",
        ]
    beyond = "beyond" if bounded(plan) else "0"
    end = ["    outputs(state, output);", f"    return {beyond};", "}"]
    return [head + " {", *_within(plan), *lines, *end]


def _wanted(plan: CodePlan) -> str:
    """Return the name of the inputs that the step is given; `input` are those that it takes."""
    return "wanted" if bounded(plan) else "input"


def _within(plan: CodePlan) -> list[str]:
    """Return how the inputs that a step takes follow from the wanted ones."""
    if not bounded(plan):
        return []
    limit = plan.precision.literal(plan.limit)
    return [
        f"    {plan.name}_input within = *wanted;",
        f"    const {plan.name}_input *const input = &within;",
        f"    const {plan.precision.ctype} v = wanted->voltage;",
        f"    const int beyond = !(v >= -{limit} && v <= {limit});",
        f"    within.voltage = v > {limit} ? {limit} : v < -{limit} ? -{limit}",
        "                     : beyond ? state->last_input.voltage : v; /* if it is no number */",
    ]


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
    nothing = [plan.precision.literal(NOTHING * abs(q)) for q in plan.model.state_nominals()]
    body = [f"    {line}" for line in lines]
    body += [f"    const double end{k} = {text};" for k, text in enumerate(texts)]
    body += [f"    x[{k}] = (x[{k}] + end{k} + {q}) - {q};" for k, q in enumerate(nothing)]
    inputs, count = max(1, len(s.inputs)), plan.substeps
    return "\n".join(
        [
            "",
            f"static void {function}_part({given}) {{",
            "    (void)t, (void)u, (void)change;",
            *body,
            "}",
            "",
            f"void {function}({given}) {{",
            f"    double now[{inputs}] = {{0.0}}, part[{inputs}] = {{0.0}};",
            f"    for (int k = 0; k < {count}; ++k) {{",
            f"        for (int i = 0; i < {len(s.inputs)}; ++i) {{",
            f"            part[i] = change[i] * {1.0 / count!r};",
            "            now[i] = u[i] + k * part[i];",
            "        }",
            f"        {function}_part(t + k * {plan.step / count!r}, x, now, part);",
            "    }",
            "}",
            "",
        ]
    )
