"""The source of a fixed step in C99: start, step and outputs in straight lines of numbers.

For a controller it is `name_init` and `name_step`, for an FMU a function of the states that
remembers nothing between calls.
"""

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from psa_casadi.common.errors import InputError
from psa_casadi.export.common.templates import filled
from psa_casadi.export.fixed_step.step import StepExpression, with_numbers
from psa_casadi.model.component import Expression
from psa_casadi.model.compose import Model
from psa_casadi.simulation.exact.printing import LEAVES, Graph, Unprintable

_FUNCTIONS = {
    "v_sqrt": "sqrt", "v_exp": "exp", "v_log": "log", "v_log_of_base": "log", "v_fabs": "fabs",
    "v_sin": "sin", "v_cos": "cos", "v_tan": "tan", "v_atan": "atan", "v_tanh": "tanh",
}  # fmt: skip
_COMPARED = {"v_less": "<", "v_less_equal": "<=", "v_equal": "==", "v_unequal": "!="}
_LOGICAL = {**dict.fromkeys(_COMPARED, 2), "v_not": 1, "v_and": 2, "v_or": 2}


@dataclass(frozen=True)
class Precision:
    """A precision of C: its type, and the suffix of its constants and functions."""

    name: str
    ctype: str
    suffix: str
    single: bool

    def literal(self, value: float) -> str:
        """Return a constant; what is too small for the precision is 0.

        Raises Unprintable where it is too large, or no number.
        """
        limits = np.finfo(np.float32 if self.single else np.float64)
        if not abs(value) <= float(limits.max):
            raise Unprintable(f"the constant {value:g} is no number in {self.name} precision")
        kept = float(value) if abs(value) >= float(limits.tiny) else 0.0
        return f"{kept!r}{self.suffix}"


PRECISIONS = {
    "double": Precision("double", "double", "", single=False),
    "single": Precision("single", "float", "f", single=True),
}


@dataclass
class Printer:
    """Prints expressions of named places; equal numbers are computed once.

    A variable holds a number until its last use, and is free for another one then: the stack frame
    stays small for code of any length, at any level of optimisation.
    `places` names the letters of symbols ("x", "v", "t") and gives the C text of their elements.
    """

    precision: Precision
    symbols: Mapping[str, Expression]
    places: Mapping[str, Sequence[str]]
    used: set[tuple[str, int]] = field(default_factory=set)
    _graph: Graph = field(default_factory=Graph)
    _folded: dict[int, float] = field(default_factory=dict)
    _variables: dict[int, int] = field(default_factory=dict)

    def lines(self, outputs: Sequence[Expression]) -> tuple[list[str], list[str]]:
        """Return a declaration and assignments in their order, and the C text of each output."""
        self._graph, self._folded, self._variables = Graph(), {}, {}
        numbers = self._graph.read(self.symbols, outputs)
        nodes, fixed = self._graph.nodes, self._graph.fixed
        for n, (kind, *arguments) in enumerate(nodes):
            if fixed[n] and kind not in LEAVES:
                self._folded[n] = _constant(kind, [self._known(a) for a in arguments])
        wanted: set[int] = set()
        stack = list(numbers)
        while stack:
            n = stack.pop()
            if n not in wanted and not fixed[n] and nodes[n][0] not in LEAVES:
                wanted.add(n)
                stack += [int(a) for a in nodes[n][1:]]
        needed = [n for n in sorted(wanted) if nodes[n][0] not in _LOGICAL]
        lines, free, count = [], list[int](), 0
        ends = self._last_uses(needed, numbers)
        for n in needed:
            value = self._value(n)
            free += sorted((self._variables[q] for q in ends.get(n, ())), reverse=True)
            if not free:
                free.append(count)
                count += 1
            self._variables[n] = free.pop()
            lines.append(f"s{self._variables[n]} = {value};")
        names = ", ".join(f"s{k}" for k in range(count))
        declared = textwrap.wrap(f"{self.precision.ctype} {names};", 90) if count else []
        return declared + lines, [self._name(n) for n in numbers]

    def _known(self, n: int) -> float:
        value = self._graph.value(n)
        return self._folded[n] if value is None else value

    def _name(self, n: int) -> str:
        kind, *arguments = self._graph.nodes[n]
        if self._graph.fixed[n]:
            return self.precision.literal(self._known(n))
        if kind in LEAVES:
            self.used.add((kind, arguments[0]))
            return self.places[kind][arguments[0]]
        if kind in _LOGICAL:
            one, none = self.precision.literal(1.0), self.precision.literal(0.0)
            return f"({self._condition(n)} ? {one} : {none})"
        return f"s{self._variables[n]}"

    def _condition(self, n: int) -> str:
        kind, *arguments = self._graph.nodes[n]
        if kind in _COMPARED:
            a, b = map(self._name, arguments)
            return f"({a} {_COMPARED[kind]} {b})"
        if kind in _LOGICAL:
            inner = [self._condition(q) for q in arguments]
            if kind == "v_not":
                return f"(!{inner[0]})"
            return f"({inner[0]} {'|' if kind == 'v_or' else '&'} {inner[1]})"
        return f"({self._name(n)} != {self.precision.literal(0.0)})"

    def _value(self, n: int) -> str:
        kind, *arguments = self._graph.nodes[n]
        one, none = self.precision.literal(1.0), self.precision.literal(0.0)
        if kind == "v_if":
            return f"{self._condition(arguments[0])} ? {self._name(arguments[1])} : {none}"
        items = [self._name(a) for a in arguments]
        if kind == "neg":
            return f"-({items[0]})"
        if kind in ("+", "-", "*", "/"):
            right = f"({items[1]})" if items[1].startswith("-") else items[1]
            return f"{items[0]} {kind} {right}"
        if kind in ("v_fmin", "v_fmax"):
            sign = "<" if kind == "v_fmin" else ">"
            return f"{items[0]} {sign} {items[1]} ? {items[0]} : {items[1]}"
        if kind == "v_sign":
            return f"{items[0]} > {none} ? {one} : ({items[0]} < {none} ? -{one} : {none})"
        return f"{_FUNCTIONS[kind]}{self.precision.suffix}({', '.join(items)})"

    def _last_uses(self, computed: Sequence[int], outputs: Sequence[int]) -> dict[int, list[int]]:
        """Return the numbers of which each of `computed` is the last user, by it.

        Logical ones have no variable: who uses them uses what they compare.
        """
        places = set(computed)

        def used_by(n: int) -> set[int]:
            table = set[int]()
            kind, *arguments = self._graph.nodes[n]
            for a in arguments if kind not in LEAVES else ():
                table |= {a} if a in places else used_by(a)
            return table

        kept = {n for q in outputs for n in ({q} if q in places else used_by(q))}
        last = {a: n for n in computed for a in used_by(n)}
        ends: dict[int, list[int]] = {}
        for a, n in last.items():
            if a not in kept:
                ends.setdefault(n, []).append(a)
        return ends


def _constant(kind: str, numbers: Sequence[float]) -> float:
    """Return the value of an operation on constants."""
    if kind == "neg":
        return -numbers[0]
    if kind == "v_sqrt":
        return float(np.sqrt(numbers[0]))
    if kind not in ("+", "-", "*", "/"):
        raise Unprintable(f"operation {kind} on constants")
    a, b = numbers
    return {"+": a + b, "-": a - b, "*": a * b, "/": a / b if b else float("nan")}[kind]


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
    `held` inputs a value holds over its step; else it is reached at the end of the step, along a
    line from the value before. An instant of the sampled states ends each `every` calls, 0 where
    there are none. A voltage beyond `limit` [V], up or down, is limited to it.
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
    items = ["last_input", "steps_done", "steps_to_instant", "unused"]
    items += [f"low_of_{q.name}" for q in s.states]
    items += [f"port_of_{q}" for q in plan.expression.port_names]
    names = [q.name for table in (s.states, s.sampled, s.inputs, s.outputs) for q in table]
    wrong = sorted({n for n in names if n in _KEYWORDS.split() or n in items})
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
    text = "double t, double *x, const double *u, const double *change"
    return filled(
        "fixed_function.c", function=function, arguments=text, lines=lines, texts=texts, plan=plan,
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
        """Whether a word is in the code."""
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
    items = [ca.SX.zeros(q.numel()) for q in away]
    still = ca.vertcat(s.u, s.z) if plan.held else s.z
    if still.numel():
        jump = [k for k in range(e.port.numel()) if ca.depends_on(e.port_start[k], still)]
        values = [e.port_start[k] if k in jump else e.port[k] for k in range(e.port.numel())]
        away.append(e.port)
        items.append(ca.vertcat(ca.SX(0, 1), *values))
    both = [e.change, e.port_end]
    return list(ca.substitute(both, away, items)) if away else both
