"""Measured and planned records: reading, checking, writing, and test voltages to plan with."""

from psa_casadi.records.excitation import (
    Waveform,
    concatenate,
    decaying_triangle,
    hold,
    multisine,
    sine,
    steps,
    time_grid,
    triangle,
)
from psa_casadi.records.read.reading import read_record, read_records
from psa_casadi.records.read.write_csv import write_record
from psa_casadi.records.record import Record

__all__ = [
    "Record",
    "Waveform",
    "concatenate",
    "decaying_triangle",
    "hold",
    "multisine",
    "read_record",
    "read_records",
    "sine",
    "steps",
    "time_grid",
    "triangle",
    "write_record",
]
