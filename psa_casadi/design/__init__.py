"""Designed inputs: what to measure next, the voltage that follows a path, how to mount a stack."""
