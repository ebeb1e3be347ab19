"""What a fit searches: parameters, memories, offsets, on scales where 1 is an ordinary change."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from psa_casadi.common.errors import PsaError
from psa_casadi.common.units import BoolArray, FloatArray
from psa_casadi.model.compose import Model
from psa_casadi.model.variables import State, nominal_value

#: Standard deviations of the weak priors: in natural logarithms, and in ordinary changes.
LOG_PRIOR = 3.0
LINEAR_PRIOR = 10.0
#: Initial states with a memory, in usual sizes. One that settles is a mean of its past, and so lies
#: within its usual range: a wider prior would let it fit a relaxation in each record.
MEMORY_PRIOR, SETTLING_PRIOR = 3.0, 1.0
#: Initial states other than memories, in what a steady motion at the record's rates would change.
MOTION_PRIOR = 30.0
#: The responses to lags other than the creep lag are similar: each stays near its start unless the
#: records determine it.
LAG_PRIOR = 1.0
_LAGS = ("R_s", "c_P", "c_B", "c")
_CARRIED = "f_H"
_LOOP = ("k_L", "A", "beta", "gamma")
_STEEPEST = 3.0  # |A| over k_L + A, beyond which the loop hardly changes
_BEND_STEP = 0.2  # an ordinary change of beta A / s, in units of 0.1 k_L


@dataclass(frozen=True)
class Unknowns:
    """The search coordinates of one fit.

    theta = [parameters, then per record: initial states and the sensor's offset]. A parameter that
    spans decades is ln(value / reference), any other (value - reference) / scale. The loop's shape
    (k_L, A, beta, gamma) has joint coordinates where all four are free: with s = k_L + A, the
    slope just after a reversal, they are ln s, A_ref / A - 1, beta A / s and gamma A / s. A loop
    with weak bends fixes s and the two products, and hardly A itself; so its valley is straight
    here, and A without bound (Rayleigh's quadratic loop) lies at a finite distance.
    `started` names, per record, the states whose start is searched, as deviations from where the
    record's first voltage and rate put them. Where the loop has joint coordinates, those of a
    record's memory and offset are q_0 = f_H(0) / A and the offset plus C A (q_0 - v_0), with the
    first voltage v_0 and the static compliance C [m/N]: what follows keeps its place when A moves.
    `prior` holds the standard deviation of every coordinate's weak prior (infinite for offsets),
    centred at 0.
    """

    names: tuple[str, ...]
    started: tuple[tuple[str, ...], ...]
    reference: FloatArray
    scale: FloatArray
    log: BoolArray
    low: FloatArray
    high: FloatArray
    start_scale: tuple[FloatArray, ...]
    first_voltage: tuple[float, ...]
    compliance: float
    offset_scale: float
    prior: FloatArray
    loop: list[int] | None = None

    @property
    def records(self) -> int:
        """Number of records."""
        return len(self.started)

    def first(self, record: int) -> int:
        """Index of the first coordinate of one record: its initial states, then its offset."""
        return len(self.names) + sum(len(s) + 1 for s in self.started[:record])

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return self.first(self.records)

    @property
    def offsets(self) -> tuple[int, ...]:
        """Indices of the records' offsets, in which a prediction is exactly linear."""
        return tuple(self.first(r + 1) - 1 for r in range(self.records))

    def values(self, theta: FloatArray) -> dict[str, float]:
        """Return the parameter values at theta, clipped to their bounds against rounding."""
        free = theta[: len(self.names)]
        log = np.exp(np.where(self.log, free, 0.0))
        value = np.where(self.log, self.reference * log, self.reference + free * self.scale)
        if self.loop is not None:
            value[self.loop] = self._loop_values(free[self.loop])
        value = np.clip(value, self.low, self.high)
        return dict(zip(self.names, value.tolist(), strict=True))

    def slopes(self, theta: FloatArray) -> FloatArray:
        """Return d values / d theta of the parameters, shape (k, k)."""
        value = np.array(list(self.values(theta).values()))
        matrix: FloatArray = np.diag(np.where(self.log, value, self.scale))
        if self.loop is not None:
            k_l, a, beta, gamma = value[self.loop]
            s, step = k_l + a, _BEND_STEP * (k_l + a) / a
            by_second = -a * a / float(self.reference[self.loop[1]])
            matrix[np.ix_(self.loop, self.loop)] = np.array(
                [
                    [s, -by_second, 0.0, 0.0],
                    [0.0, by_second, 0.0, 0.0],
                    [beta, -beta * by_second / a, step * self._bend, 0.0],
                    [gamma, -gamma * by_second / a, 0.0, step * self._bend],
                ]
            )
        return matrix

    def coordinates(self, values: Mapping[str, float]) -> FloatArray:
        """Return the theta of the parameters (k,) at these values.

        Raises PsaError for a loop that has no coordinates.
        """
        value = np.array([values[n] for n in self.names])
        theta = self._one_by_one(value)
        if self.loop is not None:
            k_l, a, beta, gamma = value[self.loop]
            r_k, r_a, r_beta, r_gamma = self.reference[self.loop]
            if (k_l + a) / (r_k + r_a) <= 0.0:
                raise PsaError("A loop whose displacement falls with the voltage cannot be fitted.")
            now, then = a / (k_l + a), r_a / (r_k + r_a)
            theta[self.loop] = [
                np.log((k_l + a) / (r_k + r_a)),
                r_a / a - 1.0,
                (beta * now - r_beta * then) / (_BEND_STEP * self._bend),
                (gamma * now - r_gamma * then) / (_BEND_STEP * self._bend),
            ]
        return theta

    def _one_by_one(self, value: FloatArray) -> FloatArray:
        """Return the coordinates (k,) of values, each by itself: without those of the loop."""
        positive = np.where(self.log, self.reference, 1.0)
        ratio = np.where(self.log, np.maximum(value, 1e-300), 1.0) / positive
        return np.where(self.log, np.log(ratio), (value - self.reference) / self.scale)

    @property
    def _bend(self) -> float:
        """Size of beta A / s in the reference, 0.1 k_L for an ordinary loop [N/V]."""
        return float(0.1 * self.reference[self.names.index("k_L")])

    def _loop_values(self, theta: FloatArray) -> list[float]:
        k_l, a, beta, gamma = self.reference[self.loop or []]
        s_new, a_new = (k_l + a) * np.exp(theta[0]), a / (1.0 + theta[1])
        bends = [q * a / (k_l + a) for q in (beta, gamma)]
        moved = [b + _BEND_STEP * self._bend * t for b, t in zip(bends, theta[2:], strict=True)]
        return [s_new - a_new, a_new, *(m * s_new / a_new for m in moved)]

    def without(self, records: Sequence[int]) -> "Unknowns":
        """Return the unknowns with a prior that keeps the offsets of records without a sample."""
        prior = self.prior.copy()
        prior[[self.first(k + 1) - 1 for k in records]] = 1.0
        return replace(self, prior=prior)

    def start(self, theta: FloatArray, record: int) -> dict[str, float]:
        """Return the deviations of one record's initial state, in the states' units."""
        first, names = self.first(record), self.started[record]
        deviations = theta[first : first + len(names)] * self.start_scale[record]
        values = dict(zip(names, deviations.tolist(), strict=True))
        if self._carries(record):
            values[_CARRIED] *= self._amplitude(theta) / self._a_ref
        return values

    def place(
        self, theta: FloatArray, record: int, states: Mapping[str, float], offset: float
    ) -> None:
        """Write the coordinates of a record's initial state and offset [m] into theta.

        The parameters' coordinates must stand in theta.
        """
        first, last = self.first(record), self.first(record + 1) - 1
        table = {n: states.get(n, 0.0) for n in self.started[record]}
        if self._carries(record):
            a = self._amplitude(theta)
            offset += self.compliance * (table[_CARRIED] - a * self.first_voltage[record])
            table[_CARRIED] *= self._a_ref / a
        theta[first:last] = np.array(list(table.values())) / self.start_scale[record]
        theta[last] = offset / self.offset_scale if self.offset_scale else 0.0

    def place_slopes(self, theta: FloatArray, record: int) -> tuple[FloatArray, FloatArray]:
        """Return d start / d theta, shape (started, size), and d offset / d theta (size,)."""
        first, last = self.first(record), self.first(record + 1) - 1
        start, offset = np.zeros((last - first, self.size)), np.zeros(self.size)
        start[:, first:last] = np.diag(self.start_scale[record])
        offset[last] = self.offset_scale
        if self.loop is not None and self._carries(record):
            row, count = self.started[record].index(_CARRIED), len(self.names)
            a, by_a = self._amplitude(theta), np.zeros(count)
            by_a[self.loop[1]] = -a * a / self._a_ref
            q = self.start(theta, record)[_CARRIED] / a
            start[row, first + row] *= a / self._a_ref
            start[row, :count] = q * by_a
            offset[first + row] = -self.compliance * start[row, first + row]
            offset[:count] = -self.compliance * (q - self.first_voltage[record]) * by_a
        return start, offset

    def _carries(self, record: int) -> bool:
        return self.loop is not None and _CARRIED in self.started[record]

    def _amplitude(self, theta: FloatArray) -> float:
        """Return the loop's A at theta, without all other values."""
        k = self.loop[1] if self.loop is not None else 0
        a = self.reference[k] / (1.0 + theta[k])
        return float(min(max(a, self.low[k]), self.high[k]))

    @property
    def _a_ref(self) -> float:
        return float(self.reference[self.loop[1]]) if self.loop is not None else 1.0

    def offset(self, theta: FloatArray, record: int) -> float:
        """Return the sensor's offset in one record [m]."""
        offset = float(theta[self.first(record + 1) - 1]) * self.offset_scale
        if self._carries(record):
            bent = self._amplitude(theta) * self.first_voltage[record]
            offset -= self.compliance * (self.start(theta, record)[_CARRIED] - bent)
        return offset

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Return lower and upper bounds of theta."""
        low, high = self._one_by_one(self.low), self._one_by_one(self.high)
        if self.loop is not None:
            k_l, a, *_ = self.reference[self.loop]
            low[self.loop] = [-10.0, abs(a) / (_STEEPEST * (k_l + a)) - 1.0, -1e3, -1e3]
            high[self.loop] = [10.0, 1e3, 1e3, 1e3]
        rest = np.full(self.size - len(self.names), np.inf)
        return np.concatenate([low, -rest]), np.concatenate([high, rest])


#: Of every record: sizes and prior widths of the starts that are searched, by the state's name.
Starts = Mapping[str, tuple[float, float]]


def unknowns_of(
    model: Model,
    free: Sequence[str],
    motions: Sequence[Mapping[str, float]],
    first_voltage: Sequence[float],
    offset_scale: float,
) -> Unknowns:
    """Set up the coordinates of a stack around a model's values.

    `motions` names for every record the other states than memories whose start is searched, each
    with the size of an ordinary deviation, in the state's unit; `first_voltage` [V] is where each
    record starts.
    """
    memories = memory_starts(model)
    starts = [memories | {n: (size, MOTION_PRIOR) for n, size in m.items()} for m in motions]
    unknowns = coordinates_of(model, free, starts, offset_scale, np.inf)
    values, prior, log = model.values, unknowns.prior, unknowns.log
    prior[[k for k, n in enumerate(free) if n in _LAGS]] = LAG_PRIOR
    loop = None
    slope = values.get("k_L", 0.0) + values.get("A", 0.0)
    if all(n in free for n in _LOOP) and values["A"] != 0 and slope > 0:
        loop = [list(free).index(n) for n in _LOOP]
        log[loop] = False
        prior[loop] = [LOG_PRIOR, LOG_PRIOR, LINEAR_PRIOR, LINEAR_PRIOR]
    return replace(
        unknowns,
        first_voltage=tuple(first_voltage),
        compliance=static_compliance(values),
        loop=loop,
    )


def coordinates_of(
    model: Model,
    free: Sequence[str],
    starts: Sequence[Starts],
    offset_scale: float,
    offset_prior: float,
) -> Unknowns:
    """Set up the coordinates around a model's values: parameters on the scale that they declare.

    `starts` are those that are searched in each record; its offset stays at 0 where its scale is 0.
    """
    values: Mapping[str, float] = model.values
    parameters = [model.parameter(n) for n in free]
    log = np.array([p.log and values[p.name] > 0 for p in parameters], dtype=bool)
    priors = [np.array([prior for _, prior in s.values()] + [offset_prior]) for s in starts]
    return Unknowns(
        names=tuple(free),
        started=tuple(tuple(s) for s in starts),
        reference=np.array([values[n] for n in free]),
        scale=np.array([p.typical(values) for p in parameters]),
        log=log,
        low=np.array([p.bounds[0] for p in parameters]),
        high=np.array([p.bounds[1] for p in parameters]),
        start_scale=tuple(np.array([size for size, _ in s.values()]) for s in starts),
        first_voltage=(),
        compliance=0.0,
        offset_scale=offset_scale,
        prior=np.concatenate([np.where(log, LOG_PRIOR, LINEAR_PRIOR), *priors]),
    )


def within_bounds(model: Model, values: Mapping[str, float]) -> dict[str, float]:
    """Return values of some parameters, clipped to their bounds."""
    return {n: float(np.clip(v, *model.parameter(n).bounds)) for n, v in values.items()}


def static_compliance(values: Mapping[str, float]) -> float:
    """Return the displacement that a force of the wafers causes at rest [m/N], eq. (14)."""
    if "k_B" in values:
        return 1.0 / values["k_P"] + 1.0 / values["k_B"]
    return 1.0 / values["k"]


def memory_starts(model: Model) -> dict[str, tuple[float, float]]:
    """Return usual size and `memory_prior` of every state whose start no voltage determines."""
    return {
        s.name: (nominal_value(s.nominal, model.values), memory_prior(s))
        for s in model.structure.states
        if s.memory
    }


def memory_prior(state: State) -> float:
    """Return the standard deviation of the weak prior of a state's start, in usual sizes."""
    return SETTLING_PRIOR if state.memory and state.settles else MEMORY_PRIOR
