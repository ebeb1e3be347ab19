"""Coordinates without bounds for those that have some, with the Jacobian of the change."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from psa_casadi.units import FloatArray


@dataclass(frozen=True, eq=False)
class Within:
    """theta within `low` and `high` (size,) as a function of z on the whole line, one by one.

    Between two bounds theta = low + (high - low) / (1 + exp(-z)), beyond one alone theta = low +
    exp(z) or high - exp(z), elsewhere theta = z.
    """

    low: FloatArray
    high: FloatArray

    @property
    def bounded(self) -> npt.NDArray[np.bool_]:
        """Which coordinates have a bound (size,)."""
        return np.isfinite(self.low) | np.isfinite(self.high)

    def z(self, theta: FloatArray) -> FloatArray:
        """Return z (size,) of a theta strictly within the bounds."""
        below, above = np.isfinite(self.low), np.isfinite(self.high)
        from_low, to_high = theta - self.low, self.high - theta
        with np.errstate(all="ignore"):  # of the branches that are not taken
            return np.where(
                below & above,
                np.log(from_low) - np.log(to_high),
                np.where(below, np.log(from_low), np.where(above, np.log(to_high), theta)),
            )

    def theta(self, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return theta, d theta / d z and d ln |d theta / d z| / d z, each (size,)."""
        below, above = np.isfinite(self.low), np.isfinite(self.high)
        share = 0.5 * (1.0 + np.tanh(0.5 * z))
        with np.errstate(over="ignore", invalid="ignore"):
            size, grown = self.high - self.low, np.exp(z)
            both, one = below & above, below ^ above
            theta = np.where(both, self.low + size * share, z)
            theta = np.where(one & below, self.low + grown, theta)
            theta = np.where(one & above, self.high - grown, theta)
            slope = np.where(both, size * share * (1.0 - share), 1.0)
            slope = np.where(one, np.where(below, grown, -grown), slope)
        bend = np.where(both, 1.0 - 2.0 * share, np.where(one, 1.0, 0.0))
        return theta, slope, bend
