"""What real stacks do that the paper's model does not: one small file each, a line in the table."""

from psa_casadi.component import Component
from psa_casadi.effects.ageing import AGEING
from psa_casadi.effects.amplifier_nonlinearity import AMPLIFIER_NONLINEARITY
from psa_casadi.effects.backlash import BACKLASH
from psa_casadi.effects.charge_leakage import CHARGE_LEAKAGE
from psa_casadi.effects.current_limit import CURRENT_LIMIT
from psa_casadi.effects.drive_lag import DRIVE_LAG
from psa_casadi.effects.field_dependent_capacitance import FIELD_DEPENDENT_CAPACITANCE
from psa_casadi.effects.field_dependent_gain import FIELD_DEPENDENT_GAIN
from psa_casadi.effects.hysteresis_memory import HYSTERESIS_MEMORY
from psa_casadi.effects.load_stiffness import LOAD_STIFFNESS
from psa_casadi.effects.mains_hum import MAINS_HUM
from psa_casadi.effects.offset_drift import OFFSET_DRIFT
from psa_casadi.effects.preload_loss import PRELOAD_LOSS
from psa_casadi.effects.rate_dependent_hysteresis import RATE_DEPENDENT_HYSTERESIS
from psa_casadi.effects.rate_independent_asymmetry import RATE_INDEPENDENT_ASYMMETRY
from psa_casadi.effects.reciprocal_coupling import RECIPROCAL_COUPLING
from psa_casadi.effects.saturation_of_strain import SATURATION_OF_STRAIN
from psa_casadi.effects.self_heating import SELF_HEATING
from psa_casadi.effects.sensor_delay import SENSOR_DELAY
from psa_casadi.effects.sensor_jump import SENSOR_JUMP
from psa_casadi.effects.sensor_lag import SENSOR_LAG
from psa_casadi.effects.sensor_nonlinearity import SENSOR_NONLINEARITY
from psa_casadi.effects.sensor_ripple import SENSOR_RIPPLE
from psa_casadi.effects.slow_creep import SLOW_CREEP
from psa_casadi.effects.structural_mode import STRUCTURAL_MODE
from psa_casadi.effects.temperature import TEMPERATURE
from psa_casadi.effects.voltage_saturation import VOLTAGE_SATURATION

EFFECTS: dict[str, Component] = {
    e.name: e
    for e in (
        SLOW_CREEP,
        RATE_DEPENDENT_HYSTERESIS,
        HYSTERESIS_MEMORY,
        RATE_INDEPENDENT_ASYMMETRY,
        FIELD_DEPENDENT_GAIN,
        FIELD_DEPENDENT_CAPACITANCE,
        SATURATION_OF_STRAIN,
        RECIPROCAL_COUPLING,
        STRUCTURAL_MODE,
        LOAD_STIFFNESS,
        PRELOAD_LOSS,
        BACKLASH,
        SELF_HEATING,
        AGEING,
        CURRENT_LIMIT,
        VOLTAGE_SATURATION,
        DRIVE_LAG,
        AMPLIFIER_NONLINEARITY,
        CHARGE_LEAKAGE,
        SENSOR_DELAY,
        SENSOR_LAG,
        SENSOR_NONLINEARITY,
        SENSOR_RIPPLE,
        SENSOR_JUMP,
        OFFSET_DRIFT,
        MAINS_HUM,
        TEMPERATURE,
    )
}

__all__ = ["EFFECTS"]
