"""The model of a diagnosis with its evidence: its fit, the held-out error, where that goes."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from psa_casadi.diagnosis.held_out import Budget, Share, errors_of, held_out_parts, jackknife
from psa_casadi.identification.determinacy import determinacy
from psa_casadi.identification.evidence import evidence_of
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.identify import with_provenance
from psa_casadi.model.compose import Model
from psa_casadi.model.evidence import ErrorBudget, ErrorShare, HeldOut
from psa_casadi.records.split import Experiment
from psa_casadi.variables import Interval

FloatArray = npt.NDArray[np.float64]


def diagnosed_model(
    fit: Fit,
    experiments: Sequence[Experiment],
    predicted: Sequence[FloatArray],
    stiffness_given: bool,
    spent: Budget | None = None,
) -> Model:
    """Return a model of a diagnosis with what stands behind it; `spent` is its error's budget."""
    found = determinacy(fit, experiments)
    told = replace(
        evidence_of(fit, found, experiments, predicted, by="psa diagnose"),
        held_out=_held_out(experiments, predicted),
        budget=None
        if spent is None
        else ErrorBudget(
            base_m=spent.excess_rms_m,
            noise_m=spent.noise_rms_m,
            remains_m=spent.remains_rms_m,
            remains_percent=spent.remains_percent,
            causes=tuple(_share(s) for s in spent.causes),
            unnamed=None if spent.unnamed is None else _share(spent.unnamed),
        ),
    )
    records = [e.record for e in experiments]
    return with_provenance(fit.model, found, records, stiffness_given, evidence=told)


def _held_out(experiments: Sequence[Experiment], predicted: Sequence[FloatArray]) -> HeldOut | None:
    """Return the held-out error with the jackknife interval of its logarithm over the parts."""
    sums, counts = held_out_parts(experiments, predicted)
    if not len(counts):
        return None
    errors = errors_of(experiments, predicted)

    def of(kept: npt.NDArray[np.bool_]) -> float:
        power = float(np.sum(sums[kept])) / max(int(np.sum(counts[kept])), 1)
        return 0.5 * float(np.log(max(power, 1e-300)))

    centre, half = jackknife(of, len(counts))
    records = sum(bool(e.held_out.any()) for e in experiments)
    return HeldOut(
        rms_m=errors.holdout_rms_m,
        interval_m=Interval(float(np.exp(centre - half)), float(np.exp(centre + half))),
        max_m=errors.holdout_max_m,
        nrmse_percent=errors.holdout_nrmse_percent,
        records=records if len(counts) == records else 0,
    )


def _share(s: Share) -> ErrorShare:
    return ErrorShare(s.what, s.share, Interval(*s.interval))
