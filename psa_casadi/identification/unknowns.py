"""What a fit searches: parameters, memories, offsets, on scales where 1 is an ordinary change."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from psa_casadi.model.compose import Model
from psa_casadi.simulation.start import memory_names
from psa_casadi.variables import nominal_value

FloatArray = npt.NDArray[np.float64]

#: Standard deviations of the weak priors: in natural logarithms, and in ordinary changes.
LOG_PRIOR = 3.0
LINEAR_PRIOR = 10.0
MEMORY_PRIOR = 3.0
#: Lags beside the creep lag are alike in most records: each stays near its start unless told.
LAG_PRIOR = 1.0
_LAGS = ("R_s", "c_P", "c_B", "c")
_LOOP = ("k_L", "A", "beta", "gamma")
_BEND_STEP = 0.2  # an ordinary change of beta A / s, in units of 0.1 k_L


@dataclass(frozen=True)
class Unknowns:
    """The search coordinates of one fit.

    theta = [parameters, then per record: memories and the sensor's offset]. A parameter that spans
    decades is ln(value / reference), any other (value - reference) / scale. The shape of the loop
    (k_L, A, beta, gamma) has coordinates of its own where all four are free: with s = k_L + A, the
    slope just after a reversal, they are ln s, ln |A|, beta A / s and gamma A / s. A loop with weak
    bends fixes s and the two products, and hardly A itself; so its valley is straight here.
    `prior` holds the standard deviation of every coordinate's weak prior (infinite for offsets),
    centred at 0.
    """

    names: tuple[str, ...]
    memories: tuple[str, ...]
    records: int
    reference: FloatArray
    scale: FloatArray
    log: npt.NDArray[np.bool_]
    low: FloatArray
    high: FloatArray
    memory_scale: FloatArray
    offset_scale: float
    prior: FloatArray
    loop: tuple[int, ...] | None = None

    @property
    def per_record(self) -> int:
        """Number of coordinates that each record adds: its memories and its offset."""
        return len(self.memories) + 1

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return len(self.names) + self.records * self.per_record

    def values(self, theta: FloatArray) -> dict[str, float]:
        """Return the parameter values at theta, clipped to their bounds against rounding."""
        free = theta[: len(self.names)]
        log = np.exp(np.where(self.log, free, 0.0))
        value = np.where(self.log, self.reference * log, self.reference + free * self.scale)
        if self.loop is not None:
            value[list(self.loop)] = self._loop_values(free[list(self.loop)])
        value = np.clip(value, self.low, self.high)
        return dict(zip(self.names, value.tolist(), strict=True))

    def slopes(self, theta: FloatArray) -> FloatArray:
        """Return d values / d theta of the parameters, shape (k, k)."""
        value = np.array(list(self.values(theta).values()))
        matrix: FloatArray = np.diag(np.where(self.log, value, self.scale))
        if self.loop is not None:
            where = list(self.loop)
            k_l, a, beta, gamma = value[where]
            s, step = k_l + a, _BEND_STEP * (k_l + a) / a
            matrix[np.ix_(where, where)] = np.array(
                [
                    [s, -a, 0.0, 0.0],
                    [0.0, a, 0.0, 0.0],
                    [beta, -beta, step * self._bend, 0.0],
                    [gamma, -gamma, 0.0, step * self._bend],
                ]
            )
        return matrix

    def coordinates(self, values: Mapping[str, float]) -> FloatArray:
        """Return the theta of the parameters (k,) at the given values."""
        value = np.array([values[n] for n in self.names])
        ratio = np.where(self.log, np.maximum(value, 1e-300), 1.0) / np.where(
            self.log, self.reference, 1.0
        )
        theta: FloatArray = np.where(self.log, np.log(ratio), (value - self.reference) / self.scale)
        if self.loop is not None:
            where = list(self.loop)
            k_l, a, beta, gamma = value[where]
            r_k, r_a, r_beta, r_gamma = self.reference[where]
            now, then = a / (k_l + a), r_a / (r_k + r_a)
            theta[where] = [
                np.log((k_l + a) / (r_k + r_a)),
                np.log(a / r_a),
                (beta * now - r_beta * then) / (_BEND_STEP * self._bend),
                (gamma * now - r_gamma * then) / (_BEND_STEP * self._bend),
            ]
        return theta

    @property
    def _bend(self) -> float:
        """Size of beta A / s in the reference, 0.1 k_L for an ordinary loop [N/V]."""
        return float(0.1 * self.reference[self.names.index("k_L")])

    def _loop_values(self, theta: FloatArray) -> list[float]:
        k_l, a, beta, gamma = self.reference[list(self.loop or ())]
        s_new, a_new = (k_l + a) * np.exp(theta[0]), a * np.exp(theta[1])
        bends = [q * a / (k_l + a) for q in (beta, gamma)]
        moved = [b + _BEND_STEP * self._bend * t for b, t in zip(bends, theta[2:], strict=True)]
        return [s_new - a_new, a_new, *(m * s_new / a_new for m in moved)]

    def memory(self, theta: FloatArray, record: int) -> FloatArray:
        """Return the memory deviations of one record, in the states' units."""
        first = len(self.names) + record * self.per_record
        return theta[first : first + len(self.memories)] * self.memory_scale

    def offset(self, theta: FloatArray, record: int) -> float:
        """Return the sensor's offset in one record [m]."""
        return (
            float(theta[len(self.names) + (record + 1) * self.per_record - 1]) * self.offset_scale
        )

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Return lower and upper bounds of theta."""
        positive = np.where(self.log, self.reference, 1.0)
        edges = [
            np.where(
                self.log,
                np.log(np.maximum(edge, 1e-300) / positive),
                (edge - self.reference) / self.scale,
            )
            for edge in (self.low, self.high)
        ]
        if self.loop is not None:
            for edge, sign in zip(edges, (-1.0, 1.0), strict=True):
                edge[list(self.loop)] = sign * np.array([10.0, 10.0, 1e3, 1e3])
        rest = np.full(self.size - len(self.names), np.inf)
        return np.concatenate([edges[0], -rest]), np.concatenate([edges[1], rest])


def unknowns_of(model: Model, free: Sequence[str], records: int, offset_scale: float) -> Unknowns:
    """Set up the coordinates around a model's values."""
    parameters = [model.parameter(n) for n in free]
    values: Mapping[str, float] = model.values
    states = {s.name: s for s in model.structure.states}
    memories = memory_names(model.structure)
    log = np.array([p.log for p in parameters], dtype=bool)
    prior = np.where(log, LOG_PRIOR, LINEAR_PRIOR)
    prior = np.where([n in _LAGS for n in free], LAG_PRIOR, prior)
    loop = None
    slope = values.get("k_L", 0.0) + values.get("A", 0.0)
    if all(n in free for n in _LOOP) and values["A"] != 0 and slope > 0:
        loop = tuple(list(free).index(n) for n in _LOOP)
        log[list(loop)] = False
        prior[list(loop)] = [LOG_PRIOR, LOG_PRIOR, LINEAR_PRIOR, LINEAR_PRIOR]
    each = np.array([MEMORY_PRIOR] * len(memories) + [np.inf])
    return Unknowns(
        names=tuple(free),
        memories=memories,
        records=records,
        reference=np.array([values[n] for n in free]),
        scale=np.array([p.typical(values) for p in parameters]),
        log=log,
        low=np.array([p.bounds[0] for p in parameters]),
        high=np.array([p.bounds[1] for p in parameters]),
        memory_scale=np.array([nominal_value(states[m].nominal, values) for m in memories]),
        offset_scale=offset_scale,
        prior=np.concatenate([prior, np.tile(each, records)]),
        loop=loop,
    )
