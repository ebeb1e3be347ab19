"""CasADi functions printed as C for exact steps: one text for a number and for lanes of numbers.

What depends on the parameters alone is computed once for a run and kept in `k`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca

from psa_casadi.common.symbolic import instructions
from psa_casadi.model.component import Expression

#: (operation, arguments) or ("x", index), ("c", value), ...; equal nodes are one number.
Node = tuple[Any, ...]
#: (symbol's number or None, factor, shift)
_Affine = tuple[int | None, float, float]

BINARY = {ca.OP_ADD: "+", ca.OP_SUB: "-", ca.OP_MUL: "*", ca.OP_DIV: "/"}
#: Functions of exact_math.h: those of CasADi's names, and others.
_SAME = (
    "sqrt", "exp", "log", "fabs", "fmin", "fmax", "sin", "cos", "tan", "atan", "tanh", "sign",
    "not", "and", "or",
)  # fmt: skip
_CALLS = {getattr(ca, f"OP_{name.upper()}"): f"v_{name}" for name in _SAME} | {
    ca.OP_LT: "v_less", ca.OP_LE: "v_less_equal", ca.OP_EQ: "v_equal", ca.OP_NE: "v_unequal",
    ca.OP_IF_ELSE_ZERO: "v_if",
}  # fmt: skip
_POWERS = (ca.OP_POW, ca.OP_CONSTPOW)
LEAVES = ("x", "v", "t", "w", "p", "c")


class Unprintable(Exception):  # noqa: N818 - the model is stepped instead, which is no mistake
    """An operation that these steps do not have."""


@dataclass
class Graph:
    """Nodes by number; a node's arguments have smaller numbers.

    `fixed` ones need no state, `rated` ones none but the rate w.
    """

    nodes: list[Node] = field(default_factory=list)
    numbers: dict[Node, int] = field(default_factory=dict)
    fixed: list[bool] = field(default_factory=list)
    rated: list[bool] = field(default_factory=list)

    def add(self, *node: Any) -> int:
        """Return the number of a node, a new one where no equal one is there."""
        if node not in self.numbers:
            leaf = node[0] in LEAVES
            inputs = [] if leaf else [int(a) for a in node[1:]]
            self.numbers[node] = len(self.nodes)
            self.nodes.append(node)
            self.fixed.append(node[0] in ("p", "c") if leaf else all(self.fixed[a] for a in inputs))
            self.rated.append(
                node[0] in ("p", "c", "w") if leaf else all(self.rated[a] for a in inputs)
            )
        return self.numbers[node]

    def constant(self, value: float) -> int:
        """Return the number of a constant; raises Unprintable for one that is not finite."""
        if not math.isfinite(value):
            raise Unprintable("a rate is not finite where all states and inputs are 0")
        return self.add("c", float(value))

    def value(self, number: int) -> float | None:
        """Return the value of a constant, None for other nodes."""
        node = self.nodes[number]
        return float(node[1]) if node[0] == "c" else None

    def operation(self, op: int, *arguments: int) -> int:
        """Return the number of a CasADi operation on numbers."""
        if op == ca.OP_DIV and not (self.fixed[arguments[0]] and self.fixed[arguments[1]]):
            return self._times(arguments[0], self._inverse(arguments[1]))
        if op in BINARY:
            return self.add(BINARY[op], *arguments)
        if op in _POWERS:
            return self._power(*arguments)
        one = arguments[0]
        simple: dict[int, Callable[[], int]] = {
            ca.OP_SQ: lambda: self.add("*", one, one),
            ca.OP_TWICE: lambda: self.add("+", one, one),
            ca.OP_NEG: lambda: self.add("neg", one),
            ca.OP_INV: lambda: self._inverse(one),
            ca.OP_ASSIGN: lambda: one,
        }
        if op in simple:
            return simple[op]()
        if op == ca.OP_LOG and ("v_log_of_base", one) in self.numbers:
            return self.add("v_log_of_base", one)  # as a power has the same base
        if op in _CALLS:
            return self.add(_CALLS[op], *arguments)
        raise Unprintable(f"operation {op}")

    def read(self, arguments: Mapping[str, Expression], outputs: Sequence[Expression]) -> list[int]:
        """Add functions of arguments, named by the leaves' letters; return the outputs' numbers."""
        names = list(arguments)
        whole = ca.cse([ca.densify(ca.vertcat(*[ca.vec(ca.SX(o)) for o in outputs]))])
        function = ca.Function("f", list(arguments.values()), whole)
        slots: dict[int, int] = {}
        numbers = [0] * function.numel_out(0)
        for op, inputs, targets in instructions(function):
            if op == ca.OP_OUTPUT:
                numbers[targets[1]] = slots[inputs[0]]
            elif op == ca.OP_CONST:
                slots[targets[0]] = self.constant(inputs[0])
            elif op == ca.OP_INPUT:
                slots[targets[0]] = self.add(names[inputs[0]], inputs[1])
            else:
                slots[targets[0]] = self.operation(op, *(slots[a] for a in inputs))
        return numbers

    def _times(self, a: int, b: int) -> int:
        return b if self.value(a) == 1.0 else self.add("*", a, b)

    def _inverse(self, number: int) -> int:
        """Return 1/x; one division serves all that divide by x, and by products with it."""
        node = self.nodes[number]
        if self.fixed[number]:
            return self.add("/", self.constant(1.0), number)
        if node[0] == "*":
            return self.add("*", self._inverse(node[1]), self._inverse(node[2]))
        if node[0] == "+" and node[1] == node[2]:
            return self.add("*", self.constant(0.5), self._inverse(node[1]))
        return self.add("/", self.constant(1.0), number)

    def _power(self, base: int, exponent: int) -> int:
        """Return base^exponent; base^(e + k/2) from base^e where that is there."""
        symbol, factor, shift = self._affine(exponent)
        halves = round(2.0 * shift)
        if symbol is None:
            if 2.0 * shift == halves and 0 < abs(halves) <= 32:
                return self._halves(base, halves)
            halves = math.floor(2.0 * shift) if abs(shift) <= 16.0 else 0
            reduced = self.constant(shift - 0.5 * halves) if halves else exponent
        else:
            rest = shift - 0.5 * halves
            scaled = symbol if factor == 1.0 else self.add("*", symbol, self.constant(factor))
            reduced = scaled if rest == 0.0 else self.add("+", scaled, self.constant(rest))
        power = self.add("v_exp", self.add("*", self.add("v_log_of_base", base), reduced))
        return self.add("*", power, self._halves(base, halves)) if halves else power

    def _halves(self, base: int, halves: int) -> int:
        """Return base^(halves/2): whole powers, roots, and what one division makes of them."""
        if halves < 0:
            return self._inverse(self._halves(base, -halves))
        if halves % 2 == 0:
            return self._whole(base, halves // 2)
        root = self.add("v_sqrt", base)
        return root if halves == 1 else self.add("*", self._whole(base, halves // 2), root)

    def _whole(self, base: int, exponent: int) -> int:
        if exponent == 1:
            return base
        half = self._whole(base, exponent // 2)
        square = self.add("*", half, half)
        return self.add("*", square, base) if exponent % 2 else square

    def _affine(self, number: int) -> _Affine:
        """Return (symbol, factor, shift) of an exponent factor symbol + shift."""
        node = self.nodes[number]
        if node[0] == "c":
            return None, 0.0, node[1]
        if node[0] == "neg":
            symbol, factor, shift = self._affine(node[1])
            return symbol, -factor, -shift
        affine = None
        if node[0] in BINARY.values():
            affine = _combined(node[0], self._affine(node[1]), self._affine(node[2]))
        return affine or (number, 1.0, 0.0)


def _combined(operation: str, a: _Affine, b: _Affine) -> _Affine | None:
    """Return the affine form of an operation on two, None if it is none."""
    if operation in ("+", "-") and (a[0] is None or b[0] is None or a[0] == b[0]):
        sign = 1.0 if operation == "+" else -1.0
        return a[0] if a[0] is not None else b[0], a[1] + sign * b[1], a[2] + sign * b[2]
    if operation == "*" and a[0] is None:
        return b[0], a[2] * b[1], a[2] * b[2]
    if operation == "*" and b[0] is None:
        return a[0], b[2] * a[1], b[2] * a[2]
    if operation == "/" and b[0] is None and b[2] != 0.0:
        return a[0], a[1] / b[2], a[2] / b[2]
    return None


class Printer:
    """Prints functions of (t, x, v, w, p) and collects what depends on p alone in `k`."""

    def __init__(self, arguments: Mapping[str, Expression]) -> None:
        self._arguments = dict(arguments)
        self._graph = Graph()
        self._kept: dict[int, int] = {}
        self._rated: dict[int, int] = {}
        self._new_rated: list[int] = []
        self.functions: list[str] = []

    def function(self, name: str, outputs: Sequence[Expression]) -> None:
        """Print `static void name(t, x, v, w, k, out)` that fills `out` with all the outputs."""
        numbers = self._graph.read(self._arguments, outputs)
        lines = self._body(numbers, fixed=False)
        lines += [f"    out[{i}] = {self._name(n)};" for i, n in enumerate(numbers)]
        head = (
            f"static inline void {name}(real t, const real *x, const real *v, real w,"
            " const real *k, real *out) {"
        )
        unused = "    (void)t, (void)x, (void)v, (void)w, (void)k;"
        self.functions.append("\n".join([head, unused, *lines, "}", ""]))

    def of_parameters(self, name: str, outputs: Sequence[Expression]) -> None:
        """Print `static void name(p, out)` for outputs that depend on the parameters alone."""
        numbers = self._graph.read(self._arguments, outputs)
        lines = self._body(numbers, fixed=True)
        lines += [f"    memset(out, 0, {len(numbers)} * sizeof *out);"]
        lines += [
            f"    out[{i}] = {self._fixed_name(n)};"
            for i, n in enumerate(numbers)
            if self._graph.value(n) != 0.0
        ]
        head = f"APART static void {name}(const real *p, real *out) {{"
        self.functions.append("\n".join([head, "    (void)p;", *lines, "}", ""]))

    def of_rate(self, name: str) -> None:
        """Print `static void name(w, k)`: what the functions since the last call read of the rate.

        In `k` it follows what depends on the parameters alone.
        """
        numbers, self._new_rated = self._new_rated, []
        lines = self._body(numbers, fixed=False, rated=True)
        lines += [f"    k[EX_NK + {self._rated[n]}] = s{n};" for n in numbers]
        head = f"static inline void {name}(real w, real *k) {{"
        self.functions.append("\n".join([head, "    (void)w, (void)k;", *lines, "}", ""]))

    @property
    def rated(self) -> int:
        """How many numbers of the rate there are in `k`."""
        return len(self._rated)

    def kept(self) -> tuple[int, str]:
        """Return the size of `k` and the function `psa_prepare(p, k)`; print it last."""
        numbers = list(self._kept)
        lines = self._body(numbers, fixed=True)
        lines += [f"    k[{i}] = {self._fixed_name(n)};" for n, i in self._kept.items()]
        head = "APART static void psa_prepare(const real *p, real *k) {"
        return len(numbers), "\n".join([head, "    (void)p, (void)k;", *lines, "}", ""])

    def _body(self, numbers: Sequence[int], *, fixed: bool, rated: bool = False) -> list[str]:
        """Return the assignments that numbers need; those of parameters or rate too, or from k."""
        needed: set[int] = set()
        stack = list(numbers)
        while stack:
            n = stack.pop()
            node = self._graph.nodes[n]
            output = (self._graph.rated[n] and not rated) or self._graph.fixed[n]
            if n in needed or node[0] in LEAVES or (output and not fixed):
                continue
            needed.add(n)
            stack += [int(a) for a in node[1:]]
        name = self._fixed_name if fixed else self._rate_name if rated else self._name
        return [f"    const real s{n} = {self._text(n, name)};" for n in sorted(needed)]

    def _leaf(self, number: int) -> str | None:
        node = self._graph.nodes[number]
        if node[0] == "c":
            return f"REAL({node[1]!r})"
        if node[0] in ("t", "w"):
            return str(node[0])
        if node[0] in ("x", "v", "p"):
            return f"{node[0]}[{node[1]}]"
        return None

    def _name(self, number: int) -> str:
        """Return how a varying function reads a node; what needs no state it reads from k."""
        leaf = self._graph.nodes[number][0] in LEAVES
        if self._graph.rated[number] and not (self._graph.fixed[number] or leaf):
            if number not in self._new_rated:
                self._new_rated.append(number)
            return f"k[EX_NK + {self._rated.setdefault(number, len(self._rated))}]"
        return self._rate_name(number)

    def _rate_name(self, number: int) -> str:
        """Return how a function reads a node; what is fixed it reads from k."""
        if self._graph.fixed[number] and self._graph.nodes[number][0] != "c":
            return f"k[{self._kept.setdefault(number, len(self._kept))}]"
        return self._leaf(number) or f"s{number}"

    def _fixed_name(self, number: int) -> str:
        return self._leaf(number) or f"s{number}"

    def _text(self, number: int, name: Callable[[int], str]) -> str:
        node = self._graph.nodes[number]
        operation = str(node[0])
        arguments = [name(a) for a in node[1:]]
        if operation == "neg":
            return f"-{arguments[0]}"
        if operation in ("+", "-", "*", "/"):
            return f"{arguments[0]} {operation} {arguments[1]}"
        return f"{operation}({', '.join(arguments)})"
