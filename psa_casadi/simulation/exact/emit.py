"""CasADi functions printed as C for exact steps: one text for a number and for lanes of numbers.

What depends on the parameters alone is computed once for a run and kept in `k`.
"""

from collections.abc import Callable, Mapping, Sequence

from psa_casadi.component import Expression
from psa_casadi.simulation.exact.graph import LEAVES, Graph


class Printer:
    """Prints functions of (t, x, v, w, p) and collects what depends on p alone in `k`."""

    def __init__(self, arguments: Mapping[str, Expression]) -> None:
        self._arguments = dict(arguments)
        self._graph = Graph()
        self._kept: dict[int, int] = {}
        self._rated: dict[int, int] = {}
        self._own_rated: list[int] = []
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

        It stands in `k` behind what depends on the parameters alone.
        """
        own, self._own_rated = self._own_rated, []
        lines = self._body(own, fixed=False, rated=True)
        lines += [f"    k[EX_NK + {self._rated[n]}] = s{n};" for n in own]
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
            told = (self._graph.rated[n] and not rated) or self._graph.fixed[n]
            if n in needed or node[0] in LEAVES or (told and not fixed):
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
            if number not in self._own_rated:
                self._own_rated.append(number)
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
