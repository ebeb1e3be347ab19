"""What real stacks do that the paper's model does not: a module a subject, a line in the table."""

from psa_casadi.model.component import Component
from psa_casadi.model.effects import drive, environment, hysteresis, mechanics, sensor, strain

EFFECTS: dict[str, Component] = {
    e.name: e
    for e in (
        strain.SLOW_CREEP,
        hysteresis.RATE_DEPENDENT_HYSTERESIS,
        hysteresis.HYSTERESIS_MEMORY,
        hysteresis.RATE_INDEPENDENT_ASYMMETRY,
        strain.FIELD_DEPENDENT_GAIN,
        strain.FIELD_DEPENDENT_CAPACITANCE,
        strain.SATURATION_OF_STRAIN,
        mechanics.RECIPROCAL_COUPLING,
        mechanics.STRUCTURAL_MODE,
        mechanics.LOAD_STIFFNESS,
        mechanics.PRELOAD_LOSS,
        mechanics.BACKLASH,
        strain.SELF_HEATING,
        strain.AGEING,
        drive.CURRENT_LIMIT,
        drive.VOLTAGE_SATURATION,
        drive.DRIVE_LAG,
        drive.AMPLIFIER_NONLINEARITY,
        drive.CHARGE_LEAKAGE,
        sensor.SENSOR_DELAY,
        sensor.SENSOR_LAG,
        sensor.SENSOR_NONLINEARITY,
        sensor.SENSOR_RIPPLE,
        sensor.SENSOR_JUMP,
        environment.OFFSET_DRIFT,
        environment.MAINS_HUM,
        environment.TEMPERATURE,
    )
}
"""The effects that a diagnosis of a stack tries, by name."""

__all__ = ["EFFECTS"]
