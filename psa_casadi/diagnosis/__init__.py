"""Diagnosis: what the simulation gets wrong, the cause, the extended model, the gain."""
