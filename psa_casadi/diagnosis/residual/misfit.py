"""What a simulation gets wrong: one record's residual from every side."""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from psa_casadi.diagnosis.noise import NoiseFloor
from psa_casadi.diagnosis.residual.harmonics import HarmonicSplit, harmonic_split
from psa_casadi.diagnosis.residual.spectrum import Spectrum, spectrum_of
from psa_casadi.diagnosis.views import (
    Drive,
    Ground,
    View,
    axes,
    drive_of,
    ground_of,
    hold_axis,
    time_axis,
    view,
)
from psa_casadi.errors import InputError
from psa_casadi.notes import Note, note, texts
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
    """One record's residual: its size, the views of it, and what is seen.

    `rms` [m, or counts] is without the mean `mean`; `floor` is the noise, `excess` the share of the
    power above it. The view named "holds" is None in a record without holds, as is `slope`;
    `split` is None unless the voltage is periodic. `findings` begin with the size; the rest is
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
    findings: tuple[Note, ...]

    @property
    def sentences(self) -> tuple[str, ...]:
        """The findings in words."""
        return texts(self.findings)


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
    ground = ground_of(residual, floor.level)
    drive = drive_of(record)
    over_time = view(ground, time_axis(record))
    steady = _steady(ground, record, over_time, drive)
    rows = axes(record, _predicted(record, residual), drive)
    # what varies as slowly as time itself would vanish with the drift
    slow = ("amplitude", "frequency")
    views = [over_time, *(view(ground if a.name in slow else steady, a) for a in rows)]
    held, slope, count = _holds(record, ground)
    split = harmonic_split(record, residual)
    line = split.fundamental if split is not None else drive_frequency(record)
    spectrum = spectrum_of(record, residual, floor, ground.excess, line)
    power = float(np.mean(ground.residual**2))
    excess = max(0.0, 1.0 - floor.level**2 / power) if power > 0 else 0.0
    rms, mean, unit = float(np.sqrt(power)), float(np.nanmean(residual)), record.displacement_unit
    said = [(v.share, _followed(v, unit)) for v in views if v.significant]
    if held is not None and held.significant:
        said.append((held.share, _held(held, slope, count, unit)))
    said.append((spectrum.share, _lines(spectrum)))
    worth = sorted((row for row in said if row[0] > WORTH_SAYING), key=lambda row: -row[0])
    findings = [_size(record, rms, mean, floor, excess), *(finding for _, finding in worth)]
    if split is not None and split.repeats > WORTH_SAYING * ground.excess:
        findings.append(_split(split, unit))
    return Misfit(
        record.name, rms, mean, floor, excess, tuple(views), held, slope, spectrum, split,
        tuple(findings),
    )  # fmt: skip


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


def _holds(record: Record, ground: Ground) -> tuple[View | None, Slope | None, int]:
    """Return the residual against lg of the time since a hold began, its slope, and the holds."""
    axis, count = hold_axis(record)
    if not count:
        return None, None, 0
    found = view(ground, axis)
    good = found.spread > 0
    if np.count_nonzero(good) < 3:
        return found, None, count
    x, weight = np.log10(found.x[good]), found.spread[good] ** -2.0
    x = x - np.average(x, weights=weight)
    spread = float(np.sum(weight * x**2))
    value = float(np.sum(weight * x * found.mean[good])) / spread
    return found, Slope(value, 1.0 / float(np.sqrt(spread))), count


def _size(record: Record, rms: float, mean: float, floor: NoiseFloor, excess: float) -> Note:
    """Return how large the residual is, against its noise."""
    unit = record.displacement_unit
    return note(
        "residual", record=record.name, rms=(rms, unit), noise=(floor.level, unit),
        ratio=rms / floor.level if floor.level > 0 else None, source=floor.source,
        excess=excess, mean=(mean, unit) if abs(mean) > rms else None,
    )  # fmt: skip


def _followed(v: View, unit: str) -> Note:
    """Return what the residual follows, with the extremes that stand clear of their errors."""
    ends = tuple(((float(v.mean[k]), unit), (float(v.x[k]), v.x_unit)) for k in v.extremes)
    return note("follows", axis=v.name, ends=ends, share=v.share)


def _held(v: View, slope: Slope | None, count: int, unit: str) -> Note:
    """Return how the residual moves in holds; without a slope it only differs."""
    if slope is None:
        return _followed(v, unit)
    clear = abs(slope.value) > 3.0 * slope.error
    moves = (slope.value, unit) if clear else None
    return note("holds", count=count, moves=moves, share=v.share)


def _lines(s: Spectrum) -> Note:
    lines = tuple((line.frequency, line.name, (line.amplitude, s.unit)) for line in s.others[:3])
    return note("lines", lines=lines, count=len(s.others), share=s.share)


def _split(s: HarmonicSplit, unit: str) -> Note:
    total = s.repeats + s.noise
    rows = {"linear": s.linear, "even": s.even, "odd": s.odd}
    parts = tuple(
        (name, p / total, (float(np.sqrt(p)), unit))
        for name, p in sorted(rows.items(), key=lambda row: -row[1])
        if p > 0
    )
    return note(
        "harmonics", periods=s.periods, excited=s.excited, parts=parts, rest=s.noise / total
    )
