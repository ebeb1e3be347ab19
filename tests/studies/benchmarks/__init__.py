"""The tables behind every figure the project states: `python -m tests.studies`."""
