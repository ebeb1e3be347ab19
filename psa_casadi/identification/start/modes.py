"""Modes that a residual shows: frequencies, dampings and residues, one by one, then all again.

What drives them is known, so that the response of a candidate is an exact filter. The residues are
linear and drop out; only the poles are sought (variable projection: Golub and Pereyra, Inverse
Problems 19 (2003) R1).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from psa_casadi.identification.start.linear_response import one_pole, orthonormal

FloatArray = npt.NDArray[np.float64]

#: Frequencies and damping ratios among which the next mode is looked for: the highest frequency
#: over the sampling rate, and the lowest as periods in the longest record.
_FREQUENCIES, _DAMPINGS = 160, (0.004, 0.015, 0.06)
_HIGHEST, _PERIODS = 0.45, 8.0
#: What rings has a damping ratio below this one.
MOST_DAMPED, _LEAST_DAMPED = 0.2, 1e-3
#: Evaluations over all poles after each new mode.
_EVALUATIONS = 6


@dataclass(frozen=True)
class Mode:
    """A mode: frequency [Hz], damping ratio, share of the drive in phase with it and ahead."""

    frequency: float
    damping: float
    share: float
    ahead: float


@dataclass(frozen=True, eq=False)
class Shaken:
    """A record's drive and residual (n,) [m], the samples that count, the sample time [s]."""

    drive: FloatArray
    residual: FloatArray
    used: npt.NDArray[np.bool_]
    sample_time: float


def modes_of(
    records: Sequence[Shaken], free: FloatArray, *, most: int, better: float
) -> list[Mode]:
    """Return modes while each brings the rms of the residual to a share `better` at most.

    `free` (samples that count, k) are directions of the residual that are free to follow.
    """
    search = _Search(records, free)
    poles: FloatArray = np.zeros((0, 2))
    left = search.target
    while len(poles) < most:
        trial = search.refined(np.vstack([poles, search.next(left)]))
        rest = search.left(trial)
        if np.linalg.norm(rest) > better * np.linalg.norm(left):
            break
        poles, left = trial, rest
    return search.modes(poles)


class _Search:
    """The residual without what is free, and the responses of modes; poles are ln (f, zeta)."""

    def __init__(self, records: Sequence[Shaken], free: FloatArray) -> None:
        self.records = records
        self.basis, _ = orthonormal(free)
        self.target = self._without(np.concatenate([r.residual[r.used] for r in records]))
        lowest = _PERIODS / max(r.sample_time * r.drive.size for r in records)
        highest = _HIGHEST / min(r.sample_time for r in records)
        grid = np.log(np.geomspace(min(lowest, 0.1 * highest), highest, _FREQUENCIES))
        self.grid = [np.array([f, np.log(z)]) for f in grid for z in _DAMPINGS]
        self.low = np.array([grid[0] - 1.0, np.log(_LEAST_DAMPED)])
        self.high = np.array([grid[-1] + 0.1, np.log(MOST_DAMPED)])

    def next(self, left: FloatArray) -> FloatArray:
        """Return the pole of the grid whose mode takes most from what is left."""
        return max(self.grid, key=lambda pole: self._taken(pole, left))

    def left(self, poles: FloatArray) -> FloatArray:
        """Return what the modes leave of the residual, with the best residues."""
        q, _ = orthonormal(self._columns(poles))
        rest: FloatArray = self.target - q @ (q.T @ self.target)
        return rest

    def refined(self, poles: FloatArray) -> FloatArray:
        """Return all poles moved to where their modes leave less."""
        count, size = len(poles), float(np.linalg.norm(self.target))
        low, high = np.tile(self.low, count), np.tile(self.high, count)

        def rest(p: FloatArray) -> FloatArray:
            return self.left(p.reshape(-1, 2)) / size

        found = scipy.optimize.least_squares(
            rest,
            np.clip(poles.ravel(), low + 1e-6, high - 1e-6),
            bounds=(low, high),
            x_scale=np.tile([0.01, 0.3], count),
            max_nfev=_EVALUATIONS,
        )
        moved: FloatArray = found.x.reshape(-1, 2)
        return moved

    def modes(self, poles: FloatArray) -> list[Mode]:
        """Return the modes with their residues."""
        if not len(poles):
            return []
        gains = np.linalg.lstsq(self._columns(poles), self.target, rcond=None)[0].reshape(-1, 2)
        return [Mode(*np.exp(p), *g) for p, g in zip(poles, gains, strict=True)]

    def _taken(self, pole: FloatArray, left: FloatArray) -> float:
        q, _ = orthonormal(self._columns(pole[None]))
        return float(np.sum((q.T @ left) ** 2))

    def _columns(self, poles: FloatArray) -> FloatArray:
        return self._without(np.hstack([self._response(*np.exp(p)) for p in poles]))

    def _without(self, x: FloatArray) -> FloatArray:
        projected: FloatArray = x - self.basis @ (self.basis.T @ x)
        return projected

    def _response(self, frequency: float, damping: float) -> FloatArray:
        """Return q and q'/w of a mode, q'' + 2 zeta w q' + w^2 q = w^2 drive, from rest (n, 2)."""
        omega = 2.0 * np.pi * frequency
        turn = np.sqrt(1.0 - damping**2)
        pole = omega * complex(-damping, turn)
        rows = []
        for r in self.records:
            y = one_pole(pole, r.drive - r.drive[0], r.sample_time) * omega / turn
            rows.append(np.column_stack([y.imag, (pole * y).imag / omega])[r.used])
        return np.vstack(rows)
