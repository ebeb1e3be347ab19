"""Measured and planned records: reading, checking, writing, and test voltages to plan with."""

from psa_casadi.records.excitation import decaying_triangle, multisine, sine, time_grid, triangle
from psa_casadi.records.read.reading import (
    read_record,
    read_records,
    read_signals,
    record_from,
    write_record,
)
from psa_casadi.records.record import Record

__all__ = [
    "Record",
    "decaying_triangle",
    "multisine",
    "read_record",
    "read_records",
    "read_signals",
    "record_from",
    "sine",
    "time_grid",
    "triangle",
    "write_record",
]
