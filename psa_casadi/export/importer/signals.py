"""Inputs over time, as importers pass them on."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from psa_casadi.units import FloatArray


@dataclass(frozen=True)
class Signals:
    """Inputs that are linear between knots: `times` (k,), `values` (k, nu), columns as `names`.

    With `held` they keep the value of a knot up to the next one, where they jump.
    """

    names: tuple[str, ...]
    times: FloatArray
    values: FloatArray
    held: bool = False

    def at(self, times: FloatArray | float, *, before: bool = False) -> FloatArray:
        """Return the inputs at times (n,), shape (n, nu); at a jump those after it, or `before`."""
        wanted = np.atleast_1d(np.asarray(times, dtype=float))
        if self.held:
            side: Literal["left", "right"] = "left" if before else "right"
            rows = np.searchsorted(self.times, wanted, side) - 1
            return self.values[np.maximum(rows, 0)]
        columns = [np.interp(wanted, self.times, column) for column in self.values.T]
        return np.array(columns).reshape(len(self.names), len(wanted)).T

    def on(self, times: FloatArray) -> "Signals":
        """Return the signals sampled at times: what an importer that samples them passes on."""
        return Signals(self.names, times, self.at(times), self.held)
