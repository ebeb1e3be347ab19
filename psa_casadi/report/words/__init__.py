"""Numbers, phrases, tables and plain text."""
