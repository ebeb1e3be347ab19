"""The version of this package, written into every model it identifies."""

__version__ = "1.0.0"
"""The version of the package."""
