"""Scripts that build and check the project, run from the root as `python -m`."""
