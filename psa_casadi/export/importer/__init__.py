"""A small importer: loads an FMU of either version and calls it."""
