"""Rows and two columns of a table of numbers in text."""

from collections.abc import Sequence
from dataclasses import dataclass

from psa_casadi.datasets.conversions.csv_text import csv_text


@dataclass(frozen=True)
class Columns:
    """A part of a table of numbers that becomes a record: rows, and two of its columns.

    `first_row` and the columns are counted from 0; the displacement is in um.
    """

    first_row: int
    rows: int
    voltage: int
    displacement: int
    sample_rate: float

    @property
    def words(self) -> str:
        """What is taken, in words."""
        return (
            f"{self.rows} rows from row {self.first_row} on, columns {self.voltage} and"
            f" {self.displacement}, all counted from 0"
        )

    def csv(self, originals: Sequence[bytes]) -> bytes:
        """Return the CSV file of the record, from the one table."""
        lines = originals[0].decode("ascii").splitlines()[self.first_row :][: self.rows]
        cells = [line.split() for line in lines]
        samples = ((float(c[self.voltage]), float(c[self.displacement])) for c in cells)
        return csv_text(samples, self.sample_rate, 3)
