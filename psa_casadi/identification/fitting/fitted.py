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
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""

    @property
    def started(self) -> tuple[tuple[str, ...], ...]:
        """Names of what every record has of its own."""

    @property
    def prior(self) -> FloatArray:
        """Standard deviations of the weak priors (size,)."""

    @property
    def size(self) -> int:
        """Number of coordinates."""

    def first(self, record: int) -> int:
        """Return the index of the first coordinate of one record."""


class FittedColumn(Protocol):
    """The fit of one column beside the first: samples of all records that have it, stacked.

    `residuals` (n,) are measured minus predicted, `jacobian` (n, size) d prediction / d theta, both
    without what the orthonormal `basis` (n, k) spans.
    """

    @property
    def column(self) -> str:
        """Name of the column."""

    @property
    def residuals(self) -> FloatArray:
        """Measured minus predicted (n,)."""

    @property
    def jacobian(self) -> FloatArray:
        """Derivatives of the prediction by theta (n, size)."""

    @property
    def basis(self) -> FloatArray:
        """What is projected out (n, k), orthonormal."""

    @property
    def lengths(self) -> tuple[int, ...]:
        """Numbers of samples of the records."""

    @property
    def straight(self) -> float:
        """Rms below which nothing is known of the column."""


class Fitted(Protocol):
    """A fit: residuals and derivatives of the first column, and the columns beside it."""

    @property
    def residuals(self) -> FloatArray:
        """Measured minus predicted (n,)."""

    @property
    def jacobian(self) -> FloatArray:
        """Derivatives of the prediction by theta (n, size)."""

    @property
    def unknowns(self) -> Searched:
        """The coordinates of the fit."""

    @property
    def further(self) -> Sequence[FittedColumn]:
        """The columns beside the first."""
