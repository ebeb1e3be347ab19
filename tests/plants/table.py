"""All hidden effects by name."""

from tests.plants.current_limit import CURRENT_LIMIT
from tests.plants.dry_friction import DRY_FRICTION
from tests.plants.effect import HiddenEffect
from tests.plants.encoder_ripple import ENCODER_RIPPLE
from tests.plants.floor_vibration import FLOOR_VIBRATION
from tests.plants.hysteresis_memory import HYSTERESIS_MEMORY
from tests.plants.offset_drift import OFFSET_DRIFT
from tests.plants.rate_independent_asymmetry import RATE_INDEPENDENT_ASYMMETRY
from tests.plants.sensor_delay import SENSOR_DELAY
from tests.plants.slow_creep import SLOW_CREEP
from tests.plants.structural_mode import STRUCTURAL_MODE

HIDDEN_EFFECTS: dict[str, HiddenEffect] = {
    effect.name: effect
    for effect in (
        SLOW_CREEP,
        HYSTERESIS_MEMORY,
        RATE_INDEPENDENT_ASYMMETRY,
        SENSOR_DELAY,
        CURRENT_LIMIT,
        STRUCTURAL_MODE,
        OFFSET_DRIFT,
        DRY_FRICTION,
        ENCODER_RIPPLE,
        FLOOR_VIBRATION,
    )
}
"""In the project's table, then the foreign ones."""

KNOWN = tuple(name for name, effect in HIDDEN_EFFECTS.items() if not effect.foreign)
"""Names that the project's table has."""
FOREIGN = tuple(name for name, effect in HIDDEN_EFFECTS.items() if effect.foreign)
"""Names that it has not: the right verdict is that the cause is not in the table."""
