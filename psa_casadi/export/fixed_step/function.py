"""The fixed step as one function of the states, for an FMU: it remembers nothing between calls."""

import casadi as ca

from psa_casadi.export.fixed_step.expressions import Printer
from psa_casadi.export.fixed_step.plan import CodePlan
from psa_casadi.export.fixed_step.source import NOTHING


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
