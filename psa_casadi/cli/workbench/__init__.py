"""A local page to diagnose records: files in, columns mapped, the search watched, all saved."""
