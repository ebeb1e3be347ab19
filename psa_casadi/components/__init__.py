"""Base physics: drive, forces, lag, mechanics, sensor; and the stage a stack can push on."""

from psa_casadi.component import Component
from psa_casadi.components.drive import DRIVE
from psa_casadi.components.flexure import FLEXURE
from psa_casadi.components.mechanics import CASCADE_MECHANICS, SINGLE_MASS
from psa_casadi.components.sensor import SENSOR
from psa_casadi.components.wafers import BOUC_WEN, CREEP_LAG, LINEAR_FORCE

COMPONENTS: dict[str, Component] = {
    c.name: c
    for c in (
        DRIVE,
        LINEAR_FORCE,
        BOUC_WEN,
        CREEP_LAG,
        CASCADE_MECHANICS,
        SINGLE_MASS,
        SENSOR,
        FLEXURE,
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

__all__ = ["BASE", "COMPONENTS", "SIMPLIFIED"]
