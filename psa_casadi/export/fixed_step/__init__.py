"""A model's step of fixed length and constant cost, as C for a controller or an FMU."""
