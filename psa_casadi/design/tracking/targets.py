"""Paths that a stack's displacement is to follow: read from a file, or made from a few figures."""

import os
from dataclasses import dataclass

import numpy as np

from psa_casadi.errors import InputError, Problems
from psa_casadi.records.read import apart
from psa_casadi.records.read.convert import Request
from psa_casadi.units import FloatArray, parse_unit, to_si

#: Fewest samples of a path.
_FEWEST = 10


@dataclass(frozen=True, eq=False)
class Target:
    """A path: `displacement` (n,) [m] at strictly increasing times `time` (n,) [s]."""

    time: FloatArray
    displacement: FloatArray

    @property
    def span(self) -> float:
        """Largest minus smallest displacement [m]; the range that errors are a share of."""
        return float(np.ptp(self.displacement))

    @property
    def step(self) -> float:
        """Median distance between samples [s]."""
        return float(np.median(np.diff(self.time)))


def read_target(path: str | os.PathLike[str]) -> Target:
    """Read a path from a CSV file with the columns `time [s]` and `displacement [um]`.

    Raises InputError with every mistake found: a column missing, a cell that is no number, times
    that do not increase, fewer than ten samples, a displacement that never changes.
    """
    outcome, _ = apart.read(str(path), Request(voltage=False))
    outcome.problems.raise_if_any()
    if outcome.samples is None:
        raise InputError(
            f"{path}: holds no path; name its columns as 'time [s],displacement [um]'."
        )
    units, values = outcome.samples.units, outcome.samples.values
    if parse_unit(units["displacement"]).counts:
        raise InputError(
            f"{path}: line 1: the displacement is in counts of a sensor, which is no length;"
            " give the path in um."
        )
    time, displacement = (
        to_si(values[:, list(units).index(n)], units[n]) for n in ("time", "displacement")
    )
    return checked_target(time, displacement, str(path))


def checked_target(time: FloatArray, displacement: FloatArray, where: str = "target") -> Target:
    """Return a path after checking it; raises InputError with every mistake found."""
    problems = Problems()
    if time.size < _FEWEST or time.shape != displacement.shape:
        problems.add(
            f"{where}: holds {time.size} times and {displacement.size} displacements; give at least"
            f" {_FEWEST} samples, one displacement for each time."
        )
    elif not (np.isfinite(time).all() and np.isfinite(displacement).all()):
        problems.add(f"{where}: has samples that are missing or not finite; fill them in.")
    elif not (np.diff(time - time[0]) > 0.0).all():  # as it is used: a far start merges instants
        line = int(np.flatnonzero(np.diff(time - time[0]) <= 0.0)[0]) + 2
        problems.add(
            f"{where}: the time does not increase at sample {line}; sort the samples and remove"
            " repeated ones."
        )
    elif np.ptp(displacement) == 0.0:
        problems.add(f"{where}: the displacement never changes; give a path with a motion in it.")
    problems.raise_if_any()
    return Target(time - time[0], displacement)


def raster_scan(
    *, low: float, high: float, frequency: float, lines: int, samples: int, turn: float = 0.2
) -> Target:
    """Return a raster scan: a triangle between two positions [m] with rounded turns.

    `frequency` [Hz] is that of the there and back, `lines` their number. Over the share `turn` of
    each half period, half of it on either side of a turn, the acceleration is a half sine; between
    the turns the speed is constant. It starts and ends at rest at `low`. `samples` counts the
    instants.

    Raises InputError for figures that make no scan.
    """
    problems = Problems()
    if not (frequency > 0.0 and high > low):
        problems.add("A scan needs a positive frequency and a high above its low; correct them.")
    if lines < 1 or samples < 20 * lines:
        problems.add("A scan needs at least one line and 20 samples for each; give more samples.")
    if not 0.0 < turn <= 1.0:
        problems.add(f"The turn is {turn:g}; give a share of the half period, above 0 up to 1.")
    problems.raise_if_any()
    time = np.linspace(0.0, lines / frequency, samples)
    return Target(time, low + (high - low) * _rounded_triangle(time * frequency, turn))


def _rounded_triangle(phase: FloatArray, turn: float) -> FloatArray:
    """Return a triangle of period 1 from 0 to 1 and back whose turns take the share `turn`."""
    s = 1.0 - np.abs(1.0 - 2.0 * np.mod(phase, 1.0))  # way along the half period, 0 to 1
    half = 0.5 * turn
    near = np.minimum(s, 1.0 - s)  # way from the nearer turn
    # speed sin(pi near / turn) in the turn, 1 outside; distance is its integral
    inside = turn / np.pi * (1.0 - np.cos(np.pi * np.minimum(near, half) / turn))
    way = inside + np.maximum(near - half, 0.0)
    full = 2.0 * (turn / np.pi + 0.5 - half)
    return np.asarray(np.where(s <= 0.5, way, full - way) / full)
