"""For use sample by sample in a control loop: observers, feed-forward, identification online."""

from psa_casadi.design.online.observer import FeedForward, HysteresisObserver, stack_values
from psa_casadi.design.online.part_for import part_for
from psa_casadi.design.online.recursive_least_squares import (
    AdaptiveFeedForward,
    OnlineIdentification,
    identifier_for,
)

__all__ = [
    "AdaptiveFeedForward",
    "FeedForward",
    "HysteresisObserver",
    "OnlineIdentification",
    "identifier_for",
    "part_for",
    "stack_values",
]
