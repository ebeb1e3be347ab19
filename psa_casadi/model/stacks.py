"""Named stacks: a value for every parameter of the base model (cascade), and where it is from.

The figures are in `stacks.toml`, where it is stated how the assumed ones hang together. What
neither the paper (Yang and Zhu 2015) nor a data sheet gives is marked as assumed.
"""

import difflib
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from psa_casadi.common.errors import InputError
from psa_casadi.model.components import BASE
from psa_casadi.model.compose import Model, compose
from psa_casadi.model.variables import Provenance


@dataclass(frozen=True)
class Figure:
    """One value in SI units, its source, and whether it is assumed rather than published."""

    value: float
    source: str
    assumed: bool


@dataclass(frozen=True)
class Stack:
    """A stack by name, with a figure for every parameter of the base components (cascade)."""

    name: str
    description: str
    values: dict[str, Figure]

    @property
    def assumed(self) -> tuple[str, ...]:
        """Names of the parameters whose figures are assumed."""
        return tuple(name for name, figure in self.values.items() if figure.assumed)


_FILE: dict[str, dict[str, Any]] = tomllib.loads(
    files("psa_casadi.model").joinpath("stacks.toml").read_text(encoding="utf-8")
)


def _figures(stack: Mapping[str, Any]) -> dict[str, Figure]:
    """Return the figures that the file has of a stack."""
    figures = _figures(_FILE[stack["like"]]) if "like" in stack else {}
    for kind in ("sourced", "assumed"):
        for name, (value, source) in stack.get(kind, {}).items():
            text = source.format(run=stack.get("run", ""))
            figures[name] = Figure(value, text, assumed=kind == "assumed")
    return figures


STACKS: dict[str, Stack] = {
    name: Stack(name, stack["description"], _figures(stack)) for name, stack in _FILE.items()
}
"""The named stacks, as `psa stacks` lists them."""


def stack_model(name: str) -> Model:
    """Return a named stack as a model (cascade), its name made an identifier.

    Raises InputError for an unknown name.
    """
    if name not in STACKS:
        by_lower = {known.lower(): known for known in STACKS}
        near = difflib.get_close_matches(name.lower(), by_lower, n=1, cutoff=0.5)
        meant = f"did you mean {by_lower[near[0]]}?" if near else f"there are {', '.join(STACKS)}."
        raise InputError(f"There is no stack named '{name}'; {meant}")
    stack = STACKS[name]
    note = (
        f"Named stack {name}: {len(stack.assumed)} of its {len(stack.values)} figures are assumed;"
        f" `psa stacks {name}` shows which."
    )
    values = {key: figure.value for key, figure in stack.values.items()}
    model = compose(BASE, values, name=re.sub(r"\W", "_", name), description=stack.description)
    return model.with_values({}, provenance=Provenance(notes=(note,)))
