"""The error budget: which share of the base model's held-out error each cause removes, what stays.

All powers are mean squares over the held-out samples, above that of the noise:

    share of a cause = (P_without - P_all) / (P_base - noise^2)

P_without is that of the model fitted again without the cause. Its interval:
`psa_casadi.diagnosis.held_out.shares`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from psa_casadi.diagnosis.held_out.errors import errors_of, held_out_columns, held_out_parts
from psa_casadi.diagnosis.held_out.shares import Removed, Share
from psa_casadi.records.split import Experiment

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Budget:
    """The held-out error of the base model above the noise, and where it goes.

    `excess_rms_m` is that error, `noise_rms_m` the noise; `together` what all causes remove,
    `causes` what each does beside the others, `unnamed` what the best correction would remove of
    the base's error (nothing named) or beyond the causes; `remains_rms_m` and
    `remains_percent` of the range, each record's over its own as of all errors, are what the named
    causes leave above the noise.
    """

    excess_rms_m: float
    noise_rms_m: float
    together: Share
    causes: tuple[Share, ...]
    unnamed: Share | None
    remains_rms_m: float
    remains_percent: float


def removed_from(
    experiments: Sequence[Experiment], base: Sequence[FloatArray], noise: float
) -> Removed:
    """Return what models remove of a base's held-out error [m]; `noise` [m] is the rms of it."""
    return Removed(partial(held_out_columns, experiments), base, (noise,))


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
    removed = removed_from(experiments, base, noise)
    sums, counts = held_out_parts(experiments, base, extended)
    powers = np.sum(sums, axis=0) / max(int(np.sum(counts)), 1)
    excess, remains = (float(np.sqrt(max(p - noise**2, 0.0))) for p in powers.tolist())
    whole = errors_of(experiments, extended)
    return Budget(
        excess_rms_m=excess,
        noise_rms_m=noise,
        together=removed.share("together", base, extended),
        causes=tuple(removed.share(name, less, extended) for name, less in without),
        unnamed=None
        if correction is None
        else removed.share(correction[0], extended, correction[1]),
        remains_rms_m=remains,
        remains_percent=whole.holdout_nrmse_percent * remains / max(whole.holdout_rms_m, 1e-300),
    )
