"""Worked examples (Python modules with a `main(folder)`) and recipes for other tools (pages)."""
