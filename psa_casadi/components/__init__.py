"""Base physics: drive, forces, lag, mechanics, sensor; and the parts of systems around a stack."""

from psa_casadi.component import Component
from psa_casadi.components.amplifiers import CHARGE_AMPLIFIER, VOLTAGE_AMPLIFIER
from psa_casadi.components.drive import DRIVE
from psa_casadi.components.flexure import FLEXURE
from psa_casadi.components.further_sensors import MONITOR, SECOND_SENSOR, STRAIN_GAUGE
from psa_casadi.components.hysteresis_compensator import HYSTERESIS_COMPENSATOR
from psa_casadi.components.mechanics import CASCADE_MECHANICS, SINGLE_MASS
from psa_casadi.components.memory_spectrum import MEMORY_SPECTRUM
from psa_casadi.components.online_identification import ONLINE_IDENTIFICATION
from psa_casadi.components.position_controller import POSITION_CONTROLLER
from psa_casadi.components.prestress import (
    PRESTRESS_MECHANISM,
    PRESTRESS_MOUNTS,
    PRESTRESS_PORT,
)
from psa_casadi.components.sampled_feed_forward import (
    ADAPTIVE_FEED_FORWARD,
    FEED_FORWARD,
    HYSTERESIS_OBSERVER,
)
from psa_casadi.components.sensor import SENSOR
from psa_casadi.components.validity import VALIDITY, VALIDITY_WITH_TEMPERATURE
from psa_casadi.components.wafers import BOUC_WEN, CREEP_LAG, LINEAR_FORCE

COMPONENTS: dict[str, Component] = {
    c.name: c
    for c in (
        DRIVE,
        LINEAR_FORCE,
        BOUC_WEN,
        MEMORY_SPECTRUM,
        CREEP_LAG,
        CASCADE_MECHANICS,
        SINGLE_MASS,
        SENSOR,
        MONITOR,
        SECOND_SENSOR,
        STRAIN_GAUGE,
        FLEXURE,
        POSITION_CONTROLLER,
        HYSTERESIS_COMPENSATOR,
        VOLTAGE_AMPLIFIER,
        CHARGE_AMPLIFIER,
        ONLINE_IDENTIFICATION,
        HYSTERESIS_OBSERVER,
        FEED_FORWARD,
        ADAPTIVE_FEED_FORWARD,
        PRESTRESS_MECHANISM,
        PRESTRESS_PORT,
        *PRESTRESS_MOUNTS.values(),
        VALIDITY,
        VALIDITY_WITH_TEMPERATURE,
    )
}

#: The paper's model behind a drive stage and in front of a sensor.
BASE: tuple[Component, ...] = (
    DRIVE,
    LINEAR_FORCE,
    BOUC_WEN,
    CREEP_LAG,
    CASCADE_MECHANICS,
    SENSOR,
)

#: The simplified model with one mass (paper eq. 6).
SIMPLIFIED: tuple[Component, ...] = (DRIVE, LINEAR_FORCE, BOUC_WEN, CREEP_LAG, SINGLE_MASS, SENSOR)

__all__ = [
    "BASE",
    "BOUC_WEN",
    "COMPONENTS",
    "MEMORY_SPECTRUM",
    "MONITOR",
    "SECOND_SENSOR",
    "SIMPLIFIED",
    "STRAIN_GAUGE",
]
