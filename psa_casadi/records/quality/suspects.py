"""Samples that a sensor, not the stack, has made: outliers, drop-outs, stuck or saturated ones.

They are recognised from the record alone and masked; nothing is put in their place. What a stack
can do (ring after a step, follow a jump of the voltage, turn sharply) is not suspect.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy
from numpy.typing import NDArray

from psa_casadi.records.noise import quantum_of, runs_of
from psa_casadi.records.quality.saturation import FlatEnd, flat_ends
from psa_casadi.records.quality.stuck import (
    AFTER,
    BEFORE,
    LIMIT,
    SPIKE,
    equal_runs,
    missed_a_move,
    repeated_in_noise,
)
from psa_casadi.records.record import Record
from psa_casadi.units import FloatArray

BoolArray = NDArray[np.bool_]
Kind = Literal["outlier", "drop-out", "stuck", "saturated"]

#: Samples that a running line is laid through; no spike of up to `SPIKE` samples moves it.
WINDOW = 13
#: A sample is an outlier beyond `LIMIT` standard deviations of its surroundings, and beyond this
#: share of the record's range, however quiet the sensor.
SMALLEST = 1e-3
#: Blocks in which the standard deviation of the surroundings is taken.
BLOCK = 32
_ROWS = 100_000


@dataclass(frozen=True, eq=False)
class Suspects:
    """Samples of a record that should not count: `mask` (n,) is True for them.

    `counts` holds the number of samples by kind; `quantum` the sensor's step, in `unit` as the
    record is ("m" or "counts"), None where it shows none. `ends` are the values at which the sensor
    was saturated.
    """

    mask: BoolArray
    counts: dict[Kind, int]
    quantum: float | None
    unit: Literal["m", "counts"] = "m"
    ends: tuple[FlatEnd, ...] = ()

    def sentences(self, name: str) -> tuple[str, ...]:
        """Return what was found in the record of that name, one sentence for each kind."""
        said = [
            f"{name}: {_samples(count)} {_WHAT[kind]}; masked, so that they count for nothing."
            for kind, count in self.counts.items()
            if count and kind != "saturated"
        ]
        said += self.saturation(name)
        if self.quantum is not None:
            scale, unit = (1e9, "nm") if self.unit == "m" else (1.0, self.unit)
            step = f"{scale * self.quantum:.3g} {unit}"
            said.append(f"{name}: the displacement is quantised in steps of {step}.")
        return tuple(said)

    def saturation(self, name: str) -> tuple[str, ...]:
        """Say at which values the sensor was saturated, one sentence for each."""
        scale, unit = (1e6, "um") if self.unit == "m" else (1.0, self.unit)
        return tuple(
            f"{name}: {_samples(int(end.where.sum()))} ({100.0 * float(end.where.mean()):.0f} %)"
            f" stay at {scale * end.value:.6g} {unit}, the {'largest' if end.upper else 'smallest'}"
            " value, while the voltage moves the stack: the sensor is saturated there; masked, so"
            " that they count for nothing."
            for end in self.ends
        )


_WHAT: dict[Kind, str] = {
    "outlier": "stand out as spikes of at most three samples that return at once",
    "drop-out": "belong to drop-outs, where the sensor jumps to one value and back",
    "stuck": "repeat the last one to the last digit, as a stuck sensor does",
}


def suspects(record: Record) -> Suspects:
    """Return the samples of a record that the sensor, not the stack, has made.

    A record without displacement has none. Work and memory grow with the number of samples.
    """
    mask = np.zeros(record.n, dtype=np.bool_)
    counts: dict[Kind, int] = {"outlier": 0, "drop-out": 0, "stuck": 0, "saturated": 0}
    valid = np.flatnonzero(record.mask)
    if record.displacement is None or valid.size < 2 * BLOCK:
        return Suspects(mask, counts, None)
    y = record.displacement[valid]
    span = float(np.ptp(y))
    if span <= 0:
        return Suspects(mask, counts, None)
    quantum = quantum_of(y)
    stuck, dropped = equal_runs(y, record.voltage[valid], quantum)
    stuck |= missed_a_move(y, record.voltage[valid], quantum) & ~dropped
    stuck |= repeated_in_noise(y, record.voltage[valid], quantum) & ~dropped
    ends = flat_ends(y, record.voltage[valid]) if quantum is None else ()
    flat = np.any([np.zeros(valid.size, dtype=np.bool_), *(e.where for e in ends)], axis=0)
    stuck, dropped = stuck & ~flat, dropped & ~flat
    rest = ~(stuck | dropped)
    outlying = np.zeros(valid.size, dtype=np.bool_)
    outlying[rest] = _outliers(record, valid[rest], y[rest], quantum)
    outlying &= ~flat
    kinds: dict[Kind, NDArray[np.bool_]]
    kinds = {"outlier": outlying, "drop-out": dropped, "stuck": stuck, "saturated": flat}
    for kind, found in kinds.items():
        counts[kind] = int(found.sum())
        mask[valid[found]] = True
    return Suspects(mask, counts, quantum, record.displacement_unit, ends)


def cleaned(record: Record) -> Record:
    """Return the record with suspect samples masked (nan); name and `sha256` are kept."""
    return masked(record, suspects(record))


def masked(record: Record, found: Suspects) -> Record:
    """Return the record with the samples that were found suspect masked (nan)."""
    if record.displacement is None or not found.mask.any():
        return record
    return replace(record, displacement=np.where(found.mask, np.nan, record.displacement))


def _outliers(
    record: Record, valid: NDArray[np.int64], y: FloatArray, quantum: float | None
) -> BoolArray:
    """Return which of the valid samples are spikes: Hampel's rule with the scale around them."""
    away = _away_from_surroundings(y)
    scale = np.maximum(_scale(away), 0.5 * (quantum or 0.0))
    allowed = np.maximum(LIMIT * scale, SMALLEST * float(np.ptp(y)))
    allowed = np.maximum(allowed, _explained(record)[valid])
    found = np.abs(away) > allowed
    for start, stop in zip(*(ends.tolist() for ends in runs_of(found)), strict=True):
        sign = np.sign(away[start])
        around = -sign * np.r_[away[max(0, start - SPIKE) : start], away[stop : stop + SPIKE]]
        swings = around.size > 0 and float(np.max(around)) > 0.4 * abs(away[start])
        if stop - start > SPIKE or swings:
            found[start:stop] = False
    return found


def _away_from_surroundings(y: FloatArray) -> FloatArray:
    """Return each sample's distance from the straight line through the samples around it, (n,).

    The slope is the median of the slopes between samples `WINDOW // 2` apart, the height the median
    of the window less that slope: neither is moved by a spike of up to `SPIKE` samples.
    """
    half = WINDOW // 2
    steps = np.arange(-half, half + 1)
    padded = np.pad(y, half, mode="reflect", reflect_type="odd")
    away = np.empty(y.size)
    for start in range(0, y.size, _ROWS):
        part = padded[start : start + _ROWS + 2 * half]
        window = np.lib.stride_tricks.sliding_window_view(part, WINDOW)
        slope = np.median(window[:, half:] - window[:, : half + 1], axis=1) / half
        level = np.median(window - slope[:, None] * steps, axis=1)
        away[start : start + _ROWS] = window[:, half] - level
    return away


def _scale(away: FloatArray) -> FloatArray:
    """Return the robust standard deviation around every sample: the largest of three blocks'."""
    count = max(1, away.size // BLOCK)
    blocks = np.array_split(np.abs(away), count)
    each = np.array([1.4826 * np.median(b) for b in blocks])
    each = np.maximum(scipy.ndimage.maximum_filter1d(each, 3, mode="nearest"), np.median(each))
    return np.repeat(each, [b.size for b in blocks])


def _explained(record: Record) -> FloatArray:
    """Return how far the displacement may leave its surroundings after a sudden change, (n,).

    Four times what the usual slope makes of a bend of the voltage that stands out from the bends
    around it; without limit after a sudden change of the load force.
    """
    y, reach = record.displacement, float(np.ptp(record.voltage))
    slope = float(np.nanmax(y) - np.nanmin(y)) / reach if y is not None and reach > 0 else 0.0
    limits = 4.0 * slope * _sudden(record.voltage)
    if record.load_force is not None:
        limits[_sudden(record.load_force) > 0] = np.inf
    limits[0] = max(limits[0], slope * reach)  # a record may begin while the stack still moves
    fading = [share * _highest(limits, after) for share, after in AFTER]
    return np.asarray(np.max(fading, axis=0), dtype=float)


def _highest(limits: FloatArray, after: int) -> FloatArray:
    """Return the largest limit from `after` samples before each one to BEFORE after it, (n,)."""
    width, origin = BEFORE + after + 1, (after - BEFORE) // 2
    return scipy.ndimage.maximum_filter1d(limits, width, mode="nearest", origin=origin)


def _sudden(signal: FloatArray) -> FloatArray:
    """Return the size of a signal's bends where they stand out from those around them, else 0."""
    bend = np.zeros(signal.size)
    bend[1:-1] = np.abs(np.diff(signal, 2))
    around = _scale(bend) / 1.4826
    return np.where(bend > np.maximum(6.0 * around, 1e-6 * np.ptp(signal)), bend, 0.0)


def _samples(count: int) -> str:
    return "1 sample" if count == 1 else f"{count} samples"
