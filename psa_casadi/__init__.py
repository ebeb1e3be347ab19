"""psa_casadi: what a piezoelectric stack actuator's simulation gets wrong, found in measured data."""

__version__ = "0.1.0"
