"""Several starts, the best ones followed to the end, what can be told besides."""
