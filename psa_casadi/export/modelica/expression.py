"""CasADi expressions as Modelica text, with the fewest parentheses that keep their order.

CasADi's own operations are reduced to those that Modelica has: `2 x` for its twice, `x^2` for its
square, `1/x` for its inverse, and an if-expression for a pair of its conditional zeros. Every tool
reads `a*(-b)`, `(-2)^2` and `(a^b)^c` alike; none of them is written without its parentheses. A
comparison is a Boolean; where a number is wanted it becomes an if-expression. `==` of Real
variables is not Modelica outside functions: `a <= b and a >= b` says the same.

Source: Modelica Language Specification 3.6, sections 2.3 (words), 3.2 (precedence), 3.7.
"""

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import casadi as ca

from psa_casadi.component import Expression
from psa_casadi.errors import InputError


@dataclass(frozen=True)
class Node:
    """An operation on nodes, by their numbers; a symbol by its name; a constant by its value."""

    operation: str
    arguments: tuple[int, ...] = ()
    name: str = ""
    value: float = 0.0


#: Operations that are printed, by CasADi's code.
_OPERATIONS: dict[int, str] = {
    ca.OP_ADD: "add",
    ca.OP_SUB: "sub",
    ca.OP_MUL: "mul",
    ca.OP_DIV: "div",
    ca.OP_NEG: "neg",
    ca.OP_POW: "pow",
    ca.OP_CONSTPOW: "pow",
    ca.OP_SQRT: "sqrt",
    ca.OP_EXP: "exp",
    ca.OP_LOG: "log",
    ca.OP_SIN: "sin",
    ca.OP_COS: "cos",
    ca.OP_TAN: "tan",
    ca.OP_ASIN: "asin",
    ca.OP_ACOS: "acos",
    ca.OP_ATAN: "atan",
    ca.OP_ATAN2: "atan2",
    ca.OP_SINH: "sinh",
    ca.OP_COSH: "cosh",
    ca.OP_TANH: "tanh",
    ca.OP_FABS: "abs",
    ca.OP_SIGN: "sign",
    ca.OP_FMIN: "min",
    ca.OP_FMAX: "max",
    ca.OP_LT: "lt",
    ca.OP_LE: "le",
    ca.OP_EQ: "eq",
    ca.OP_NE: "ne",
    ca.OP_NOT: "not",
    ca.OP_AND: "and",
    ca.OP_OR: "or",
    ca.OP_IF_ELSE_ZERO: "if",
}

#: Names of the operations in a sentence that refuses them.
_CODES = {getattr(ca, n): n[3:].lower() for n in dir(ca) if n.startswith("OP_")}

_LOG10 = 1 / math.log(10)


class Graph:
    """Nodes by number; the arguments of a node have smaller numbers than the node."""

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self._numbers: dict[Node, int] = {}

    def add(self, operation: str, *arguments: int) -> int:
        """Return the number of an operation on nodes."""
        return self._number(Node(operation, arguments))

    def symbol(self, name: str) -> int:
        """Return the number of a symbol."""
        return self._number(Node("symbol", name=name))

    def constant(self, value: float) -> int:
        """Return the number of a constant."""
        return self._number(Node("constant", value=value))

    def read(self, expressions: Sequence[Expression]) -> list[int]:
        """Return the numbers of scalar expressions; a symbol is known by its name.

        Raises InputError for a constant that is not finite and for an operation that Modelica does
        not have.
        """
        dense = [ca.densify(ca.SX(e)) for e in expressions]
        symbols = ca.symvar(ca.vertcat(*dense))
        names = [s.name() for s in symbols]
        function = ca.Function("f", [ca.vertcat(*symbols)], dense)
        registers: dict[int, int] = {}
        results: dict[int, int] = {}
        for k in range(function.n_instructions()):
            code = function.instruction_id(k)
            inputs, outputs = function.instruction_input(k), function.instruction_output(k)
            if code == ca.OP_OUTPUT:
                results[outputs[0]] = registers[inputs[0]]
            elif code == ca.OP_INPUT:
                registers[outputs[0]] = self.symbol(names[inputs[1]])
            elif code == ca.OP_CONST:
                registers[outputs[0]] = self._finite(function.instruction_constant(k))
            else:
                registers[outputs[0]] = self._operation(code, [registers[i] for i in inputs])
        return [results[i] for i in range(len(dense))]

    def below(self, roots: Iterable[int]) -> set[int]:
        """Return the numbers of the roots and of all that they are made of."""
        found: set[int] = set()
        waiting = list(roots)
        while waiting:
            number = waiting.pop()
            if number not in found:
                found.add(number)
                waiting.extend(self.nodes[number].arguments)
        return found

    def _number(self, node: Node) -> int:
        if node not in self._numbers:
            self._numbers[node] = len(self.nodes)
            self.nodes.append(node)
        return self._numbers[node]

    def _finite(self, value: float) -> int:
        if not math.isfinite(value):
            raise InputError(
                f"An equation holds the constant {value:g}, which Modelica cannot write; divide by"
                " nothing that is zero and bound by nothing infinite."
            )
        return self.constant(value)

    def _operation(self, code: int, arguments: list[int]) -> int:
        """Return the number of one of CasADi's operations, reduced to those that are printed."""
        if code == ca.OP_ASSIGN:
            return arguments[0]
        if code in _OPERATIONS:
            return self._simplified(_OPERATIONS[code], arguments)
        if code in _REWRITTEN:
            return _REWRITTEN[code](self, *arguments)
        raise InputError(
            f"An equation uses '{_CODES.get(code, code)}', which Modelica does not have; write it"
            " with other functions."
        )

    def _simplified(self, operation: str, arguments: list[int]) -> int:
        first = self.nodes[arguments[0]]
        if operation == "add":
            return self._sum(*arguments)
        if operation == "mul":
            second = self.nodes[arguments[1]]
            if first.operation == "log" and second.value == _LOG10:
                return self.add("log10", *first.arguments)
            if second.operation == "log" and first.value == _LOG10:
                return self.add("log10", *second.arguments)
            if first.operation == "neg":
                return self.add("neg", self.add("mul", first.arguments[0], arguments[1]))
        return self.add(operation, *arguments)

    def _sum(self, left: int, right: int) -> int:
        """Return left + right, where (if c then a else 0) + (if not c then b else 0) is one if."""
        a, b = self.nodes[left], self.nodes[right]
        if a.operation == b.operation == "if":
            if b.arguments[0] == self.add("not", a.arguments[0]):
                return self.add("if", *a.arguments, b.arguments[1])
            if a.arguments[0] == self.add("not", b.arguments[0]):
                return self.add("if", *b.arguments, a.arguments[1])
        return self.add("add", left, right)


def _square(graph: Graph, x: int) -> int:
    return graph.add("pow", x, graph.constant(2.0))


def _hypot(graph: Graph, x: int, y: int) -> int:
    return graph.add("sqrt", graph.add("add", _square(graph, x), _square(graph, y)))


def _asinh(graph: Graph, x: int) -> int:
    """Return sign(x) ln(|x| + sqrt(x^2 + 1)), which cancels nothing for negative x."""
    root = graph.add("sqrt", graph.add("add", _square(graph, x), graph.constant(1.0)))
    size = graph.add("log", graph.add("add", graph.add("abs", x), root))
    return graph.add("mul", graph.add("sign", x), size)


#: Operations of CasADi that Modelica says in other words.
_REWRITTEN: dict[int, Callable[..., int]] = {
    ca.OP_TWICE: lambda g, x: g.add("mul", g.constant(2.0), x),
    ca.OP_SQ: _square,
    ca.OP_INV: lambda g, x: g.add("div", g.constant(1.0), x),
    ca.OP_LOG1P: lambda g, x: g.add("log", g.add("add", g.constant(1.0), x)),
    ca.OP_EXPM1: lambda g, x: g.add("sub", g.add("exp", x), g.constant(1.0)),
    ca.OP_HYPOT: _hypot,
    ca.OP_ASINH: _asinh,
}


_WORDS = """
    algorithm and annotation block break class connect connector constant constrainedby der discrete
    each else elseif elsewhen encapsulated end enumeration equation expandable extends external
    false final flow for function if import impure in initial inner input loop model not operator or
    outer output package parameter partial protected public pure record redeclare replaceable return
    stream then true type when while within
    Boolean Integer Real String Clock ExternalObject StateSelect AssertionLevel Connections Modelica
    abs acos actualStream asin assert atan atan2 cardinality ceil change cos cosh cross delay
    diagonal div edge exp fill floor getInstanceName homotopy identity inStream integer linspace log
    log10 matrix max min mod ndims noEvent ones outerProduct pre product reinit rem sample scalar
    semiLinear sign sin sinh size skew smooth spatialDistribution sqrt sum symmetric tan tanh
    terminal terminate time transpose vector zeros
"""

#: Keywords, built-in types, and built-in functions that an identifier would hide.
RESERVED = frozenset(_WORDS.split())


def check_identifier(name: str, what: str) -> None:
    """Refuse a name that a Modelica class cannot have; `what` says what it would name."""
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name) or name in RESERVED:
        raise InputError(
            f"'{name}' cannot name {what}; use letters, digits, underscores, no digit first, and"
            " none of Modelica's own words."
        )


class Identifiers:
    """Gives out identifiers: the wanted name where it is free, else the name and a suffix."""

    def __init__(self, taken: Iterable[str] = ()) -> None:
        self._taken = {*RESERVED, *taken}

    def new(self, wanted: str) -> str:
        """Return an identifier that no variable has yet, as near to the wanted name as can be."""
        base = re.sub(r"\W", "_", wanted, flags=re.ASCII)
        base = base if base and not base[0].isdigit() else f"_{base}"
        name, count = base, 1
        while name in self._taken:
            count += 1
            name = f"{base}_{count}"
        self._taken.add(name)
        return name


def number(value: float, what: str) -> str:
    """Return the shortest text that reads back as the same double, a sign in front if negative.

    Raises InputError for nan and infinity, which Modelica cannot write; `what` says of what.
    """
    if not math.isfinite(value):
        raise InputError(
            f"{what} is {value:g}, which Modelica cannot write; give it a finite value."
        )
    return repr(float(value))


def comment(text: str) -> str:
    """Return a text as a comment up to the end of the line."""
    return f"// {' '.join(text.split())}"


def string(text: str) -> str:
    """Return a text as a Modelica string literal."""
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def unit_text(unit: str) -> str:
    """Return a unit as Modelica writes it; a sensor's count is a pure number there."""
    return re.sub(r"\bcounts\b", "1", unit.removesuffix("/counts"))


def modifier(attributes: Iterable[tuple[str, str | None]]) -> str:
    """Return the attributes that have a value in parentheses, or nothing if none has."""
    given = [f"{name}={value}" for name, value in attributes if value is not None]
    return f"({', '.join(given)})" if given else ""


# how tightly an operator binds
_OR, _AND, _NOT, _RELATION, _SUM, _PRODUCT, _POWER, _ATOM = range(8)

_RELATIONS = {"lt": "<", "le": "<="}
_BOOLEAN = frozenset({"lt", "le", "eq", "ne", "not", "and", "or"})
_FUNCTION_NAMES = (
    "sqrt exp log log10 sin cos tan asin acos atan atan2 sinh cosh tanh abs sign min max"
)
_FUNCTIONS = frozenset(_FUNCTION_NAMES.split())

Text = tuple[str, int]


class Printer:
    """Writes nodes of a graph; symbols and named nodes appear by their names.

    `symbols` gives the Modelica name of a symbol, `named` the name of a node that is a variable.
    """

    def __init__(
        self, graph: Graph, symbols: Mapping[str, str], named: Mapping[int, str] | None = None
    ) -> None:
        self._graph = graph
        self._symbols = symbols
        self._named = named or {}
        self._written: dict[int, Text] = {}

    def text(self, node: int) -> str:
        """Return a node as text, by its name if it has one."""
        return self._number(node)[0]

    def definition(self, node: int) -> str:
        """Return what a node is made of, even if it has a name."""
        return self._expression(node)[0]

    def summand(self, node: int) -> str:
        """Return a node as it stands behind a plus or a minus."""
        return self._within(node, _PRODUCT)

    def _number(self, node: int) -> Text:
        if node in self._named:
            return self._named[node], _ATOM
        if node not in self._written:
            self._written[node] = self._expression(node)
        return self._written[node]

    def _within(self, node: int, at_least: int) -> str:
        """Return a node in parentheses unless it binds as tightly as wanted."""
        text, binding = self._number(node)
        return text if binding >= at_least else f"({text})"

    def _expression(self, node: int) -> Text:
        it = self._graph.nodes[node]
        if it.operation == "constant":
            return _constant(it.value)
        if it.operation == "symbol":
            return self._symbols[it.name], _ATOM
        if it.operation in _FUNCTIONS:
            inside = ", ".join(self._number(a)[0] for a in it.arguments)
            return f"{it.operation}({inside})", _ATOM
        if it.operation in _BOOLEAN:
            return f"(if {self._condition(node)[0]} then 1.0 else 0.0)", _ATOM
        if it.operation == "if":
            condition, *values = it.arguments
            chosen, *other = (self._number(v)[0] for v in values)
            otherwise = other[0] if other else "0.0"
            return f"(if {self._condition(condition)[0]} then {chosen} else {otherwise})", _ATOM
        return self._arithmetic(it.operation, it.arguments)

    def _arithmetic(self, operation: str, arguments: tuple[int, ...]) -> Text:
        if operation == "neg":
            return f"-{self._within(arguments[0], _PRODUCT)}", _SUM
        left, right = arguments
        if operation == "pow":
            return f"{self._within(left, _ATOM)}^{self._within(right, _ATOM)}", _POWER
        if operation == "mul":
            return f"{self._within(left, _PRODUCT)}*{self._within(right, _POWER)}", _PRODUCT
        if operation == "div":
            return f"{self._within(left, _PRODUCT)}/{self._within(right, _POWER)}", _PRODUCT
        sign = "+" if operation == "add" else "-"
        return f"{self._within(left, _SUM)} {sign} {self._within(right, _PRODUCT)}", _SUM

    def _condition(self, node: int) -> Text:
        """Return a node as a Boolean: a number is true if it is not 0."""
        it = self._graph.nodes[node]
        if node in self._named or it.operation not in _BOOLEAN:
            text = self._within(node, _SUM)
            return f"{text} < 0 or {text} > 0", _OR
        if it.operation == "not":
            return f"not {self._condition_within(it.arguments[0], _RELATION)}", _NOT
        if it.operation in ("and", "or"):
            own = _AND if it.operation == "and" else _OR
            left, right = (self._condition_within(a, own + 1) for a in it.arguments)
            return f"{left} {it.operation} {right}", own
        left, right = (self._within(a, _SUM) for a in it.arguments)
        if it.operation in _RELATIONS:
            return f"{left} {_RELATIONS[it.operation]} {right}", _RELATION
        if it.operation == "eq":
            return f"{left} <= {right} and {left} >= {right}", _AND
        return f"{left} < {right} or {left} > {right}", _OR

    def _condition_within(self, node: int, at_least: int) -> str:
        text, binding = self._condition(node)
        return text if binding >= at_least else f"({text})"


def _constant(value: float) -> Text:
    whole = value == int(value) and abs(value) < 1e6
    text = str(int(value)) if whole else number(value, "A constant of an equation")
    return text, _ATOM if value >= 0 else _SUM
