"""Independent plants: synthetic records that hide one effect, written without any part of the
project's models.
"""
