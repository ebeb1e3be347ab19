"""The composed model, its file, and named sets of values."""
