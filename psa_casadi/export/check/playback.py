"""A run that evidence speaks of, played again through an FMU."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from psa_casadi.export.check.rows import CheckRow
from psa_casadi.export.importer.fmu import Fmu
from psa_casadi.export.importer.masters import Signals, co_simulate

FloatArray = npt.NDArray[np.float64]

#: How far a repeated run may be off, as a share of its range, by the version of FMI: in FMI 3.0
#: inputs cannot move within a step, see `_played`.
RUN_LIMITS = {2: 1e-5, 3: 5e-4}
#: How far a repeated error may be off, as a share of what is stated.
ERROR_LIMIT = 0.02
_TOLERANCE = 1e-9
#: What a held input may move in a step, over its range, in at most so many steps between samples.
_STEP, _MOST_STEPS = 1e-3, 1000


@dataclass(frozen=True)
class Playback:
    """Inputs (n, nu) at times (n,) [s], start values, and what an output must be then (n,).

    With `stated`, the rms over finite samples of what is expected must be that [m]; else the
    output itself must be equal.
    """

    name: str
    times: FloatArray
    inputs: Signals
    start: Mapping[str, float]
    output: str
    expected: FloatArray
    stated: float | None = None


def played_again(fmu: Fmu, playback: Playback) -> CheckRow:
    """Return the row of a run that is repeated."""
    found = _played(fmu, playback)
    valid = np.isfinite(playback.expected)
    error = found[valid] - playback.expected[valid]
    if playback.stated is None:
        size = float(np.ptp(playback.expected[valid])) or 1.0
        largest = float(np.max(np.abs(error))) / size
        remark = f"largest difference of {playback.output} over its range"
        limit = RUN_LIMITS[fmu.version]
        return CheckRow(playback.name, largest, limit, largest <= limit, remark)
    rms = float(np.sqrt(np.mean(error**2)))
    off = abs(rms / playback.stated - 1.0) if playback.stated > 0.0 else float("inf")
    remark = f"{1e6 * rms:.4g} um rms, stated {1e6 * playback.stated:.4g} um"
    return CheckRow(playback.name, off, ERROR_LIMIT, off <= ERROR_LIMIT, remark)


def _played(fmu: Fmu, p: Playback) -> FloatArray:
    """Return the output (n,), inputs linear between the times.

    Co-simulation of FMI 3.0 has no such inputs. There they are held at the mean over a step, which
    leaves the end of the step late by half of it; from steps and half steps follows what none is.
    """
    if fmu.version == 2:
        return _stepped(fmu, p, p.inputs)
    whole, halves = (_stepped(fmu, p, _held_means(p.inputs, parts)) for parts in (1, 2))
    return 2.0 * halves - whole


def _stepped(fmu: Fmu, p: Playback, inputs: Signals) -> FloatArray:
    """Return the output at the times of a playback, stepped from knot to knot of inputs."""
    found = co_simulate(
        fmu, inputs.times, inputs, [p.output], tolerance=_TOLERANCE, values=dict(p.start)
    )
    return np.asarray(found[np.isin(inputs.times, p.times), 0])


def _held_means(inputs: Signals, parts: int) -> Signals:
    """Return inputs that are held at the mean of both ends of a step, many where they move much.

    Every step is cut into so many parts.
    """
    size = np.maximum(np.ptp(inputs.values, axis=0), 1e-300)
    moved = np.max(np.abs(np.diff(inputs.values, axis=0)) / size, axis=1)
    counts = parts * np.clip(np.ceil(moved / _STEP), 1, _MOST_STEPS).astype(int)
    steps = [
        np.linspace(a, b, m, endpoint=False)
        for a, b, m in zip(inputs.times, inputs.times[1:], counts, strict=False)
    ]
    fine = inputs.on(np.concatenate([*steps, inputs.times[-1:]]))
    ends = np.vstack([fine.values[1:], fine.values[-1:]])
    return Signals(fine.names, fine.times, 0.5 * (fine.values + ends), held=True)
