"""Words of a Modelica text: identifiers, numbers, strings, units.

Source: Modelica Language Specification 3.6, section 2.3 (lexical structure) and 3.7 (operators).
"""

import html
import math
import re
from collections.abc import Iterable

from psa_casadi.errors import InputError

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


def modifier(attributes: Iterable[tuple[str, str | None]]) -> str:
    """Return the attributes that have a value in parentheses, or nothing if none has."""
    given = [f"{name}={value}" for name, value in attributes if value is not None]
    return f"({', '.join(given)})" if given else ""


def escaped(text: str) -> str:
    """Return a text as HTML."""
    return html.escape(text, quote=False)
