"""Separation of rivals: how far one rival's prediction stays from another that is fitted again.

    T(a, b) = min over delta of |W (y_a(v) - y_b(v, delta))|^2 + delta^T H_b delta

y_a is what rival a predicts for the voltage v, its effect a standard error weaker than fitted, y_b
what rival b does at coordinates delta away from its fit (parameters, initial states, offset), W
whitens the noise, and H_b is what the data at hand know of b: it may move only where they let it.
If a is true, ln of the Bayes factor of a over b is expected to grow by T/2 with variance T. The
value is the logarithm of the harmonic mean of all T(a, b). Sources: Atkinson and Fedorov,
Biometrika 62 (1975), 57 (T-optimality); for Gaussian noise T/2 is the Kullback-Leibler distance
(Lopez-Fidalgo, Tommasi and Trandafir 2007).
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from psa_casadi.design.experiment.criterion import Point
from psa_casadi.design.experiment.rivals import Rival
from psa_casadi.diagnosis.colour import Colour
from psa_casadi.errors import InputError, PsaError
from psa_casadi.identification.fitting.levenberg_marquardt import minimise
from psa_casadi.records.record import Record
from psa_casadi.simulation.side_by_side import side_by_side
from psa_casadi.simulation.stepper import SimulationError
from psa_casadi.units import FloatArray

#: Evaluations of a re-fit at most, while voltages are compared and in the end; when it has settled.
#: A re-fit that is cut off too soon shows a distance that is not there, which a search would find.
QUICK, FINAL, _SETTLED = 30, 40, 1e-4
#: Distances below this are none.
LEAST = 1e-6


@dataclass(frozen=True, eq=False)
class _Refit:
    """Rival b fitted again to a: the distance T, where b ended, and the whitened difference."""

    distance: float
    delta: FloatArray
    difference: FloatArray


@dataclass(frozen=True, eq=False)
class Separation:
    """The criterion for rivals under a noise on the record's grid.

    A re-fit is cut off after so many `evaluations` while voltages are compared.
    """

    rivals: tuple[Rival, ...]
    noise: Colour
    evaluations: int = QUICK

    def __post_init__(self) -> None:
        if len(self.rivals) < 2:
            raise InputError("One effect cannot be separated from itself; name two or more.")

    def at(self, record: Record) -> Point:
        """Return the value and a function of the voltage with its gradient."""
        found = self._refits(record, self.evaluations)
        inverse = {pair: 1.0 / max(r.distance, LEAST) for pair, r in found.items()}
        total = sum(inverse.values())
        value = overall([r.distance for r in found.values()])

        def frozen(other: Record) -> float:
            plain = [r.predict(other, r.truth) for r in self.rivals]
            moved = 0.0
            for (a, b), r in found.items():
                gap = plain[a] - self.rivals[b].predict(other, r.delta)
                slope = 2.0 * r.difference @ self._white(gap)
                moved += inverse[a, b] ** 2 / total * float(slope)
            return moved

        return Point(value, frozen)

    def distances(self, record: Record) -> Mapping[tuple[str, str], float]:
        """Return T of every true rival and other one, by their names, fitted to the end."""
        names = [r.name for r in self.rivals]
        found = self._refits(record, FINAL)
        return {(names[a], names[b]): r.distance for (a, b), r in found.items()}

    def distance(self, truth: Rival, other: Rival, record: Record) -> float:
        """Return T of one pair, fitted to the end."""
        target = truth.predict(record, truth.truth)
        return self._refit(target, other, record, FINAL).distance

    def _refits(self, record: Record, steps: int) -> dict[tuple[int, int], _Refit]:
        plain = side_by_side(lambda r: r.predict(record, r.truth), self.rivals)
        pairs = list(permutations(range(len(self.rivals)), 2))
        found = side_by_side(
            lambda ab: self._refit(plain[ab[0]], self.rivals[ab[1]], record, steps), pairs
        )
        return dict(zip(pairs, found, strict=True))

    def _refit(self, target: FloatArray, rival: Rival, record: Record, evaluations: int) -> _Refit:
        """Fit a rival again to a target (n,) [m], held by what is known of it."""
        root = _root(rival.information)

        def evaluate(delta: FloatArray) -> tuple[FloatArray, FloatArray] | None:
            try:
                y, jacobian = rival.sensitivities(record, delta)
            except PsaError:
                return None
            residual = np.concatenate([self._white(y - target), root @ delta])
            return residual, np.vstack([self._white(jacobian), root])

        found = minimise(
            evaluate,
            np.zeros(rival.size),
            rival.bounds(),
            tolerance=_SETTLED,
            evaluations=evaluations,
        )
        if found is None:
            raise SimulationError(
                f"The model with {rival.name} cannot follow a planned voltage; its values are far"
                " from physical ones."
            )
        return _Refit(found.cost, found.theta, -found.residual[: record.n])

    def _white(self, signal: FloatArray) -> FloatArray:
        white: FloatArray = self.noise.whiten(signal) / self.noise.level
        return white


def overall(distances: Collection[float]) -> float:
    """Return the logarithm of the harmonic mean of distances: the least one counts most."""
    return float(np.log(len(distances) / sum(1.0 / max(t, LEAST) for t in distances)))


def _root(information: FloatArray) -> FloatArray:
    """Return R with R^T R = information."""
    values, vectors = np.linalg.eigh(information)
    root: FloatArray = np.sqrt(np.clip(values, 0.0, None))[:, None] * vectors.T
    return root
