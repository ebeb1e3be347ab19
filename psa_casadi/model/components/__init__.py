"""Base physics: drive, forces, lag, mechanics, sensor; and the parts of systems around a stack."""

from psa_casadi.model.component import Component
from psa_casadi.model.components import online_identification, outputs, stack, surroundings

BASE: tuple[Component, ...] = (
    stack.drive,
    stack.linear_force,
    stack.bouc_wen,
    stack.creep_lag,
    stack.cascade_mechanics,
    stack.sensor,
)
"""The paper's model behind a drive stage and in front of a sensor."""

SIMPLIFIED: tuple[Component, ...] = (*BASE[:4], stack.single_mass, stack.sensor)
"""The simplified model with one mass (paper eq. 6)."""

COMPONENTS: dict[str, Component] = {
    c.name: c
    for module in (stack, outputs, surroundings, online_identification)
    for c in vars(module).values()
    if isinstance(c, Component)
}
"""Every component that is no effect, by name."""

__all__ = ["BASE", "COMPONENTS", "SIMPLIFIED"]
