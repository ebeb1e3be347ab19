"""Base physics: drive, forces, lag, mechanics, sensor; and the parts of systems around a stack."""

from psa_casadi.model.component import Component
from psa_casadi.model.components import online_identification as online
from psa_casadi.model.components import outputs, stack, surroundings

BASE: tuple[Component, ...] = (
    stack.DRIVE,
    stack.LINEAR_FORCE,
    stack.BOUC_WEN,
    stack.CREEP_LAG,
    stack.CASCADE_MECHANICS,
    stack.SENSOR,
)
"""The paper's model behind a drive stage and in front of a sensor."""

SIMPLIFIED: tuple[Component, ...] = (*BASE[:4], stack.SINGLE_MASS, stack.SENSOR)
"""The simplified model with one mass (paper eq. 6)."""

COMPONENTS: dict[str, Component] = {
    c.name: c
    for c in (
        *BASE[:3],
        stack.MEMORY_SPECTRUM,
        *BASE[3:5],
        *SIMPLIFIED[4:],
        outputs.MONITOR,
        outputs.SECOND_SENSOR,
        outputs.STRAIN_GAUGE,
        surroundings.FLEXURE,
        surroundings.POSITION_CONTROLLER,
        surroundings.HYSTERESIS_COMPENSATOR,
        surroundings.VOLTAGE_AMPLIFIER,
        surroundings.CHARGE_AMPLIFIER,
        online.ONLINE_IDENTIFICATION,
        online.HYSTERESIS_OBSERVER,
        online.FEED_FORWARD,
        online.ADAPTIVE_FEED_FORWARD,
        surroundings.PRESTRESS_MECHANISM,
        surroundings.PRESTRESS_PORT,
        *surroundings.PRESTRESS_MOUNTS.values(),
        outputs.VALIDITY,
        outputs.VALIDITY_WITH_TEMPERATURE,
    )
}
"""Every component that is no effect, by name."""

__all__ = ["BASE", "COMPONENTS", "SIMPLIFIED"]
