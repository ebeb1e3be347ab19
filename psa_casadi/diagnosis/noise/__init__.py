"""The noise of a record: its colour, its level, and what no noise explains."""
