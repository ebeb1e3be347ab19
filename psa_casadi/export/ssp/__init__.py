"""A system of models as an SSP archive."""
