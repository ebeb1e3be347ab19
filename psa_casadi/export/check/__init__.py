"""`psa check`: what an FMU says and does, row by row."""
