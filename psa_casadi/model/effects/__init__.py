"""What real stacks do that the paper's model does not: a module a subject, a line in the table."""

from psa_casadi.model.component import Component
from psa_casadi.model.effects import drive, environment, hysteresis, mechanics, sensor, strain

EFFECTS: dict[str, Component] = {
    e.name: e
    for e in (
        strain.slow_creep,
        hysteresis.rate_dependent_hysteresis,
        hysteresis.hysteresis_memory,
        hysteresis.rate_independent_asymmetry,
        strain.field_dependent_gain,
        strain.field_dependent_capacitance,
        strain.saturation_of_strain,
        mechanics.reciprocal_coupling,
        mechanics.structural_mode,
        mechanics.load_stiffness,
        mechanics.preload_loss,
        mechanics.backlash,
        strain.self_heating,
        strain.ageing,
        drive.current_limit,
        drive.voltage_saturation,
        drive.drive_lag,
        drive.amplifier_nonlinearity,
        drive.charge_leakage,
        sensor.sensor_delay,
        sensor.sensor_lag,
        sensor.sensor_nonlinearity,
        sensor.sensor_ripple,
        sensor.sensor_jump,
        environment.offset_drift,
        environment.mains_hum,
        environment.temperature,
    )
}
"""The effects that a diagnosis of a stack tries, by name."""

__all__ = ["EFFECTS"]
