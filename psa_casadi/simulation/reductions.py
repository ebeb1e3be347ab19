"""What may be kept of a displacement under a name, of a row or of what a GPU has kept of it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from psa_casadi.simulation.device.run import Summary

FloatArray = npt.NDArray[np.float64]

ReductionName = Literal["range", "peak", "last", "misfit"]


@dataclass(frozen=True)
class Reduction:
    """One number [m]: of a displacement and what was measured, both (n,), or of a summary (m,)."""

    of_row: Callable[[FloatArray, FloatArray], float]
    of_summary: Callable[[Summary, int], FloatArray]

    def beside(self, meant: FloatArray) -> Callable[[FloatArray], float]:
        """Return the function of a displacement (n,) alone."""
        return lambda row: self.of_row(row, meant)


REDUCTIONS: dict[ReductionName, Reduction] = {
    "range": Reduction(lambda row, _: float(np.ptp(row)), lambda s, _: s.largest - s.least),
    "peak": Reduction(
        lambda row, _: float(np.max(np.abs(row))),
        lambda s, _: np.maximum(np.abs(s.least), np.abs(s.largest)),
    ),
    "last": Reduction(lambda row, _: float(row[-1]), lambda s, _: s.last),
    "misfit": Reduction(
        lambda row, meant: float(np.sqrt(np.mean((row - meant) ** 2))),
        lambda s, n: np.sqrt(s.squares / n),
    ),
}
