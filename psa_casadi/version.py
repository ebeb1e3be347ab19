"""The version of this package, written into every model it identifies."""

__version__ = "0.2.0"
"""The version of the package."""
