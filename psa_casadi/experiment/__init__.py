"""Measured and planned records: reading, checking, writing, and test voltages to plan with."""

from psa_casadi.experiment.excitation import (
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
from psa_casadi.experiment.reading import read_record, read_records
from psa_casadi.experiment.record import Record
from psa_casadi.experiment.write_csv import write_record

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
