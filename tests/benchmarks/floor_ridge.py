"""Linear regression whose prior sizes, one to a kind of features, are those of most evidence."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import cho_factor, cho_solve

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

#: Rounds of the re-estimation of the prior sizes and the noise, and when they have settled.
_ROUNDS, _SETTLED = 60, 1e-3
#: Precision of a weight without a prior, and the largest of any, in units of the output's rms.
_FREE, _LARGEST = 1e-8, 1e10


@dataclass(frozen=True, eq=False)
class Ridge:
    """Weights (features,), the standard deviation of what is left, and the log evidence."""

    weights: FloatArray
    sigma: float
    evidence: float


def ridge(features: FloatArray, kinds: IntArray, y: FloatArray) -> Ridge:
    """Fit y = features @ weights; kind 0 has no prior, every other one a size found by evidence.

    MacKay's re-estimation: each size from the weights and how well the data determine them.
    """
    size = np.sqrt(np.mean(features**2, axis=0))
    size[size == 0.0] = 1.0
    scale = float(np.sqrt(np.mean(y**2))) or 1.0
    x, target = features / size, y / scale
    gram, cross, power = x.T @ x, x.T @ target, float(target @ target)
    n = len(y)
    precision, beta = np.where(kinds == 0, _FREE, 1.0), 1e4
    for _ in range(_ROUNDS):
        w, inverse, _ = _solved(gram, cross, precision, beta)
        left = max(power - 2.0 * float(w @ cross) + float(w @ gram @ w), 1e-14 * power)
        known = 1.0 - precision * np.diag(inverse)
        before = precision
        precision, beta = precision.copy(), (n - float(known.sum())) / left
        for kind in set(kinds.tolist()) - {0}:
            of = kinds == kind
            precision[of] = min(float(known[of].sum()) / float(w[of] @ w[of]), _LARGEST)
        if np.all(np.abs(np.log(precision / before)) < _SETTLED):
            break
    w, _, half_log_det = _solved(gram, cross, precision, beta)
    left = power - 2.0 * float(w @ cross) + float(w @ gram @ w)
    evidence = 0.5 * (
        n * np.log(beta)
        + float(np.sum(np.log(precision)))
        - 2.0 * half_log_det
        - beta * left
        - float(precision @ w**2)
    )
    return Ridge(w * scale / size, scale / np.sqrt(beta), float(evidence))


def _solved(
    gram: FloatArray, cross: FloatArray, precision: FloatArray, beta: float
) -> tuple[FloatArray, FloatArray, float]:
    """Return the weights, their covariance, and half the log determinant of its inverse."""
    factor = cho_factor(beta * gram + np.diag(precision), lower=True)
    inverse: FloatArray = cho_solve(factor, np.eye(len(cross)))
    return beta * (inverse @ cross), inverse, float(np.sum(np.log(np.diag(factor[0]))))
