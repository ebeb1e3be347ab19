"""CasADi expressions as Modelica text, with the fewest parentheses that keep their order.

A pair of CasADi's conditional zeros becomes an if-expression. Every tool reads `a*(-b)`, `(-2)^2`
and `(a^b)^c` in the same way; none of them is written without its parentheses. A comparison is a
Boolean; where a number is wanted it becomes an if-expression. `==` of Real variables is not
Modelica outside functions: `a <= b and a >= b` is the same.

Source: Modelica Language Specification 3.6, sections 2.3 (words), 3.2 (precedence), 3.7.
"""

import math
import re
from collections.abc import Callable, Iterable, Mapping

import casadi as ca

from psa_casadi.common.errors import InputError
from psa_casadi.model.graph import PLAINLY, ExpressionGraph, square

#: CasADi's operations that are printed under their names in CasADi; the others follow.
_SAME_NAMES = (
    "add sub mul div neg pow sqrt exp log sin cos tan asin acos atan atan2 sinh cosh tanh sign"
    " lt le eq ne not and or"
)
_OPERATIONS: dict[int, str] = {
    **{getattr(ca, f"OP_{name.upper()}"): name for name in _SAME_NAMES.split()},
    ca.OP_CONSTPOW: "pow",
    ca.OP_FABS: "abs",
    ca.OP_FMIN: "min",
    ca.OP_FMAX: "max",
    ca.OP_IF_ELSE_ZERO: "if",
}


def _asinh(graph: ExpressionGraph, x: int) -> int:
    """Return sign(x) ln(|x| + sqrt(x^2 + 1)), which cancels nothing for negative x."""
    one = graph.add("constant", value=1.0)
    root = graph.add("sqrt", graph.add("add", square(graph, x), one))
    size = graph.add("log", graph.add("add", graph.add("abs", x), root))
    return graph.add("mul", graph.add("sign", x), size)


#: Operations of CasADi that Modelica writes by other operations.
_REWRITTEN: dict[int, Callable[..., int]] = {
    **PLAINLY,
    ca.OP_LOG1P: lambda g, x: g.add("log", g.add("add", g.add("constant", value=1.0), x)),
    ca.OP_EXPM1: lambda g, x: g.add("sub", g.add("exp", x), g.add("constant", value=1.0)),
    ca.OP_HYPOT: lambda g, x, y: g.add("sqrt", g.add("add", square(g, x), square(g, y))),
    ca.OP_ASINH: _asinh,
}


class Graph(ExpressionGraph):
    """Expressions in the operations of Modelica."""

    language = "Modelica"
    operations = _OPERATIONS
    rewritten = _REWRITTEN


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
    """Refuse a name that a Modelica class cannot have; `what` is what it would name."""
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name) or name in RESERVED:
        raise InputError(
            f"'{name}' cannot name {what}; use letters, digits, underscores, no digit first, and"
            " none of Modelica's reserved words."
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

    Raises InputError for nan and infinity, which Modelica cannot write; `what` is the number.
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


def modifier(attributes: Mapping[str, str | None]) -> str:
    """Return the attributes that have a value in parentheses, or nothing if none has."""
    items = [f"{name}={value}" for name, value in attributes.items() if value is not None]
    return f"({', '.join(items)})" if items else ""


# how tightly an operator binds
_OR, _AND, _NOT, _RELATION, _SUM, _PRODUCT, _POWER, _ATOM = range(8)

#: Of numbers: the text, how it binds, and how its sides have to.
_ARITHMETIC = {
    "neg": ("-{0}", _SUM, [_PRODUCT]),
    "pow": ("{0}^{1}", _POWER, [_ATOM, _ATOM]),
    "mul": ("{0}*{1}", _PRODUCT, [_PRODUCT, _POWER]),
    "div": ("{0}/{1}", _PRODUCT, [_PRODUCT, _POWER]),
    "add": ("{0} + {1}", _SUM, [_SUM, _PRODUCT]),
    "sub": ("{0} - {1}", _SUM, [_SUM, _PRODUCT]),
}
#: Two numbers compared, and how that binds.
_RELATIONS = {
    "lt": ("{0} < {1}", _RELATION),
    "le": ("{0} <= {1}", _RELATION),
    "eq": ("{0} <= {1} and {0} >= {1}", _AND),
    "ne": ("{0} < {1} or {0} > {1}", _OR),
}
_CONNECTED = {"and": _AND, "or": _OR}
_BOOLEAN = frozenset({*_RELATIONS, *_CONNECTED, "not"})
_FUNCTIONS = frozenset(
    ["sqrt", "exp", "log", "log10", "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh",
     "cosh", "tanh", "abs", "sign", "min", "max"]
)  # fmt: skip

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

    def definition(self, node: int) -> str:
        """Return what a node is made of, even if it has a name."""
        return self._expression(node)[0]

    def summand(self, node: int) -> str:
        """Return a node as the text behind a plus or a minus."""
        return _enclosed(self._number(node), _PRODUCT)

    def _number(self, node: int) -> Text:
        if node in self._named:
            return self._named[node], _ATOM
        if node not in self._written:
            self._written[node] = self._expression(node)
        return self._written[node]

    def _expression(self, node: int) -> Text:
        it = self._graph.nodes[node]
        if it.operation == "constant":
            whole = it.value == int(it.value) and abs(it.value) < 1e6
            return str(int(it.value)) if whole else repr(it.value), _ATOM if it.value >= 0 else _SUM
        if it.operation == "symbol":
            return self._symbols[it.name], _ATOM
        if it.operation in _BOOLEAN:
            return f"(if {self._condition(node)[0]} then 1.0 else 0.0)", _ATOM
        if it.operation == "if":
            chosen, *other = (self._number(v)[0] for v in it.arguments[1:])
            otherwise = other[0] if other else "0.0"
            condition = self._condition(it.arguments[0])[0]
            return f"(if {condition} then {chosen} else {otherwise})", _ATOM
        sides = [self._number(a) for a in it.arguments]
        if it.operation in _FUNCTIONS:
            return f"{it.operation}({', '.join(text for text, _ in sides)})", _ATOM
        form, binding, wanted = _ARITHMETIC[it.operation]
        return form.format(*map(_enclosed, sides, wanted)), binding

    def _condition(self, node: int) -> Text:
        """Return a node as a Boolean: a number is true if it is not 0."""
        it = self._graph.nodes[node]
        if node in self._named or it.operation not in _BOOLEAN:
            text = _enclosed(self._number(node), _SUM)
            return f"{text} < 0 or {text} > 0", _OR
        if it.operation in _RELATIONS:
            form, binding = _RELATIONS[it.operation]
            return form.format(*(_enclosed(self._number(a), _SUM) for a in it.arguments)), binding
        if it.operation == "not":
            return f"not {_enclosed(self._condition(it.arguments[0]), _RELATION)}", _NOT
        binding = _CONNECTED[it.operation]
        sides = (_enclosed(self._condition(a), binding + 1) for a in it.arguments)
        return f" {it.operation} ".join(sides), binding


def _enclosed(written: Text, at_least: int) -> str:
    """Return a text in parentheses unless it binds as tightly as wanted."""
    text, binding = written
    return text if binding >= at_least else f"({text})"
