"""The table of generic effects of a model, in the sizes that its signals have."""

from psa_casadi.any_model.effects.attached import Attached
from psa_casadi.any_model.effects.of_rates import rate_effects
from psa_casadi.any_model.effects.of_signals import signal_effects
from psa_casadi.any_model.runs import Sizes
from psa_casadi.model.compose import Model
from psa_casadi.model.from_casadi.ports import ports_of


def effects_of(model: Model, sizes: Sizes) -> tuple[Attached, ...]:
    """Return every generic effect at every port of a model that has no effects yet."""
    found: list[Attached] = []
    for port in ports_of(model):
        if port.kind == "rate":
            found += rate_effects(model, port, sizes)
        else:
            found += signal_effects(port, sizes)
    return tuple(found)
