"""What becomes of an original: each conversion is deterministic to the byte."""
