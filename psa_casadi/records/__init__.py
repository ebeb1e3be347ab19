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
from psa_casadi.records.read.reading import (
    Records,
    read_record,
    read_records,
    read_signals,
    record_from,
    records_given,
    write_record,
)
from psa_casadi.records.record import Record

__all__ = [
    "Record",
    "Records",
    "Waveform",
    "concatenate",
    "decaying_triangle",
    "hold",
    "multisine",
    "read_record",
    "read_records",
    "read_signals",
    "record_from",
    "records_given",
    "sine",
    "steps",
    "time_grid",
    "triangle",
    "write_record",
]
