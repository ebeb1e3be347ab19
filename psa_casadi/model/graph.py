"""CasADi expressions as a graph of named operations, which a language writes as text.

CasADi's operations are reduced to those that people write: `2 x` for its twice, `x^2` for its
square, `1/x` for its inverse, and one choice for a pair of its conditional zeros.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import casadi as ca

from psa_casadi.common.errors import InputError
from psa_casadi.common.symbolic import instructions
from psa_casadi.model.component import Expression


@dataclass(frozen=True)
class Node:
    """An operation on nodes, by their numbers; a symbol by its name; a constant by its value."""

    operation: str
    arguments: tuple[int, ...] = ()
    name: str = ""
    value: float = 0.0


#: Names of the operations in a sentence that refuses them.
_CODES = {getattr(ca, n): n[3:].lower() for n in dir(ca) if n.startswith("OP_")}

_LOG10 = 1 / math.log(10)


def square(graph: "ExpressionGraph", x: int) -> int:
    """Return x^2."""
    return graph.add("pow", x, graph.add("constant", value=2.0))


#: Operations of CasADi that are written with others.
PLAINLY: dict[int, Callable[..., int]] = {
    ca.OP_TWICE: lambda g, x: g.add("mul", g.add("constant", value=2.0), x),
    ca.OP_SQ: square,
    ca.OP_INV: lambda g, x: g.add("div", g.add("constant", value=1.0), x),
}


class ExpressionGraph:
    """Nodes by number; the arguments of a node have smaller numbers than the node.

    A language has names for some of CasADi's operations, by their codes, and writes others with
    these: `rewritten` makes them from the graph and the numbers of the arguments.
    """

    language: ClassVar[str]
    operations: ClassVar[Mapping[int, str]]
    rewritten: ClassVar[Mapping[int, Callable[..., int]]] = PLAINLY

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

        Raises InputError for a constant that is not finite and for an operation that the
        language does not have.
        """
        dense = [ca.densify(ca.SX(e)) for e in expressions]
        symbols = ca.symvar(ca.vertcat(ca.SX(0, 1), *dense))
        names = [s.name() for s in symbols]
        function = ca.Function("f", [ca.vertcat(*symbols)], dense)
        registers: dict[int, int] = {}
        results: dict[int, int] = {}
        for code, inputs, outputs in instructions(function):
            if code == ca.OP_OUTPUT:
                results[outputs[0]] = registers[inputs[0]]
            elif code == ca.OP_INPUT:
                registers[outputs[0]] = self.add("symbol", name=names[inputs[1]])
            elif code == ca.OP_CONST:
                value = inputs[0]
                if not math.isfinite(value):
                    raise InputError(
                        f"An equation holds the constant {value:g}, which {self.language} cannot"
                        " write; divide by nothing that is zero and bound by nothing infinite."
                    )
                registers[outputs[0]] = self.add("constant", value=value)
            else:
                registers[outputs[0]] = self._operation(code, [registers[i] for i in inputs])
        return [results[i] for i in range(len(dense))]

    def below(self, roots: Iterable[int]) -> set[int]:
        """Return the numbers of the roots and of all that they are made of."""
        numbers: set[int] = set()
        waiting = list(roots)
        while waiting:
            number = waiting.pop()
            if number not in numbers:
                numbers.add(number)
                waiting.extend(self.nodes[number].arguments)
        return numbers

    def _operation(self, code: int, arguments: list[int]) -> int:
        """Return the number of one of CasADi's operations, reduced to those that are printed."""
        if code == ca.OP_ASSIGN:
            return arguments[0]
        if code in self.operations:
            return self._simplified(self.operations[code], arguments)
        if code in self.rewritten:
            return self.rewritten[code](self, *arguments)
        raise InputError(
            f"An equation uses '{_CODES.get(code, code)}', which {self.language} does not have;"
            " write it with other functions."
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
