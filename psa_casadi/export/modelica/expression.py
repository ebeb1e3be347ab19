"""CasADi expressions as a graph in which equal expressions are one node.

CasADi's own operations are reduced to those that Modelica has: `2 x` for its twice, `x^2` for its
square, `1/x` for its inverse, and an if-expression for a pair of its conditional zeros.
"""

import math
from collections.abc import Callable, Iterable, Sequence
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
