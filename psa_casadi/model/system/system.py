"""Whole systems: models wired output to input, as a list of wires and as one model.

A wire leads from an output, "controller.command", to an input, "amplifier.command". An output may
feed any number of inputs, an input takes one wire. `connect` substitutes the wires' equations and
gives one model, which simulates and exports like any other: its variables are named
`part_variable`, its components are the parts.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from psa_casadi.component import Component
from psa_casadi.model.compose import Model, compose
from psa_casadi.model.system.ports import plan_of
from psa_casadi.model.system.wiring import wired_components

__all__ = ["System", "connect"]


@dataclass(frozen=True)
class System:
    """Parts by name, the wires between them, and what the surroundings see of them.

    `inputs` and `outputs` map the name outside to "part.port". An input that has neither a wire
    nor a name outside rests at its start value.
    """

    name: str
    parts: Mapping[str, Model]
    wires: tuple[tuple[str, str], ...]
    inputs: Mapping[str, str]
    outputs: Mapping[str, str]
    description: str = ""

    def model(self) -> Model:
        """Return the system as one model."""
        return connect(
            self.parts,
            self.wires,
            name=self.name,
            inputs=self.inputs,
            outputs=self.outputs,
            description=self.description,
        )


def connect(
    parts: Mapping[str, Model],
    wires: Sequence[tuple[str, str]],
    *,
    name: str,
    inputs: Mapping[str, str] | None = None,
    outputs: Mapping[str, str] | None = None,
    description: str = "",
) -> Model:
    """Return one model of wired parts; each part becomes a component.

    `inputs` and `outputs` map names outside to "part.port". Without `inputs` every input that has
    no wire is one, named `part_port`; without `outputs` every output is. A sampled part sees, at an
    instant, what the other sampled parts held before it; all have one period, the parameter of the
    first of them.

    Raises InputError, with all mistakes at once, for a port that does not exist, an input with two
    sources, a wire between units that differ, periods that differ, and a loop of outputs that
    follow their inputs at once, which it names.
    """
    plan = plan_of(parts, wires, inputs, outputs)
    components = wired_components(parts, plan)
    return compose(components, _values(parts, components), name=name, description=description)


def _values(parts: Mapping[str, Model], components: Iterable[Component]) -> dict[str, float]:
    given = {f"{part}_{n}": v for part, model in parts.items() for n, v in model.values.items()}
    declared = {p.name for c in components for p in c.parameters}
    return {n: v for n, v in given.items() if n in declared}
