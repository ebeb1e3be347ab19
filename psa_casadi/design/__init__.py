"""Designed inputs: what to measure next, the voltage that follows a path, how to mount a stack."""

from psa_casadi.design.experiment.experiment import (
    informative_experiment,
    resolving_experiment,
    separating_experiment,
    usual_records,
)
from psa_casadi.design.experiment.limits import Limits
from psa_casadi.design.experiment.next_record import design_experiment
from psa_casadi.design.mechanism.mechanism import design_mechanism
from psa_casadi.design.tracking.minimum_time import quickest_move
from psa_casadi.design.tracking.targets import AmplifierLimits
from psa_casadi.design.tracking.tracking import track

__all__ = [
    "AmplifierLimits",
    "Limits",
    "design_experiment",
    "design_mechanism",
    "informative_experiment",
    "quickest_move",
    "resolving_experiment",
    "separating_experiment",
    "track",
    "usual_records",
]
