"""Reads the scripts of the recipes (Modelica scripts, MATLAB): every call with its arguments.

No tool that runs them is at hand, so their grammar is parsed here, by lark, as strictly as the two
languages are for what the scripts use: assignments, calls, strings, numbers, arrays, sums.
"""

from dataclasses import dataclass, field
from typing import Any

import lark

_GRAMMAR = r"""
start: statement*
statement: [NAME ASSIGN] expression ";"
?expression: product (SIGN product)*
?product: factor (TIMES factor)*
?factor: SIGN factor | call | reference | array | STRING | NUMBER | "(" expression ")"
call: reference "(" [argument ("," argument)*] ")"
argument: [NAME "="] expression
reference: NAME ("." NAME)*
ASSIGN: "%(assign)s"
SIGN: "+" | "-"
TIMES: "*" | "/"
NAME: /[A-Za-z_]\w*/
NUMBER: /\d+(\.\d*)?([eE][+-]?\d+)?/
%(rest)s
COMMENT: /%(comment)s[^\n]*/
%%ignore COMMENT
%%ignore /\s+/
"""
_MODELICA = lark.Lark(
    _GRAMMAR
    % {
        "assign": ":=",
        "comment": r"\/\/",
        "rest": 'array: "{" [expression ("," expression)*] "}"\nSTRING: /"[^"\\n]*"/',
    }
)
_MATLAB = lark.Lark(
    _GRAMMAR
    % {
        "assign": "=",
        "comment": "%",
        "rest": 'array: "[" expression+ "]"\nSTRING: /\'[^\'\\n]*\'/',
    }
)


@dataclass(frozen=True)
class Call:
    """One call: the function's name, what stands in its place-bound and its named arguments."""

    function: str
    arguments: tuple[str, ...]
    named: dict[str, str] = field(default_factory=dict)


def calls_of(text: str, language: str) -> list[Call]:
    """Return the calls of a script in order; raises lark.exceptions.LarkError for bad syntax."""
    parser = _MODELICA if language == "modelica" else _MATLAB
    tree = parser.parse(text)
    return [_call(node) for statement in tree.children for node in _nodes(statement, "call")]


def _nodes(tree: Any, kind: str) -> list[Any]:
    return [t for t in tree.iter_subtrees_topdown() if t.data == kind]


def _call(node: Any) -> Call:
    reference, *arguments = (child for child in node.children if child is not None)
    plain, named = [], {}
    for argument in arguments:
        name, value = argument.children
        if name is None:
            plain.append(_text(value))
        else:
            named[str(name)] = _text(value)
    return Call(_text(reference), tuple(plain), named)


def _text(value: Any) -> str:
    """Return an expression as it was written, without spaces and without the quotes of a string."""
    if not isinstance(value, lark.Tree):
        return str(value).strip("\"'") if value.type == "STRING" else str(value)
    parts = [_text(child) for child in value.children if child is not None]
    return (".".join if value.data == "reference" else "".join)(parts)
