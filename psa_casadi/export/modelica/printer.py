"""Nodes as Modelica text, with the fewest parentheses that keep the order of the operations.

Every tool reads `a*(-b)`, `(-2)^2` and `(a^b)^c` alike; none of them is written without its
parentheses. A comparison is a Boolean; where a number is wanted it becomes an if-expression. `==`
of Real variables is not Modelica outside functions: `a <= b and a >= b` says the same.

Source: Modelica Language Specification 3.6, section 3.2 (precedence).
"""

from collections.abc import Mapping

from psa_casadi.export.modelica.expression import Graph
from psa_casadi.export.modelica.words import number

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
