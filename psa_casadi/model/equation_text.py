"""Equations as text that people read, and that is read back without running any of it.

    {"where": {"a1": "x - y"}, "der": {"v": "(u - k*a1 - d*v)/m"}}

There is one expression for each result: numbers, names of symbols, + - * / **, comparisons, `and`,
`or`, `not`, and the functions of `FUNCTIONS`. What is used several times, or is long, has a name
in `where`, which the lines after it may use. The grammar is Python's. A tree that holds anything
else is refused, and so are texts that are too long or nest too deep.
"""

import ast
import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from functools import partial, reduce
from itertools import count, filterfalse
from typing import ClassVar
from warnings import catch_warnings, simplefilter

import casadi as ca

from psa_casadi.common.errors import Problems
from psa_casadi.common.strict_json import brief
from psa_casadi.model.component import Equations, Expression, KeptEquations, OnDemand
from psa_casadi.model.graph import ExpressionGraph

_ONE = "sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh exp expm1 log log1p log10 sqrt"
_ONE += " fabs sign floor ceil erf"
_TWO = "atan2 fmin fmax fmod remainder copysign hypot"
#: Functions of the text, which are CasADi's, and the count of their arguments.
FUNCTIONS = {**dict.fromkeys(_ONE.split(), 1), **dict.fromkeys(_TWO.split(), 2), "if_else": 3}
#: Those that CasADi makes of other operations.
_COMPOSED = ("log10", "if_else")

_SIGNS: dict[str, type[ast.operator]] = {
    "add": ast.Add, "sub": ast.Sub, "mul": ast.Mult, "div": ast.Div, "pow": ast.Pow,
}  # fmt: skip
_RELATIONS: dict[str, type[ast.cmpop]] = {
    "lt": ast.Lt, "le": ast.LtE, "eq": ast.Eq, "ne": ast.NotEq,
}  # fmt: skip
_CONNECTED: dict[str, type[ast.boolop]] = {"and": ast.And, "or": ast.Or}
_MADE: dict[type[ast.AST], Callable[..., Expression]] = {
    kind: partial(ca.SX.binary, getattr(ca, f"OP_{name.upper()}"))
    for name, kind in (*_SIGNS.items(), *_RELATIONS.items(), *_CONNECTED.items())
} | {
    ast.Gt: lambda x, y: ca.SX.binary(ca.OP_LT, y, x),
    ast.GtE: lambda x, y: ca.SX.binary(ca.OP_LE, y, x),
    ast.Not: partial(ca.SX.unary, ca.OP_NOT),
    ast.USub: partial(ca.SX.unary, ca.OP_NEG),
    ast.UAdd: lambda x: x,
}  # fmt: skip
#: An expression of more operations than this is written in parts.
_LONG = 60
#: What is read of one expression: characters, and depth of its tree.
_CHARACTERS, _DEPTH = 8_000, 100
#: Names that no symbol can have: those of the table of symbols itself.
_TAKEN = frozenset(dir(OnDemand()))


@dataclass(frozen=True)
class EquationTexts:
    """Equations as text: derivatives, terms of balances, outputs, switches, next values.

    `where` are the parts that the others name, in the order of their dependence.
    """

    where: Mapping[str, str] = field(default_factory=dict)
    der: Mapping[str, str] = field(default_factory=dict)
    add: Mapping[str, str] = field(default_factory=dict)
    out: Mapping[str, str] = field(default_factory=dict)
    switches: Mapping[str, str] = field(default_factory=dict)
    next: Mapping[str, str] = field(default_factory=dict)

    @property
    def every(self) -> dict[tuple[str, str], str]:
        """All expressions by their part and name, in the order in which they are read."""
        return {(p, n): text for p in ("where", *_PARTS) for n, text in getattr(self, p).items()}


_PARTS = tuple(f.name for f in fields(Equations))


class _Graph(ExpressionGraph):
    """Expressions in the operations of the text."""

    language = "MODEL.json"
    operations: ClassVar[Mapping[int, str]] = {
        **{
            getattr(ca, f"OP_{name.upper()}"): name
            for name in (*FUNCTIONS, *_SIGNS, *_RELATIONS, *_CONNECTED, "not", "neg")
            if name not in _COMPOSED
        },
        ca.OP_CONSTPOW: "pow",
        ca.OP_IF_ELSE_ZERO: "if",
    }


def texts_of(equations: KeptEquations) -> EquationTexts:
    """Return equations as text.

    Raises InputError for an operation that no text has, and for a number that is not finite.
    """
    graph = _Graph()
    roots = graph.read(equations.function.call([ca.SX.sym(n) for n in equations.symbols]))
    taken = {*equations.symbols, *FUNCTIONS}
    names = filterfalse(taken.__contains__, (f"a{k}" for k in count(1)))
    below = sorted(graph.below(roots))
    uses = Counter([*roots, *(a for n in below for a in graph.nodes[n].arguments)])
    where: dict[str, str] = {}
    trees: dict[int, ast.expr] = {}
    sizes: dict[int, int] = {}
    for n in below:
        node = graph.nodes[n]
        if node.operation == "constant":
            trees[n] = _constant(node.value)
        elif node.operation == "symbol":
            trees[n] = ast.Name(node.name)
        else:
            trees[n] = _tree(node.operation, [trees[a] for a in node.arguments])
        sizes[n] = 1 + sum(sizes[a] for a in node.arguments)
        if node.arguments and (uses[n] > 1 or sizes[n] > _LONG):
            name = next(names)
            where[name], trees[n], sizes[n] = ast.unparse(trees[n]), ast.Name(name), 1
    parts: dict[str, dict[str, str]] = {"where": where}
    for (part, name), root in zip(equations.places, roots, strict=True):
        parts.setdefault(part, {})[name] = ast.unparse(trees[root])
    return EquationTexts(**parts)


def _constant(value: float) -> ast.expr:
    whole = value == int(value) and abs(value) < 1e6
    size = ast.Constant(abs(int(value)) if whole else abs(value))
    return ast.UnaryOp(ast.USub(), size) if value < 0 else size


def _tree(operation: str, inputs: list[ast.expr]) -> ast.expr:
    if operation in _SIGNS:
        return ast.BinOp(inputs[0], _SIGNS[operation](), inputs[1])
    if operation in _RELATIONS:
        return ast.Compare(inputs[0], [_RELATIONS[operation]()], inputs[1:])
    if operation in _CONNECTED:
        return ast.BoolOp(_CONNECTED[operation](), inputs)
    if operation in ("neg", "not"):
        return ast.UnaryOp(ast.USub() if operation == "neg" else ast.Not(), inputs[0])
    if operation == "if":
        operation, inputs = "if_else", [*inputs, ast.Constant(0)][:3]
    return ast.Call(ast.Name(operation), inputs, [])


def equations_of(texts: EquationTexts, place: str) -> KeptEquations:
    """Return the equations of a text, functions of the symbols that it names.

    Raises InputError with a sentence for each mistake, which starts with its place in the file.
    """
    problems, reader = Problems(), _Reader()
    expressions: dict[tuple[str, str], Expression] = {}
    for (part, name), text in texts.every.items():
        try:
            value = reader.expression(text)
            if part == "where":
                reader.define(name, value)
            else:
                expressions[part, name] = value
        except ValueError as error:
            problems.add(f"'{place}.{part}.{name[:80]}' {error}")
    problems.raise_if_any()
    symbols = reader.symbols
    function = ca.Function("equations", list(symbols.values()), list(expressions.values()))
    return KeptEquations(function, tuple(symbols), tuple(expressions))


class _Reader:
    """Reads expressions; `symbols` are those that they name, which stand for nothing yet."""

    def __init__(self) -> None:
        self.symbols: dict[str, Expression] = {}
        self._defined: dict[str, Expression] = {}

    def define(self, name: str, value: Expression) -> None:
        """Give an expression a name; raises ValueError if it is taken."""
        if name in self.symbols or name in self._defined:
            raise ValueError("is used before it is defined, or is the name of a symbol.")
        self._defined[name] = value

    def expression(self, text: str) -> Expression:
        """Return the expression of a text; raises ValueError with what is wrong with it."""
        if len(text) > _CHARACTERS:
            raise ValueError(
                f"has {len(text)} characters, at most {_CHARACTERS} are read; name parts of it in"
                " 'where'."
            )
        try:
            with catch_warnings():  # of a number that ends in a word, as in 1and x
                simplefilter("error")
                tree = ast.parse(text.strip(), mode="eval").body
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            raise ValueError(
                f"is {brief(text)}, which is no expression ({type(error).__name__}); write it as in"
                " -k*x + fmax(u, 0)."
            ) from error
        return self._read(tree, 0)

    def _read(self, node: ast.AST, depth: int) -> Expression:
        if depth > _DEPTH:
            raise ValueError(f"nests deeper than {_DEPTH}; name parts of it in 'where'.")
        match node:
            case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
                return _number(value)
            case ast.Name(id=name):
                return self._named(name)
            case ast.UnaryOp(op=op, operand=operand):
                made, below = _MADE.get(type(op)), [operand]
            case ast.BinOp(left=left, op=op, right=right):
                made, below = _MADE.get(type(op)), [left, right]
            case ast.Compare(left=left, ops=[op], comparators=[right]):
                made, below = _MADE.get(type(op)), [left, right]
            case ast.BoolOp(op=op, values=below):
                made = partial(_folded, _MADE[type(op)])
            case ast.Call(func=ast.Name(id=name), args=below, keywords=[]):
                made = _function(name, len(below))
            case _:
                made, below = None, []
        if made is None:
            raise ValueError(
                f"has a Python {type(node).__name__} that no equation has; write numbers, names,"
                " + - * / **, one comparison at a time, and, or, not, and functions of these."
            )
        return made(*(self._read(n, depth + 1) for n in below))

    def _named(self, name: str) -> Expression:
        if name in self._defined:
            return self._defined[name]
        if name in _TAKEN or name in FUNCTIONS:
            raise ValueError(f"has '{name}' where a number is wanted; no symbol has that name.")
        if name not in self.symbols:
            self.symbols[name] = ca.SX.sym(name)
        return self.symbols[name]


def _folded(connect: Callable[..., Expression], *expressions: Expression) -> Expression:
    return reduce(connect, expressions)


def _function(name: str, count: int) -> Callable[..., Expression]:
    """Return a function of the text; raises ValueError if none has `count` arguments."""
    if FUNCTIONS.get(name) != count:
        known = ", ".join(f"{n} ({k})" for n, k in FUNCTIONS.items())
        raise ValueError(f"calls {name[:80]} of {count}; the functions (of how many) are {known}.")
    if name in _COMPOSED:
        result: Callable[..., Expression] = getattr(ca, name)
        return result
    return partial((ca.SX.unary, ca.SX.binary)[count - 1], getattr(ca, f"OP_{name.upper()}"))


def _number(value: float) -> Expression:
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ValueError("has a number that is too large; give a finite one.")
    return ca.SX(number)
