"""Designed inputs: what to measure next, the voltage that follows a path, how to mount a stack.

Each name is loaded when it is first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from psa_casadi.design.experiment.experiment import (
        informative_experiment,
        resolving_experiment,
        separating_experiment,
        usual_records,
    )
    from psa_casadi.design.experiment.limits import Limits
    from psa_casadi.design.mechanism.mechanism import design_mechanism
    from psa_casadi.design.tracking.minimum_time import quickest_move
    from psa_casadi.design.tracking.targets import AmplifierLimits
    from psa_casadi.design.tracking.tracking import track

_HOME_OF = {
    "AmplifierLimits": "tracking.amplifier_limits",
    "Limits": "experiment.limits",
    "design_mechanism": "mechanism.mechanism",
    "informative_experiment": "experiment.experiment",
    "quickest_move": "tracking.minimum_time",
    "resolving_experiment": "experiment.experiment",
    "separating_experiment": "experiment.experiment",
    "track": "tracking.tracking",
    "usual_records": "experiment.experiment",
}

__all__ = [
    "AmplifierLimits",
    "Limits",
    "design_mechanism",
    "informative_experiment",
    "quickest_move",
    "resolving_experiment",
    "separating_experiment",
    "track",
    "usual_records",
]


def __getattr__(name: str) -> Any:
    """Load a public name from where it lives."""
    if name not in _HOME_OF:
        raise AttributeError(f"module 'psa_casadi.design' has no attribute '{name}'")
    return getattr(import_module(f"psa_casadi.design.{_HOME_OF[name]}"), name)


def __dir__() -> list[str]:
    """List the public names, loaded or not."""
    return sorted({*globals(), *__all__})
