"""What a record is worth: its noise, repeats, resolution, stuck and suspect readings."""
