"""All hidden effects by name."""

from tests.studies.plants.ageing import AGEING
from tests.studies.plants.asymmetric_memory import ASYMMETRIC_MEMORY
from tests.studies.plants.backlash import BACKLASH
from tests.studies.plants.charge_leakage import CHARGE_LEAKAGE
from tests.studies.plants.converter_step import CONVERTER_STEP
from tests.studies.plants.cross_axis import CROSS_AXIS
from tests.studies.plants.current_limit import CURRENT_LIMIT
from tests.studies.plants.dead_zone_hysteresis import DEAD_ZONE_HYSTERESIS
from tests.studies.plants.drive_lag import DRIVE_LAG
from tests.studies.plants.dry_friction import DRY_FRICTION
from tests.studies.plants.effect import HiddenEffect
from tests.studies.plants.encoder_ripple import ENCODER_RIPPLE
from tests.studies.plants.field_dependent_gain import FIELD_DEPENDENT_GAIN
from tests.studies.plants.floor_vibration import FLOOR_VIBRATION
from tests.studies.plants.guide_stiffness import GUIDE_STIFFNESS
from tests.studies.plants.hysteresis_memory import HYSTERESIS_MEMORY
from tests.studies.plants.load_stiffness import LOAD_STIFFNESS
from tests.studies.plants.mains_hum import MAINS_HUM
from tests.studies.plants.offset_drift import OFFSET_DRIFT
from tests.studies.plants.preload_loss import PRELOAD_LOSS
from tests.studies.plants.range_switch import RANGE_SWITCH
from tests.studies.plants.rate_dependent_hysteresis import RATE_DEPENDENT_HYSTERESIS
from tests.studies.plants.rate_independent_asymmetry import RATE_INDEPENDENT_ASYMMETRY
from tests.studies.plants.saturation_of_strain import SATURATION_OF_STRAIN
from tests.studies.plants.self_heating import SELF_HEATING
from tests.studies.plants.sensor_delay import SENSOR_DELAY
from tests.studies.plants.sensor_lag import SENSOR_LAG
from tests.studies.plants.sensor_nonlinearity import SENSOR_NONLINEARITY
from tests.studies.plants.slow_creep import SLOW_CREEP
from tests.studies.plants.source_power import SOURCE_POWER
from tests.studies.plants.structural_mode import STRUCTURAL_MODE
from tests.studies.plants.temperature import TEMPERATURE
from tests.studies.plants.voltage_saturation import VOLTAGE_SATURATION

HIDDEN_EFFECTS: dict[str, HiddenEffect] = {
    effect.name: effect
    for effect in (
        SLOW_CREEP,
        RATE_DEPENDENT_HYSTERESIS,
        HYSTERESIS_MEMORY,
        ASYMMETRIC_MEMORY,
        RATE_INDEPENDENT_ASYMMETRY,
        FIELD_DEPENDENT_GAIN,
        SATURATION_OF_STRAIN,
        STRUCTURAL_MODE,
        LOAD_STIFFNESS,
        PRELOAD_LOSS,
        BACKLASH,
        SELF_HEATING,
        AGEING,
        CURRENT_LIMIT,
        VOLTAGE_SATURATION,
        DRIVE_LAG,
        CHARGE_LEAKAGE,
        SENSOR_DELAY,
        SENSOR_LAG,
        SENSOR_NONLINEARITY,
        ENCODER_RIPPLE,
        CONVERTER_STEP,
        OFFSET_DRIFT,
        MAINS_HUM,
        TEMPERATURE,
        DRY_FRICTION,
        FLOOR_VIBRATION,
        GUIDE_STIFFNESS,
        DEAD_ZONE_HYSTERESIS,
        CROSS_AXIS,
        RANGE_SWITCH,
        SOURCE_POWER,
    )
}
"""In the project's table, then the foreign ones. Reciprocal coupling has a plant of its own
(reciprocal_coupling.py) but is left out: it moves resonances of 1-20 kHz, which no record
here sees.
"""

KNOWN = tuple(name for name, effect in HIDDEN_EFFECTS.items() if not effect.foreign)
"""Those that the project's table has."""
FOREIGN = tuple(name for name, effect in HIDDEN_EFFECTS.items() if effect.foreign)
"""Those that it has not: the right verdict is that the cause is not in the table."""


def called(name: str) -> str:
    """Return what the project's table calls a hidden effect."""
    return HIDDEN_EFFECTS[name].called or name
