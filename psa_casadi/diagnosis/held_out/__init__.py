"""Errors on data that no fit has seen, and whether a model holds there."""
