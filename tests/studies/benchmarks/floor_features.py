"""Features of a displacement that are linear in their weights: what a floor is fitted with.

Written from the voltage alone, sharing nothing with the package's models: plays with their squares
and cubes, relaxations over decades, discrete modes, a fine curve over the displacement.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.signal import lfilter

FloatArray = npt.NDArray[np.float64]

#: Thresholds of the plays over half the voltage's range; relaxations in a decade of their time;
#: voltages of the last samples that act directly.
PLAYS, IN_A_DECADE, TAPS = 14, 2, 4
#: Powers of the plays, each with a prior of its own.
_POWERS = (1, 2, 3)


@dataclass(frozen=True, eq=False)
class Columns:
    """Columns (samples, count) of one kind; weights of a kind have one prior size between them."""

    kind: str
    values: FloatArray


@dataclass(frozen=True)
class Mode:
    """A mode of a sampled system: frequency over the sampling rate, and damping ratio.

    One without damping is a line, as the mains leave it: no voltage drives it.
    """

    frequency: float
    damping: float

    @property
    def pole(self) -> complex:
        """Its pole in the z plane."""
        w = 2.0 * np.pi * self.frequency
        return complex(np.exp((-self.damping + 1j * np.sqrt(1.0 - self.damping**2)) * w))


def play(v: FloatArray, threshold: float, before: Sequence[float]) -> FloatArray:
    """Return the play of a voltage that went through the values `before` it began."""
    state = 0.0
    for x in before:
        state = min(max(state, x - threshold), x + threshold)
    shown = np.empty_like(v)
    for k, x in enumerate(v.tolist()):
        state = min(max(state, x - threshold), x + threshold)
        shown[k] = state
    return shown


def memory(v: FloatArray, before: Sequence[float]) -> list[Columns]:
    """Return the voltage [of half its range] and its plays, with their squares and cubes."""
    thresholds = np.arange(1, PLAYS + 1) / (PLAYS + 1.0)
    plays = np.column_stack([play(v, float(r), before) for r in thresholds])
    curve = Columns("voltage", np.column_stack([v, v**2, v**3]))
    return [curve, *(Columns(f"plays^{p}", plays**p) for p in _POWERS)]


def relaxations(v: FloatArray, driving: FloatArray, longest: float) -> list[Columns]:
    """Return what lags behind the voltage and behind a play, and what is left of its start.

    Times go from one sample to `longest` samples.
    """
    count = max(2, int(np.ceil(IN_A_DECADE * np.log10(longest))))
    times = np.geomspace(1.0, longest, count)
    k = np.arange(len(v))
    lags = [np.column_stack([s - _lagging(s, t) for t in times]) for s in (v, driving)]
    start = np.column_stack([np.exp(-k / t) for t in times])
    return [
        Columns("relaxations", lags[0]),
        Columns("relaxations of a play", lags[1]),
        Columns("start", start),
    ]


def taps(v: FloatArray) -> Columns:
    """Return the last voltages: what acts at once, and a delay of some samples."""
    shown = [np.r_[np.full(k, v[0]), v[: len(v) - k]] for k in range(1, TAPS + 1)]
    return Columns("taps", np.column_stack(shown))


def modal(v: FloatArray, mode: Mode) -> Columns:
    """Return the answer of a damped mode to the voltage, in both phases."""
    s = lfilter([1.0], [1.0, -mode.pole], v.astype(complex))
    return Columns("modes", np.column_stack([s.real, s.imag]))


def ringing(n: int, mode: Mode) -> Columns:
    """Return the motion that a mode has by itself, in both phases."""
    s = mode.pole ** np.arange(n)
    kind = "start of modes" if mode.damping else "start of lines"
    return Columns(kind, np.column_stack([s.real, s.imag]))


def fine_curve(displacement: FloatArray, low: float, high: float, knots: int) -> Columns:
    """Return hats over the displacement: what is fixed to a place, up and down alike."""
    at = np.clip((displacement - low) / (high - low), 0.0, 1.0) * (knots - 1)
    hats = np.maximum(0.0, 1.0 - np.abs(at[:, None] - np.arange(knots)))
    return Columns("fine curve", hats)


def apart(values: Sequence[FloatArray]) -> FloatArray:
    """Return blocks one under the other, each in columns of its own."""
    whole = np.zeros((sum(len(v) for v in values), sum(v.shape[1] for v in values)))
    row = column = 0
    for v in values:
        whole[row : row + len(v), column : column + v.shape[1]] = v
        row, column = row + len(v), column + v.shape[1]
    return whole


def _lagging(v: FloatArray, time: float) -> FloatArray:
    """Return a voltage behind a first-order lag of so many samples, settled at its start."""
    a = float(np.exp(-1.0 / time))
    lag, _ = lfilter([1.0 - a], [1.0, -a], v, zi=[a * v[0]])
    shown: FloatArray = lag
    return shown
