"""What a designed voltage may be: range, length, rate, current and bandwidth."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from psa_casadi.errors import Problems
from psa_casadi.records.excitation import time_grid
from psa_casadi.records.record import Record
from psa_casadi.units import FloatArray

#: Bandwidth over the sampling rate where none is given: twenty samples for a whole cycle.
BAND = 0.05
#: A designed record rests at its first voltage for this share of its samples, or this many.
REST_SHARE, REST_SAMPLES = 0.01, 4
_FEWEST = 50


@dataclass(frozen=True)
class Limits:
    """Limits of a designed record.

    Voltages between `low` and `high` [V]; `samples` samples over `duration` [s]; changes of at most
    `rate` [V/s], and at most what a `current` [A] into the stack's capacitance allows,
    C_p |dv/dt| <= current; no full cycle shorter than 1/`bandwidth` [1/Hz], so that tones stay
    below it and voltages turn no sooner than after half of that. `bandwidth` None stands for a
    twentieth of the sampling rate. Raises InputError with all that is wrong.
    """

    low: float
    high: float
    duration: float
    samples: int
    rate: float = float("inf")
    current: float = float("inf")
    bandwidth: float | None = None

    def __post_init__(self) -> None:
        problems = Problems()
        if not self.low < self.high:
            problems.add(
                f"The voltage range {self.low:g} V to {self.high:g} V is empty; give the lowest"
                " voltage below the highest."
            )
        if not 0.0 < self.duration < float("inf"):
            problems.add(f"The duration is {self.duration:g} s; give a positive number of seconds.")
        if self.samples < _FEWEST:
            problems.add(
                f"{self.samples} samples hold no experiment; give {_FEWEST} or more, a thousand are"
                " usual."
            )
        for name, value in (
            ("rate [V/s]", self.rate),
            ("current [A]", self.current),
            ("bandwidth [Hz]", self.bandwidth),
        ):
            if value is not None and not value > 0.0:
                problems.add(f"The largest {name} is {value:g}; give a positive one, or none.")
        problems.raise_if_any()
        if self.band * self.duration < 1.0:
            problems.add(
                f"A bandwidth of {self.band:g} Hz allows no whole cycle in {self.duration:g} s;"
                " lengthen the record or widen the band."
            )
        elif self.band > 0.5 * self.samples / self.duration:
            problems.add(
                f"A bandwidth of {self.band:g} Hz cannot be shown by {self.samples} samples in"
                f" {self.duration:g} s; sample at {2.0 * self.band:g} Hz or faster, or narrow it."
            )
        problems.raise_if_any()

    @property
    def band(self) -> float:
        """Bandwidth [Hz], given or a twentieth of the sampling rate."""
        return self.bandwidth or BAND * self.samples / self.duration

    @property
    def span(self) -> float:
        """Width of the voltage range [V]."""
        return self.high - self.low

    @property
    def shortest(self) -> float:
        """Shortest time between two turns of the voltage [s]: half a cycle."""
        return 0.5 / self.band

    def steepest(self, capacitance: float | None) -> float:
        """Return the largest rate [V/s] that rate and current allow; C_p [F] or None."""
        by_current = self.current / capacitance if capacitance else float("inf")
        return min(self.rate, by_current)

    def grid(self, samples: int | None = None) -> FloatArray:
        """Return the instants [s] of the record, (samples,), or of a coarser one."""
        return time_grid(self.duration, self.duration / (samples or self.samples))


def limits_of(records: Sequence[Record], **changes: float | None) -> Limits:
    """Return limits like those that records kept: their voltages, the longest one's length.

    `changes` replace fields that are not None.
    """
    longest = max(records, key=lambda r: r.duration)
    own: dict[str, float] = {
        "low": min(float(np.min(r.voltage)) for r in records),
        "high": max(float(np.max(r.voltage)) for r in records),
        "duration": longest.duration * longest.n / (longest.n - 1),
        "samples": longest.n,
    }
    own.update({k: v for k, v in changes.items() if v is not None})
    return _limits(own)


def _limits(given: Mapping[str, float]) -> Limits:
    fields = dict(given)
    samples = int(fields.pop("samples"))
    return Limits(fields.pop("low"), fields.pop("high"), fields.pop("duration"), samples, **fields)


def excess(record: Record, limits: Limits, capacitance: float | None) -> tuple[str, ...]:
    """Return a sentence for every limit of voltage, rate or current that a record exceeds."""
    slope = float(np.max(np.abs(np.diff(record.voltage) / np.diff(record.time))))
    found = []
    margin = 1e-9 * limits.span
    if record.voltage.min() < limits.low - margin or record.voltage.max() > limits.high + margin:
        found.append(
            f"voltages from {record.voltage.min():g} V to {record.voltage.max():g} V leave the"
            f" range {limits.low:g} V to {limits.high:g} V"
        )
    if slope > limits.steepest(capacitance) * (1.0 + 1e-6):
        found.append(
            f"a rate of {slope:g} V/s is above the largest, {limits.steepest(capacitance):g} V/s"
        )
    return tuple(found)
