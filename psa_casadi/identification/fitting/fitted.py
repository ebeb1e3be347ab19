"""What a fit of any model tells those who judge it: a stack's fit, or that of own equations."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


class Searched(Protocol):
    """The coordinates of a fit: parameters by name, then what every record has of its own.

    `prior` (size,) are the standard deviations of their weak priors, infinite where there is none.
    """

    @property
    def names(self) -> tuple[str, ...]: ...
    @property
    def started(self) -> tuple[tuple[str, ...], ...]: ...
    @property
    def prior(self) -> FloatArray: ...
    @property
    def size(self) -> int: ...
    def first(self, record: int) -> int:
        """Return the index of the first coordinate of one record."""


class FittedColumn(Protocol):
    """The fit of one column beside the first: samples of all records that have it, stacked.

    `residuals` (n,) are measured minus predicted, `jacobian` (n, size) d prediction / d theta, both
    without what the orthonormal `basis` (n, k) spans.
    """

    @property
    def column(self) -> str: ...
    @property
    def residuals(self) -> FloatArray: ...
    @property
    def jacobian(self) -> FloatArray: ...
    @property
    def basis(self) -> FloatArray: ...
    @property
    def lengths(self) -> tuple[int, ...]: ...
    @property
    def straight(self) -> float: ...


class Fitted(Protocol):
    """A fit: residuals and derivatives of the first column, and the columns beside it."""

    @property
    def residuals(self) -> FloatArray: ...
    @property
    def jacobian(self) -> FloatArray: ...
    @property
    def unknowns(self) -> Searched: ...
    @property
    def further(self) -> Sequence[FittedColumn]: ...
