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


#: CasADi's operations that are printed, all of them under their own names, but for these.
_OWN_NAMES = (
    "add sub mul div neg pow sqrt exp log sin cos tan asin acos atan atan2 sinh cosh tanh sign"
    " lt le eq ne not and or"
)
_OPERATIONS: dict[int, str] = {
    **{getattr(ca, f"OP_{name.upper()}"): name for name in _OWN_NAMES.split()},
    ca.OP_CONSTPOW: "pow",
    ca.OP_FABS: "abs",
    ca.OP_FMIN: "min",
    ca.OP_FMAX: "max",
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

    def add(self, operation: str, *arguments: int, name: str = "", value: float = 0.0) -> int:
        """Return the number of an operation on nodes, of a "symbol" or of a "constant"."""
        node = Node(operation, arguments, name, value)
        if node not in self._numbers:
            self._numbers[node] = len(self.nodes)
            self.nodes.append(node)
        return self._numbers[node]

    def read(self, expressions: Sequence[Expression]) -> list[int]:
        """Return the numbers of scalar expressions; a symbol is known by its name.

        Raises InputError for a constant that is not finite and for an operation that Modelica does
        not have.
        """
        dense = [ca.densify(ca.SX(e)) for e in expressions]
        symbols = ca.symvar(ca.vertcat(ca.SX(0, 1), *dense))
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
                registers[outputs[0]] = self.add("symbol", name=names[inputs[1]])
            elif code == ca.OP_CONST:
                value = function.instruction_constant(k)
                if not math.isfinite(value):
                    raise InputError(
                        f"An equation holds the constant {value:g}, which Modelica cannot write;"
                        " divide by nothing that is zero and bound by nothing infinite."
                    )
                registers[outputs[0]] = self.add("constant", value=value)
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
        """Write log(x) / log(10) as log10(x), (-a) b as -(a b), and a pair of ifs as one if.

        (if c then a else 0) + (if not c then b else 0) is if c then a else b.
        """
        if operation not in ("add", "mul"):
            return self.add(operation, *arguments)
        nodes = [self.nodes[a] for a in arguments]
        for first, second in (nodes, nodes[::-1]):
            if operation == "mul" and first.operation == "log" and second.value == _LOG10:
                return self.add("log10", *first.arguments)
            pair = operation == "add" and first.operation == second.operation == "if"
            if pair and second.arguments[0] == self.add("not", first.arguments[0]):
                return self.add("if", *first.arguments, second.arguments[1])
        if operation == "mul" and nodes[0].operation == "neg":
            return self.add("neg", self.add("mul", nodes[0].arguments[0], arguments[1]))
        return self.add(operation, *arguments)


def _square(graph: Graph, x: int) -> int:
    return graph.add("pow", x, graph.add("constant", value=2.0))


def _asinh(graph: Graph, x: int) -> int:
    """Return sign(x) ln(|x| + sqrt(x^2 + 1)), which cancels nothing for negative x."""
    one = graph.add("constant", value=1.0)
    root = graph.add("sqrt", graph.add("add", _square(graph, x), one))
    size = graph.add("log", graph.add("add", graph.add("abs", x), root))
    return graph.add("mul", graph.add("sign", x), size)


#: Operations of CasADi that Modelica says in other words.
_REWRITTEN: dict[int, Callable[..., int]] = {
    ca.OP_TWICE: lambda g, x: g.add("mul", g.add("constant", value=2.0), x),
    ca.OP_SQ: _square,
    ca.OP_INV: lambda g, x: g.add("div", g.add("constant", value=1.0), x),
    ca.OP_LOG1P: lambda g, x: g.add("log", g.add("add", g.add("constant", value=1.0), x)),
    ca.OP_EXPM1: lambda g, x: g.add("sub", g.add("exp", x), g.add("constant", value=1.0)),
    ca.OP_HYPOT: lambda g, x, y: g.add("sqrt", g.add("add", _square(g, x), _square(g, y))),
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


def modifier(attributes: Mapping[str, str | None]) -> str:
    """Return the attributes that have a value in parentheses, or nothing if none has."""
    given = [f"{name}={value}" for name, value in attributes.items() if value is not None]
    return f"({', '.join(given)})" if given else ""


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
        """Return a node as it stands behind a plus or a minus."""
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
        own = _CONNECTED[it.operation]
        sides = (_enclosed(self._condition(a), own + 1) for a in it.arguments)
        return f" {it.operation} ".join(sides), own


def _enclosed(written: Text, at_least: int) -> str:
    """Return a text in parentheses unless it binds as tightly as wanted."""
    text, binding = written
    return text if binding >= at_least else f"({text})"
