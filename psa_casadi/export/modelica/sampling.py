"""Sampled states in Modelica: discrete variables, and one when-clause that gives their values.

Source: Modelica Language Specification 3.6, sections 3.7.5 (`sample`, `pre`) and 8.3.5 (when).
"""

from collections.abc import Iterable, Mapping, Sequence

import casadi as ca

from psa_casadi.component import Expression
from psa_casadi.export.modelica.words import comment
from psa_casadi.model.compose import Model
from psa_casadi.model.structure import Structure


def before(name: str) -> str:
    """Return the name of the symbol that stands for a sampled state before an instant."""
    return f"pre({name})"


def is_before(name: str) -> bool:
    """Whether a symbol stands for a sampled state before an instant."""
    return name.startswith("pre(")


def following(structure: Structure) -> dict[str, Expression]:
    """Return each sampled state's value after an instant, those before it as symbols `pre(z)`.

    A balance that depends on a sampled state is written out, because its variable has the values
    after the instant.
    """
    moving = _moving_balances(structure)
    symbols = [structure.symbols[name] for name in moving]
    terms = [structure.balances[name] for name in moving]
    earlier = ca.vertcat(ca.SX(0, 1), *(ca.SX.sym(before(s.name)) for s in structure.sampled))
    found = {}
    for state in structure.sampled:
        expression = ca.SX(structure.next[state.name])
        while any(ca.depends_on(expression, s) for s in symbols):
            expression = ca.substitute([expression], symbols, terms)[0]
        found[state.name] = ca.substitute([expression], [structure.z], [earlier])[0]
    return found


def _moving_balances(structure: Structure) -> list[str]:
    """Return the balances that depend on a sampled state, through others too."""
    moving: list[str] = []
    while True:
        reached = [structure.z, *(structure.symbols[name] for name in moving)]
        more = [
            name
            for name, terms in structure.balances.items()
            if name not in moving and ca.depends_on(terms, ca.vertcat(*reached))
        ]
        if not more:
            return moving
        moving += more


def when_lines(
    model: Model,
    period: str,
    parts: Iterable[Sequence[str]],
    equations: Mapping[str, Sequence[str]],
) -> list[str]:
    """Return the when-clause of the instants of a period.

    `equations` are the lines of each sampled state's equation, `parts` those of what they share.
    """
    lines = [f"  when sample(0, {period}) then"]
    lines += [f"  {line}" for part in parts for line in part]
    for component in model.components:
        if component.sampled:
            lines.append("    " + comment(f"{component.name}: {component.source.rstrip('.')}"))
            lines += [f"  {line}" for s in component.sampled for line in equations[s.name]]
    return [*lines, "  end when;"]
