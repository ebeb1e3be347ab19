"""x', u' and h of a loop: local polynomials over a window that the noise asks for."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import scipy

from psa_casadi.identification.paper.linear import Loop
from psa_casadi.records.quality.noise import high_frequency_noise
from psa_casadi.units import FloatArray

BoolArray = npt.NDArray[np.bool_]

#: Order of the local polynomial, and its shortest window in samples.
_ORDER, _SHORTEST = 3, 5
#: The window grows until the noise of x' is below this share of the mean speed of the loop,
#: and to this share of a period at most.
_QUIET, _LONGEST = 2e-3, 0.1
#: The noise of x' over what is allowed, beyond which a sentence says so.
_TOO_MUCH = 2.0


@dataclass(frozen=True, eq=False)
class Rates:
    """A loop, smoothed: u [V], u' [V/s], h = x - k u [m], x' [m/s], all (n,).

    `inner` marks samples whose window holds no turn and no end; `branches` are its runs, slices of
    samples on which the voltage goes one way.
    """

    name: str
    k: float
    u: FloatArray
    u_rate: FloatArray
    h: FloatArray
    x_rate: FloatArray
    inner: BoolArray
    branches: tuple[slice, ...]
    sentences: tuple[str, ...]

    def sign(self, branch: slice) -> float:
        """Return 1 on a branch on which the voltage rises, else -1."""
        return float(np.sign(np.mean(self.u_rate[branch])))


def rates_of(loop: Loop, k: float) -> Rates:
    """Differentiate a loop by Savitzky and Golay's filter of third order.

    The window is the shortest odd one with s |c| <= 0.002 * 2 f range(x), where s is the white
    noise of the displacement, c the filter's coefficients, f the loop's frequency; it is a tenth
    of a period at most, and a sentence says where that is not enough. Voltage and displacement
    pass through the same filter, so that what it bends it bends alike.
    """
    window, excess = window_of(loop)
    u, u_rate = (_filter(loop.voltage, window, d, loop.sample_time) for d in (0, 1))
    x, x_rate = (_filter(loop.displacement, window, d, loop.sample_time) for d in (0, 1))
    inner, branches = _branches(loop.turns, len(u), window // 2 + 1)
    sentences = []
    if excess > _TOO_MUCH:
        sentences.append(
            f"The noise of loop '{loop.name}' does not allow a good velocity: over the longest"
            f" window it is {100.0 * _QUIET * excess:.1f} % of the mean speed. A, delta, n, beta"
            " and gamma rest on it; give slower or less noisy loops."
        )
    return Rates(
        loop.name, k, u, u_rate, x - k * u, x_rate, inner, tuple(branches), tuple(sentences)
    )


def window_of(loop: Loop) -> tuple[int, float]:
    """Return the window in samples (odd), and the noise of x' over what is allowed."""
    period = 1.0 / (loop.frequency * loop.sample_time)
    longest = max(_SHORTEST, int(_LONGEST * period) // 2 * 2 - 1)
    allowed = _QUIET * 2.0 * loop.frequency * float(np.ptp(loop.displacement))
    noise = high_frequency_noise(loop.displacement)
    window = _SHORTEST
    while True:
        excess = noise * _gain(window, loop.sample_time) / allowed
        if excess <= 1.0 or window >= longest:
            return window, excess
        window = min(longest, max(window + 2, int(1.2 * window) // 2 * 2 + 1))


def _gain(window: int, sample_time: float) -> float:
    weights = scipy.signal.savgol_coeffs(window, _ORDER, deriv=1, delta=sample_time)
    return float(np.linalg.norm(weights))


def _filter(values: FloatArray, window: int, derivative: int, sample_time: float) -> FloatArray:
    smooth: FloatArray = scipy.signal.savgol_filter(
        values, window, _ORDER, deriv=derivative, delta=sample_time
    ).astype(np.float64)
    return smooth


def _branches(
    turns: Sequence[int] | npt.NDArray[np.int64], n: int, margin: int
) -> tuple[BoolArray, list[slice]]:
    inner = np.zeros(n, dtype=bool)
    edges = [0, *(int(j) for j in turns), n - 1]
    branches = []
    for first, last in pairwise(edges):
        if last - first > 2 * margin + 2:
            branches.append(slice(first + margin, last - margin + 1))
            inner[branches[-1]] = True
    return inner, branches
