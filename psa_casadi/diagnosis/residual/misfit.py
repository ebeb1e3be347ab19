"""What a simulation gets wrong: one record's residual from every side, in pictures and words."""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from psa_casadi.diagnosis.noise.floor import NoiseFloor, figure, quantity
from psa_casadi.diagnosis.residual.coordinates import (
    Drive,
    axes,
    drive_of,
    hold_axis,
    time_axis,
)
from psa_casadi.diagnosis.residual.harmonics import HarmonicSplit, harmonic_split
from psa_casadi.diagnosis.residual.spectrum import Spectrum, spectrum_of
from psa_casadi.diagnosis.residual.views import Ground, View, explains, ground_of, signed, view
from psa_casadi.errors import InputError
from psa_casadi.records.drive import drive_frequency
from psa_casadi.records.record import Record

FloatArray = npt.NDArray[np.float64]

#: A view that explains less than this of the excess is not put into words.
WORTH_SAYING = 0.05
#: A drift is removed before other views are taken if the drive turns so often in a bin of time.
TURNS = 2
#: Fewer samples than this show nothing.
FEWEST = 64


@dataclass(frozen=True)
class Slope:
    """Residual per decade of time since a hold began [m], signed by the change, and its error."""

    value: float
    error: float


@dataclass(frozen=True, eq=False)
class Misfit:
    """One record's residual: its size, the views of it, and what is seen in sentences.

    `rms` [m, or counts] is without the mean `mean`; `floor` is the noise, `excess` the share of the
    power above it. The view named "holds" is None in a record without holds, as is `slope`;
    `split` is None unless the voltage is periodic. `sentences` begin with the size; the rest is
    what explains more than 5 % of the excess, in falling order, and the split; noise has none.
    """

    record: str
    rms: float
    mean: float
    floor: NoiseFloor
    excess: float
    views: tuple[View, ...]
    holds: View | None
    slope: Slope | None
    spectrum: Spectrum
    split: HarmonicSplit | None
    sentences: tuple[str, ...]


def misfit(record: Record, residual: FloatArray, floor: NoiseFloor) -> Misfit:
    """Return what the residual (n,) [m] of a record shows, measured minus predicted.

    `residual` is nan where nothing counts. Time and memory grow with the number of samples.

    Raises:
        InputError: the residual has another length than the record, or fewer than 64 samples.
    """
    if residual.shape != record.time.shape or np.count_nonzero(np.isfinite(residual)) < FEWEST:
        raise InputError(
            f"record '{record.name}': its residual has {np.count_nonzero(np.isfinite(residual))}"
            f" valid samples of {residual.size} for {record.n} instants; give one value for each"
            f" instant, {FEWEST} of them valid at least."
        )
    ground = ground_of(residual, floor.level, record.displacement_unit)
    drive = drive_of(record)
    over_time = view(ground, time_axis(record))
    steady = _steady(ground, record, over_time, drive)
    rows = axes(record, _predicted(record, residual), drive)
    # what varies as slowly as time itself would vanish with the drift
    slow = ("amplitude", "frequency")
    views = [over_time, *(view(ground if a.name in slow else steady, a) for a in rows)]
    held, slope = _holds(record, ground)
    split = harmonic_split(record, residual)
    line = split.fundamental if split is not None else drive_frequency(record)
    spectrum = spectrum_of(record, residual, floor, ground.excess, line)
    power = float(np.mean(ground.residual**2))
    excess = max(0.0, 1.0 - floor.level**2 / power) if power > 0 else 0.0
    mean = float(np.nanmean(residual))
    said = _said([*views, *([held] if held else [])], spectrum, split, ground.excess)
    rms = float(np.sqrt(power))
    size = _size(record, rms, mean, floor, excess)
    return Misfit(
        record.name, rms, mean, floor, excess, tuple(views), held, slope, spectrum, split,
        (size, *said),
    )  # fmt: skip


def _said(
    views: list[View], spectrum: Spectrum, split: HarmonicSplit | None, excess: float
) -> list[str]:
    """Return what is worth saying: views and lines in falling order of share, then the split."""
    said = [(v.share, v.sentence) for v in views if v.significant]
    said.append((spectrum.share, spectrum.sentence))
    worth = sorted((row for row in said if row[0] > WORTH_SAYING), key=lambda row: -row[0])
    sentences = [sentence for _, sentence in worth]
    if split is not None and split.linear + split.even + split.odd > WORTH_SAYING * excess:
        sentences.append(split.sentence)
    return sentences


def _steady(ground: Ground, record: Record, over_time: View, drive: Drive) -> Ground:
    """Return the residual without its slow part, if the drive turns often in every bin of time.

    A drift would hide smaller views. Under a slow drive the two cannot be told apart, and the
    residual stays as it is.
    """
    if not over_time.significant or drive.turns.size < TURNS * over_time.x.size:
        return ground
    time = record.time[ground.index] - record.time[0]
    return replace(ground, residual=ground.residual - np.interp(time, over_time.x, over_time.mean))


def _predicted(record: Record, residual: FloatArray) -> FloatArray:
    """Return the prediction that the residual was taken from, up to a constant."""
    if record.displacement is None:
        return np.full(record.n, np.nan)
    predicted: FloatArray = record.displacement - residual
    return predicted


def _holds(record: Record, ground: Ground) -> tuple[View | None, Slope | None]:
    """Return the residual against lg of the time since a hold began, and its slope."""
    axis, count = hold_axis(record)
    if not count:
        return None, None
    found = view(ground, axis)
    good = found.spread > 0
    if np.count_nonzero(good) < 3:
        return found, None
    x, weight = np.log10(found.x[good]), found.spread[good] ** -2.0
    x = x - np.average(x, weights=weight)
    spread = float(np.sum(weight * x**2))
    value = float(np.sum(weight * x * found.mean[good])) / spread
    slope = Slope(value, 1.0 / float(np.sqrt(spread)))
    if not found.significant:
        return found, slope
    after = "a hold" if count == 1 else f"{count} holds"
    per_decade = (
        f"by {signed(value, ground.unit)} per decade of time, counted in the direction of the"
        f" voltage's last change"
        if abs(value) > 3.0 * slope.error
        else "without a trend in the logarithm of time"
    )
    said = f"In {after} the residual moves {per_decade}; {explains(found.share)}."
    return replace(found, sentence=said), slope


def _size(record: Record, rms: float, mean: float, floor: NoiseFloor, excess: float) -> str:
    """Say how large the residual is, against its noise."""
    unit = record.displacement_unit
    ratio = rms / floor.level if floor.level > 0 else float("inf")
    times = "as large as" if 0.95 < ratio < 1.05 else f"{figure(ratio)} times"
    said = (
        f"The residual of {record.name} is {quantity(rms, unit)} rms, {times} the noise of"
        f" {quantity(floor.level, unit)} (from {floor.source})"
    )
    if not np.isfinite(ratio):
        said = f"The residual of {record.name} is {quantity(rms, unit)} rms, without any noise"
    said += f": {100.0 * excess:.0f} % of its power is above the noise." if excess > 0 else "."
    if abs(mean) > rms:
        said += f" Its mean, {signed(mean, unit)}, is left out."
    return said
