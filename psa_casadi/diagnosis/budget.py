"""The error budget: which share of the base model's held-out error each cause removes, what stays.

All powers are mean squares over the held-out samples, above that of the noise:

    share of a cause = (P_without - P_all) / (P_base - noise^2)

P_without is that of the model fitted again without the cause. The interval is the jackknife's over
the held-out records where there are four or more, else over eight blocks of each record's held-out
samples (Efron and Tibshirani 1993, chapter 11).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from psa_casadi.diagnosis.held_out.errors import held_out_parts, jackknife
from psa_casadi.records.split import Experiment

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Share:
    """What one cause, or an unnamed correction, removes of the error: 0 to 1, and 95 % interval."""

    what: str
    share: float
    interval: tuple[float, float]


@dataclass(frozen=True)
class Budget:
    """The held-out error of the base model above the noise, and where it goes.

    `excess_rms_m` is that error, `noise_rms_m` the noise; `together` what all causes remove,
    `causes` what each does beside the others, `unnamed` what the best correction would remove of
    the base's error (nothing named) or beyond the causes; `remains_rms_m` and
    `remains_percent` of the range are what the named causes leave above the noise.
    """

    excess_rms_m: float
    noise_rms_m: float
    together: Share
    causes: tuple[Share, ...]
    unnamed: Share | None
    remains_rms_m: float
    remains_percent: float


@dataclass(frozen=True, eq=False)
class Removed:
    """Powers of held-out parts before and after, from which a share is taken."""

    experiments: Sequence[Experiment]
    base: Sequence[FloatArray]
    noise: float

    def share(self, what: str, before: Sequence[FloatArray], after: Sequence[FloatArray]) -> Share:
        """Return the share of the base's excess that `after` removes of what `before` leaves."""
        of, count = self._of(before, after)
        centre, half = jackknife(of, np.ones(count, dtype=bool))
        return Share(what, centre, (centre - half, centre + half))

    def from_base(self, after: Sequence[FloatArray]) -> float:
        """Return the share that `after` removes of the base's excess, without its interval."""
        of, count = self._of(self.base, after)
        return of(np.ones(count, dtype=bool))

    def _of(
        self, before: Sequence[FloatArray], after: Sequence[FloatArray]
    ) -> tuple[Callable[[npt.NDArray[np.bool_]], float], int]:
        """Return the share over chosen parts, and their number, 0 where there is no excess."""
        sums, counts = held_out_parts(self.experiments, self.base, before, after)
        floor = self.noise**2
        if not len(counts) or not np.sum(sums[:, 0]) / np.sum(counts) > floor:
            return lambda _: 0.0, 0

        def of(kept: npt.NDArray[np.bool_]) -> float:
            base, left, rest = np.sum(sums[kept], axis=0) / np.sum(counts[kept])
            return float((left - rest) / max(base - floor, 1e-300))

        return of, len(counts)


def budget(
    experiments: Sequence[Experiment],
    base: Sequence[FloatArray],
    extended: Sequence[FloatArray],
    without: Sequence[tuple[str, Sequence[FloatArray]]],
    correction: tuple[str, Sequence[FloatArray]] | None,
    noise: float,
) -> Budget:
    """Return the budget of an extended model over a base.

    `without` holds the predictions [m] of the model fitted again without each cause, `correction`
    those with the best unnamed correction; `noise` [m] is the rms of the noise.
    """
    removed = Removed(experiments, base, noise)
    sums, counts = held_out_parts(experiments, base, extended)
    powers = np.sum(sums, axis=0) / max(int(np.sum(counts)), 1)
    excess, remains = (float(np.sqrt(max(p - noise**2, 0.0))) for p in powers.tolist())
    largest = max(e.record.range_m for e in experiments)
    return Budget(
        excess_rms_m=excess,
        noise_rms_m=noise,
        together=removed.share("together", base, extended),
        causes=tuple(removed.share(name, less, extended) for name, less in without),
        unnamed=None
        if correction is None
        else removed.share(correction[0], extended, correction[1]),
        remains_rms_m=remains,
        remains_percent=100.0 * remains / largest if largest > 0 else 0.0,
    )
