"""Modes and lines, found one by one in what other features leave of an output."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.linalg import cho_factor, cho_solve
from scipy.ndimage import median_filter
from scipy.optimize import minimize

from tests.benchmarks.floor_features import Mode, apart, modal, ringing

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

#: Frequencies over the sampling rate and dampings that a mode is looked for at, and their limits:
#: slower and less damped ones imitate loops of the voltage's own frequency.
_FREQUENCIES, _DAMPINGS = np.linspace(0.02, 0.495, 96), (0.005, 0.02, 0.08)
_SLOWEST, _FASTEST, _LEAST, _MOST = 0.02, 0.4999, 4e-3, 0.7
#: A line is so many times larger than the median of so many neighbours in the spectrum; of noise
#: alone the largest of 10,000 is 3.6 times as large.
_STANDS_OUT, _NEIGHBOURS = 5.0, 101
#: Relative size of a ridge that only keeps the projections regular; steps of a refinement.
_REGULAR, _STEPS = 1e-9, 60


@dataclass(frozen=True, eq=False)
class Beside:
    """What features (samples, count) leave of an output and of further columns."""

    features: FloatArray
    left: FloatArray
    factor: tuple[FloatArray, bool]

    def gain(self, columns: FloatArray) -> float:
        """Return by how much more columns lessen the sum of squares that is left."""
        own = columns - self.features @ cho_solve(self.factor, self.features.T @ columns)
        gram = own.T @ own + _REGULAR * np.eye(columns.shape[1]) * float(np.sum(columns**2))
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
        """Return the mode or the line that explains most of what is left, refined."""
        mode = max(self._grid, key=lambda pair: others.gain(pair[1]))[0]
        found = [self.tuned(m, others) for m in (mode, *self._line(others))]
        return max(found, key=lambda m: others.gain(self._answer(m)))

    def tuned(self, mode: Mode, others: Beside) -> Mode:
        """Return a mode with the frequency, and the damping unless it is 0, that explain most."""
        line = mode.damping == 0.0
        step = 0.3 / len(self._used) if line else 0.002

        def made(x: FloatArray) -> Mode:
            frequency = float(np.clip(x[0], _SLOWEST, _FASTEST))
            if line:
                return Mode(frequency, 0.0)
            return Mode(frequency, float(np.exp(np.clip(x[1], np.log(_LEAST), np.log(_MOST)))))

        def loss(x: FloatArray) -> float:
            return -others.gain(self._answer(made(x)))

        begin = np.array([mode.frequency] if line else [mode.frequency, np.log(mode.damping)])
        moves = np.vstack([np.zeros(len(begin)), np.diag([step, 0.7][: len(begin)])])
        options: Any = {"maxfev": _STEPS, "initial_simplex": begin + moves}
        found: Any = minimize(loss, begin, method="Nelder-Mead", options=options)
        return made(found.x)

    def _line(self, others: Beside) -> list[Mode]:
        """Return the largest line that stands out of the spectrum of what is left, if one does."""
        left = np.zeros(len(self._used))
        left[self._used] = others.left
        size = np.abs(np.fft.rfft(left))
        frequency = np.arange(len(size)) / len(left)
        out = size > _STANDS_OUT * median_filter(size, _NEIGHBOURS)
        out &= (frequency > _SLOWEST) & (frequency < _FASTEST)
        return [Mode(float(frequency[np.argmax(size * out)]), 0.0)] if out.any() else []

    def _answer(self, mode: Mode) -> FloatArray:
        if mode.damping == 0.0:
            return apart([ringing(len(v), mode).values for v in self._voltages])[self._used]
        return np.vstack([modal(v, mode).values for v in self._voltages])[self._used]
