"""What the records determine: intervals, combinations, profiles, information."""
