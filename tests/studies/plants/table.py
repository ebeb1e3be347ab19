"""All hidden effects by name."""

from tests.studies.plants import ceramic, drive, mechanics, sensor
from tests.studies.plants.effect import HiddenEffect

_EFFECTS = (
    ceramic.slow_creep, ceramic.rate_dependent_hysteresis, ceramic.hysteresis_memory,
    ceramic.asymmetric_memory, ceramic.rate_independent_asymmetry, ceramic.field_dependent_gain,
    ceramic.saturation_of_strain, mechanics.structural_mode, mechanics.load_stiffness,
    mechanics.preload_loss, mechanics.backlash, ceramic.self_heating, ceramic.ageing,
    drive.current_limit, drive.voltage_saturation, drive.drive_lag, drive.charge_leakage,
    sensor.sensor_delay, sensor.sensor_lag, sensor.sensor_nonlinearity, sensor.encoder_ripple,
    sensor.converter_step, sensor.offset_drift, sensor.mains_hum, sensor.temperature,
    mechanics.dry_friction, mechanics.floor_vibration, mechanics.guide_stiffness,
    ceramic.dead_zone_hysteresis, mechanics.cross_axis, sensor.range_switch, sensor.source_power,
)  # fmt: skip
HIDDEN_EFFECTS: dict[str, HiddenEffect] = {effect.name: effect for effect in _EFFECTS}
"""Effects of the project's table, then the foreign ones. Reciprocal coupling is left out: its
plant (`mechanics.two_masses`) moves resonances of 1-20 kHz, which no record here contains.
"""

KNOWN = tuple(name for name, effect in HIDDEN_EFFECTS.items() if not effect.foreign)
"""Those that the project's table has."""
FOREIGN = tuple(name for name, effect in HIDDEN_EFFECTS.items() if effect.foreign)
"""Those that it has not: the right verdict is that the cause is not in the table."""


def called(name: str) -> str:
    """Return what the project's table calls a hidden effect."""
    return HIDDEN_EFFECTS[name].called or name
