"""What to measure next so that more is determined."""
