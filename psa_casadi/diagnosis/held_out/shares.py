"""Shares of what a base model leaves in held-out samples, above the noise, with their intervals.

    share = sum_j (P_before,j - P_after,j) / s_j^2  /  sum_j (P_base,j - s_j^2) / s_j^2

P_j are mean squares of the models' held-out errors in output j, s_j is the rms of its noise. A
stack has one output, its displacement, of which s_j cancels. The interval is the jackknife's over
the held-out records where there are four or more, else over eight blocks of each record's held-out
samples (Efron and Tibshirani 1993, chapter 11).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from psa_casadi.diagnosis.held_out.parts import jackknife, parts_of

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

#: The least noise that weighs an output, and the least excess, over the base's error (in power).
_LEAST_NOISE, _LEAST_EXCESS = 1e-30, 1e-9


@dataclass(frozen=True)
class Share:
    """What one cause, or an unnamed correction, removes of the error [-], and 95 % interval.

    0 to 1 as a rule; below 0 where it adds error.
    """

    what: str
    share: float
    interval: tuple[float, float]

    @property
    def shown(self) -> tuple[float, float, float]:
        """The share and the ends of its interval as they are shown, cut to 0 to 1."""
        share, low, high = (min(max(v, 0.0), 1.0) for v in (self.share, *self.interval))
        return share, low, high

    @property
    def percents(self) -> tuple[str, str, str]:
        """The same as percentages without their sign, with decimals where all are near 0 or 1.

        A share that is not 0 is never told as 0, one below 1 told as 100 only from 99.995 on.
        """
        share, low, high = self.shown
        off = min(1.0 - self.interval[0], self.interval[1])
        off = 1.0 if off < 0.0 else off  # beyond what is shown
        digits = 0 if off > 0.01 else 1 if off > 0.001 else 2
        while digits < 2 and share < 1.0 and float(f"{100 * share:.{digits}f}") >= 100.0:
            digits += 1
        least = 10.0**-digits
        told = f"{100 * share:.{digits}f}"
        if 0.0 < 100 * share < 0.5 * least:
            told = f"under {least:.{digits}f}"
        return told, f"{100 * low:.{digits}f}", f"{100 * high:.{digits}f}"

    @property
    def text(self) -> str:
        """The share with its interval, such as "62 % (58 to 66 %)"."""
        share, low, high = self.percents
        return f"{share} % ({low} to {high} %)"


@dataclass(frozen=True, eq=False)
class Removed:
    """What models remove of the held-out error of a `base` above the `noise`.

    `errors_of` turns a model's predictions of all records into its held-out errors (n, outputs) of
    each, nan where an output is not judged; `noise` (outputs,) is the rms of each output's noise.
    """

    errors_of: Callable[[Sequence[FloatArray]], Sequence[FloatArray]]
    base: Sequence[FloatArray]
    noise: Sequence[float]

    def share(self, what: str, before: Sequence[FloatArray], after: Sequence[FloatArray]) -> Share:
        """Return the share of the base's excess that `after` removes of what `before` leaves."""
        of, count = self._of(before, after)
        centre, half = jackknife(of, np.ones(count, dtype=bool))
        return Share(what, centre, (centre - half, centre + half))

    def from_base(self, after: Sequence[FloatArray]) -> float:
        """Return the share that `after` removes of the base's excess, without its interval."""
        of, count = self._of(self.base, after)
        return of(np.ones(count, dtype=bool))

    @cached_property
    def _base_errors(self) -> Sequence[FloatArray]:
        return self.errors_of(self.base)

    def _of(
        self, before: Sequence[FloatArray], after: Sequence[FloatArray]
    ) -> tuple[Callable[[BoolArray], float], int]:
        """Return the share over chosen parts, and their number, 0 where there is no excess."""
        old = self._base_errors if before is self.base else self.errors_of(before)
        sums, counts = parts_of(self._base_errors, old, self.errors_of(after))
        floor = np.asarray(self.noise, dtype=np.float64) ** 2
        whole = _powers(sums, counts)[0]
        weights = 1.0 / np.maximum(floor, max(_LEAST_NOISE * float(np.max(whole)), 1e-300))
        if not np.sum(weights * (whole - floor * (whole > 0))) > 0:
            return lambda _: 0.0, 0

        def of(kept: BoolArray) -> float:
            base, left, rest = _powers(sums[kept], counts[kept])
            error = float(weights @ base)
            excess = error - float(weights @ (floor * (counts[kept].sum(axis=0) > 0)))
            return float(weights @ (left - rest)) / max(excess, _LEAST_EXCESS * error, 1e-300)

        return of, len(counts)


def _powers(sums: FloatArray, counts: npt.NDArray[np.int64]) -> FloatArray:
    """Return the mean squares (models, outputs) over parts, 0 for an output without a sample."""
    found: FloatArray = np.sum(sums, axis=0) / np.maximum(np.sum(counts, axis=0), 1)
    return found
