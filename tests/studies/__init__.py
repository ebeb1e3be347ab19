"""Studies: what is run by name and not on every change."""
