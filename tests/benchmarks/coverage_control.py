"""What the drawn noise alone lets intervals cover: linear theory at the truth, without any fit.

Fifty sets of records are few: their draws give 92 or 98 % where 95 % are meant. With the Jacobian J
at the truth the estimate is off by dtheta = (J^T J / s^2 + P)^-1 J^T e / s^2 for the drawn noise e
of level s and the priors' precision P, with the covariance (J^T J / s^2 + P)^-1. An identification
covers as much as that, less what its search and its intervals get wrong.
"""

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from psa_casadi.identification.fitting.fit import fit
from psa_casadi.model.compose import Model
from psa_casadi.records import Record
from psa_casadi.records.split import whole
from tests.benchmarks.records import Values

FloatArray = npt.NDArray[np.float64]
_STEP, _RTOL = 1e-5, 1e-8


def drawn_scores(
    model: Model,
    clean: Sequence[Record],
    noisy: Sequence[Record],
    names: Sequence[str],
    level: float,
    quantities: Callable[[Values], Values],
) -> dict[str, float]:
    """Return by how many standard errors the draws move each quantity, at the truth.

    `model` carries the truth, `names` are the parameters that are fitted, `level` [m] is the
    noise's; `quantities` makes the compared quantities of parameter values.
    """
    experiments = [whole(r) for r in clean]
    at = fit(model, experiments, names, sigma=[level] * len(clean), evaluations=1, rtol=_RTOL)
    pairs = zip(noisy, clean, strict=True)
    noise = np.concatenate([_displacement(n) - _displacement(c) for n, c in pairs])
    scaled, count = at.jacobian / level, len(names)
    covariance = np.linalg.pinv(
        scaled.T @ scaled + np.diag(1.0 / at.unknowns.prior**2), hermitian=True
    )
    moved = covariance @ (scaled.T @ (noise / level))
    slopes = gradients(model.values, names, quantities) @ at.unknowns.slopes(at.theta)
    errors = np.sqrt(np.einsum("qk,kl,ql->q", slopes, covariance[:count, :count], slopes))
    scores = slopes @ moved[:count] / errors
    return dict(zip(quantities(model.values), scores.tolist(), strict=True))


def gradients(
    values: Values, names: Sequence[str], quantities: Callable[[Values], Values]
) -> FloatArray:
    """Return d quantity / d parameter (quantities, k), by central differences."""
    columns = []
    for name in names:
        h = _STEP * max(abs(values[name]), 1e-300)
        up, down = (quantities({**values, name: values[name] + s}) for s in (h, -h))
        columns.append([(up[q] - down[q]) / (2.0 * h) for q in up])
    return np.array(columns).T


def _displacement(record: Record) -> FloatArray:
    if record.displacement is None:
        raise ValueError(f"record '{record.name}' has no displacement")
    return record.displacement
