"""What a model's linear part does in a step: exact responses, as numbers.

With L' = M L + g(t) and g = r + s t + q t^2 beside M L(0), the change over h is
E_1 r + E_2 s + 2 E_3 q, where E_k is the k-fold integral of exp(M t) over the step: one exponential
of M with three integrators (van Loan, IEEE Trans. Automatic Control 23 (1978) 395).
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np
import numpy.typing as npt
import scipy

from psa_casadi.model.compose import Model
from psa_casadi.simulation.exact.dependence import closure
from psa_casadi.simulation.exact.split import Split

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LinearPart:
    """M (n, n), B (n, nu), c (n,) of L' = M L + B u + c + ports, with values."""

    m: FloatArray
    b: FloatArray
    c: FloatArray


@dataclass(frozen=True, eq=False)
class Responses:
    """E_1, E_2 / step and 2 E_3 / step^2 (n, n each) over a part of a step."""

    constant: FloatArray
    ramp: FloatArray
    square: FloatArray


def linear_part(model: Model, split: Split) -> LinearPart:
    """Return the linear part of a split with the model's values."""
    matrices = ca.Function("linear", [split.structure.p], list(split.matrices))
    m, b, c = (q.full() for q in matrices(model.parameter_vector()))
    return LinearPart(m, b, c[:, 0])


def responses(m: FloatArray, nominal: FloatArray, *, step: float, share: float) -> Responses:
    """Return the responses at `share` of a `step` [s]; what M does not join is exactly 0.

    `nominal` (n,) are the states' usual sizes, which keep the exponential's numbers alike.
    """
    n = len(m)
    scaled = m * nominal / nominal[:, None]
    system = np.zeros((4 * n, 4 * n))
    system[:n, :n] = scaled * step * share
    for k in range(3):
        system[k * n : (k + 1) * n, (k + 1) * n : (k + 2) * n] = np.eye(n)
    full = scipy.linalg.expm(system)
    joined = closure(m != 0.0)
    parts = [
        np.where(joined, full[:n, k * n : (k + 1) * n] * nominal[:, None] / nominal, 0.0)
        for k in (1, 2, 3)
    ]
    return Responses(
        parts[0] * step * share, parts[1] * step * share**2, 2.0 * parts[2] * step * share**3
    )
