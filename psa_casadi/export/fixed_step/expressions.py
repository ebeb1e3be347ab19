"""Expressions as C99: one assignment for each number, in double or single precision."""

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from psa_casadi.component import Expression
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

    A number stands in a variable until its last use, which is free for another one then: however
    long the code, its stack frame stays small, whatever the compiler optimises.
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
        given = [self._name(a) for a in arguments]
        if kind == "neg":
            return f"-({given[0]})"
        if kind in ("+", "-", "*", "/"):
            right = f"({given[1]})" if given[1].startswith("-") else given[1]
            return f"{given[0]} {kind} {right}"
        if kind in ("v_fmin", "v_fmax"):
            sign = "<" if kind == "v_fmin" else ">"
            return f"{given[0]} {sign} {given[1]} ? {given[0]} : {given[1]}"
        if kind == "v_sign":
            return f"{given[0]} > {none} ? {one} : ({given[0]} < {none} ? -{one} : {none})"
        return f"{_FUNCTIONS[kind]}{self.precision.suffix}({', '.join(given)})"

    def _last_uses(self, computed: Sequence[int], outputs: Sequence[int]) -> dict[int, list[int]]:
        """Return the numbers of which each of `computed` is the last user, by it.

        Logical ones have no variable: who uses them uses what they compare.
        """
        places = set(computed)

        def used_by(n: int) -> set[int]:
            found = set[int]()
            kind, *arguments = self._graph.nodes[n]
            for a in arguments if kind not in LEAVES else ():
                found |= {a} if a in places else used_by(a)
            return found

        kept = {n for q in outputs for n in ({q} if q in places else used_by(q))}
        last = {a: n for n in computed for a in used_by(n)}
        ends: dict[int, list[int]] = {}
        for a, n in last.items():
            if a not in kept:
                ends.setdefault(n, []).append(a)
        return ends


def _constant(kind: str, given: Sequence[float]) -> float:
    """Return the value of an operation on constants."""
    if kind == "neg":
        return -given[0]
    if kind == "v_sqrt":
        return float(np.sqrt(given[0]))
    if kind not in ("+", "-", "*", "/"):
        raise Unprintable(f"operation {kind} on constants")
    a, b = given
    return {"+": a + b, "-": a - b, "*": a * b, "/": a / b if b else float("nan")}[kind]
