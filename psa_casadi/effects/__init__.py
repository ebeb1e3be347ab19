"""What real stacks do that the paper's model does not: one small file each, a line in the table."""

from psa_casadi.component import Component
from psa_casadi.effects.current_limit import CURRENT_LIMIT
from psa_casadi.effects.hysteresis_memory import HYSTERESIS_MEMORY
from psa_casadi.effects.offset_drift import OFFSET_DRIFT
from psa_casadi.effects.rate_independent_asymmetry import RATE_INDEPENDENT_ASYMMETRY
from psa_casadi.effects.reciprocal_coupling import RECIPROCAL_COUPLING
from psa_casadi.effects.sensor_delay import SENSOR_DELAY
from psa_casadi.effects.slow_creep import SLOW_CREEP
from psa_casadi.effects.structural_mode import STRUCTURAL_MODE

EFFECTS: dict[str, Component] = {
    e.name: e
    for e in (
        SLOW_CREEP,
        HYSTERESIS_MEMORY,
        RATE_INDEPENDENT_ASYMMETRY,
        SENSOR_DELAY,
        CURRENT_LIMIT,
        STRUCTURAL_MODE,
        RECIPROCAL_COUPLING,
        OFFSET_DRIFT,
    )
}

__all__ = ["EFFECTS"]
