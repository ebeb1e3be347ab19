"""What depends on what in a model's equations, by their sparsity."""

from collections.abc import Iterable

import casadi as ca
import numpy as np
import numpy.typing as npt

from psa_casadi.component import Expression
from psa_casadi.model.structure import Structure

BoolArray = npt.NDArray[np.bool_]


def dependence(of: Expression, on: Expression) -> BoolArray:
    """Return which rows of an expression depend on which symbols, shape (rows, symbols)."""
    return np.array(ca.DM(ca.jacobian_sparsity(of, on), 1).full(), dtype=bool)


def closure(depends: BoolArray) -> BoolArray:
    """Return [k, j]: a change of j reaches k sooner or later; each reaches itself."""
    reach = depends | np.eye(len(depends), dtype=bool)
    for _ in range(len(depends).bit_length()):
        reach = (reach.astype(int) @ reach.astype(int)) > 0
    return reach


def variables(s: Structure) -> Expression:
    """Return states, inputs and time, one above the other."""
    return ca.vertcat(s.x, s.u, s.time)


def others(s: Structure, i: int) -> Iterable[int]:
    """Return the indices of all states but the i-th."""
    return (j for j in range(len(s.states)) if j != i)
