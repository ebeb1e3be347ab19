"""Modes of a sampled system, found one by one in what other features leave of an output."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from tests.benchmarks.floor_features import Mode, modal

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

#: Frequencies over the sampling rate and dampings that a mode is looked for at.
_FREQUENCIES, _DAMPINGS = np.linspace(0.005, 0.495, 99), (0.005, 0.02, 0.08)
#: Relative size of a ridge that only keeps the projections regular; steps of a refinement.
_REGULAR, _STEPS = 1e-9, 60


@dataclass(frozen=True, eq=False)
class Beside:
    """What features (samples, count) leave of an output and of further columns."""

    features: FloatArray
    left: FloatArray
    factor: tuple[FloatArray, bool]

    def gain(self, columns: FloatArray) -> float:
        """Return by how much two columns more lessen the sum of squares that is left."""
        own = columns - self.features @ cho_solve(self.factor, self.features.T @ columns)
        gram = own.T @ own + _REGULAR * np.eye(2) * float(np.sum(columns**2))
        cross = own.T @ self.left
        return float(cross @ np.linalg.solve(gram, cross))


def beside(features: FloatArray, output: FloatArray) -> Beside:
    """Return what is left of an output beside features."""
    gram = features.T @ features
    gram += np.diag(_REGULAR * np.diag(gram) + np.finfo(float).tiny)
    factor = cho_factor(gram, lower=True)
    return Beside(features, output - features @ cho_solve(factor, features.T @ output), factor)


class Search:
    """Looks for modes of voltages, one array for each record, judged at their used samples."""

    def __init__(self, voltages: Sequence[FloatArray], used: BoolArray) -> None:
        self._voltages, self._used = voltages, used
        self._grid = [
            (mode, self._answer(mode))
            for mode in (Mode(float(f), d) for f in _FREQUENCIES for d in _DAMPINGS)
        ]

    def next(self, others: Beside) -> Mode:
        """Return the mode that explains most of what is left, refined."""
        mode = max(self._grid, key=lambda pair: others.gain(pair[1]))[0]
        return self.tuned(mode, others)

    def tuned(self, mode: Mode, others: Beside) -> Mode:
        """Return a mode with the frequency and the damping that explain most."""

        def loss(x: FloatArray) -> float:
            return -others.gain(self._answer(_mode(x)))

        begin = np.array([mode.frequency, np.log(mode.damping)])
        simplex = begin + np.array([[0.0, 0.0], [0.002, 0.0], [0.0, 0.7]])
        found = minimize(
            loss, begin, method="Nelder-Mead",
            options={"maxfev": _STEPS, "initial_simplex": simplex},
        )  # fmt: skip
        return _mode(found.x)

    def _answer(self, mode: Mode) -> FloatArray:
        return np.vstack([modal(v, mode).values for v in self._voltages])[self._used]


def _mode(x: FloatArray) -> Mode:
    return Mode(float(np.clip(x[0], 1e-4, 0.4999)), float(np.exp(np.clip(x[1], -7.0, -0.1))))
