"""Optimality for parameters: the covariance that a record and the data at hand would leave.

    Phi = known + J^T W J,   C = (Phi^-1) of the chosen coordinates

J (n, size) holds the exact derivatives of the predicted displacement by parameters, initial states
and the offset; W whitens the noise. D minimises ln det C, A the trace, E the largest eigenvalue;
each is told as minus the logarithm of a mean standard error, so that a difference d of two values
means intervals narrower by the factor exp(d). Gradient: d phi(C) = -tr(Psi dPhi), with
Psi = Phi^-1 E (d phi/d C) E^T Phi^-1 and E the choice of coordinates. Source: Fedorov and Leonov,
Optimal Design for Nonlinear Response Models, 2013, chapters 2 and 10.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from psa_casadi.design.experiment.criterion import Point
from psa_casadi.design.experiment.rivals import Rival
from psa_casadi.diagnosis.colour import Colour
from psa_casadi.errors import InputError
from psa_casadi.records.record import Record
from psa_casadi.units import FloatArray

Optimality = Literal["D", "E", "A"]
OPTIMALITIES: tuple[Optimality, ...] = get_args(Optimality)


@dataclass(frozen=True, eq=False)
class Information:
    """The criterion for the parameters `names` of a model under a noise on the record's grid."""

    rival: Rival
    names: tuple[str, ...]
    optimality: Optimality
    noise: Colour

    def __post_init__(self) -> None:
        unknown = [n for n in self.names if n not in self.rival.unknowns.names]
        if unknown or not self.names:
            free = ", ".join(self.rival.unknowns.names)
            raise InputError(
                f"The parameters {', '.join(unknown) or '(none)'} are not among the model's free"
                f" ones; choose from {free}."
            )
        if self.optimality not in OPTIMALITIES:
            raise InputError(f"There is no optimality '{self.optimality}'; there are D, E and A.")

    @property
    def _chosen(self) -> list[int]:
        return [self.rival.unknowns.names.index(n) for n in self.names]

    def _white(self, record: Record) -> FloatArray:
        _, jacobian = self.rival.sensitivities(record, np.zeros(self.rival.size))
        white: FloatArray = self.noise.whiten(jacobian) / self.noise.level
        return white

    def covariance(self, record: Record | None) -> FloatArray:
        """Return C of the chosen coordinates (k, k), with a record or with the data at hand."""
        information = self.rival.information
        if record is not None:
            white = self._white(record)
            information = information + white.T @ white
        return _inverse(information)[np.ix_(self._chosen, self._chosen)]

    def at(self, record: Record) -> Point:
        """Return the value and a function of the voltage with its gradient."""
        chosen, white = self._chosen, self._white(record)
        inverse = _inverse(self.rival.information + white.T @ white)
        value, slope = _value(inverse[np.ix_(chosen, chosen)], self.optimality)
        sides = inverse[:, chosen]
        weights = 2.0 * white @ (sides @ slope @ sides.T)
        return Point(value, lambda other: float(np.sum(weights * self._white(other))))

    def standard_errors(self, record: Record | None) -> Mapping[str, float]:
        """Return the standard error of every chosen parameter, in its own unit."""
        slopes = np.abs(np.diag(self.rival.unknowns.slopes(self.rival.theta)))
        own = np.sqrt(np.diag(self.covariance(record)))
        return {
            n: float(e * slopes[k]) for n, e, k in zip(self.names, own, self._chosen, strict=True)
        }


def _value(c: FloatArray, optimality: Optimality) -> tuple[float, FloatArray]:
    """Return minus the log of the mean standard error, and -d value / d C."""
    count = len(c)
    if optimality == "D":
        return -0.5 * float(np.linalg.slogdet(c)[1]) / count, 0.5 * np.linalg.inv(c) / count
    if optimality == "A":
        trace = float(np.trace(c))
        return -0.5 * float(np.log(trace / count)), 0.5 * np.eye(count) / trace
    values, vectors = np.linalg.eigh(c)
    worst = vectors[:, -1:]
    slope: FloatArray = 0.5 * worst @ worst.T / values[-1]
    return -0.5 * float(np.log(values[-1])), slope


def _inverse(matrix: FloatArray) -> FloatArray:
    """Invert an information matrix, scaled to a unit diagonal first; unknown offsets are wide."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-12))
    scaled = matrix * scale[:, None] * scale[None, :] + 1e-12 * np.eye(len(matrix))
    inverse: FloatArray = np.linalg.inv(scaled) * scale[:, None] * scale[None, :]
    return inverse
