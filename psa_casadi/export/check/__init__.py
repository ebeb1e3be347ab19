"""`psa check`: description and behaviour of an FMU, row by row."""
