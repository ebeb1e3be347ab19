"""A model and an input make a trajectory: generated C code, the stepper, the start."""
