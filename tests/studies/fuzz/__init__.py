"""Damaged inputs, kills and hostile surroundings: what the package may do about them, counted."""
