"""Identification and diagnosis of any model: own equations, several inputs and outputs."""
