"""Models as other tools take them: FMU, and the check of an FMU."""
