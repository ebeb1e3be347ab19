"""Base physics: drive, forces, lag, mechanics, sensor; and the parts of systems around a stack."""

from psa_casadi.model.component import Component
from psa_casadi.model.components import online_identification as online
from psa_casadi.model.components import outputs, stack, surroundings

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
    for c in (
        *BASE[:3],
        stack.memory_spectrum,
        *BASE[3:5],
        *SIMPLIFIED[4:],
        outputs.monitor,
        outputs.second_sensor,
        outputs.strain_gauge,
        surroundings.flexure,
        surroundings.position_controller,
        surroundings.hysteresis_compensator,
        surroundings.voltage_amplifier,
        surroundings.charge_amplifier,
        online.online_identification,
        online.hysteresis_observer,
        online.feed_forward,
        online.adaptive_feed_forward,
        surroundings.prestress_mechanism,
        surroundings.prestress_port,
        *surroundings.PRESTRESS_MOUNTS.values(),
        outputs.VALIDITY,
        outputs.VALIDITY_WITH_TEMPERATURE,
    )
}
"""Every component that is no effect, by name."""

__all__ = ["BASE", "COMPONENTS", "SIMPLIFIED"]
