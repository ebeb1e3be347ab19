"""What real stacks do that the paper's model does not, a module a subject."""

from psa_casadi.model.component import Component
from psa_casadi.model.effects import ageing, drive, environment, mechanics, sensor, strain

EFFECTS: dict[str, Component] = {
    e.name: e
    for module in (strain, mechanics, ageing, drive, sensor, environment)
    for e in vars(module).values()
    if isinstance(e, Component)
}
"""The effects that a diagnosis of a stack tries, by name, in the order of the modules."""

__all__ = ["EFFECTS"]
