"""The forms of unnamed corrections: what each may add to the prediction, as columns with a prior.

A correction is a sum of columns with weights w_k ~ N(0, (s p_k)^2): s its size, found from the
data, p_k the shape of the prior, smooth where 1/k or steeper. Quantities are over their range:

    curve         cos(k pi q)                       p_k = 1/k            of voltage or displacement
    direction     d cos(k pi q), k from 0           p_k = 1/(1 + k)      d a narrow stop, -1 to 1
    memory        stops E_r, plays^2, plays^3       p_k = 1              of the voltage
    relaxation    z_tau - x, tau z' + z = x         p_k = 1              tau over decades
    modes         resonators driven by the force    p_k = 1              frequencies over decades
    time          cos(k pi t/T)                     p_k = 1/k            of every record
    gain in time  x cos(k pi t/T)                   p_k = 1/k

Stops and plays: Visintin 1994; their squares and cubes make loops that are asymmetric or S-shaped
(generalised Prandtl-Ishlinskii, Al Janaideh, Rakheja and Su 2009).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from psa_casadi.effects.patches import BRANCH, CURVE, ELEMENTS, NARROW, radius
from psa_casadi.identification.start.linear_response import plays
from psa_casadi.records.quality.filtering import filtered
from psa_casadi.records.record import Record
from psa_casadi.records.split import Experiment

FloatArray = npt.NDArray[np.float64]

#: Relaxations per decade, modes.
_PER_DECADE, MODES = 2, 24
#: Damping ratio of modes; relaxations go to so many times the record.
_DAMPING, _LONGEST = 0.05, 3.0
#: A mode rings so many times in the longest record, and within a hundred samples.
_PERIODS, _SLOWEST = 8.0, 0.01


@dataclass(frozen=True)
class Signals:
    """What columns are made of: the records, their voltages and predictions [m].

    `respond` filters a signal at the plant's force as the stack does, over its response at rest.
    """

    experiments: Sequence[Experiment]
    predicted: Sequence[FloatArray]
    respond: Callable[[int, FloatArray], FloatArray]

    def times(self) -> tuple[float, float]:
        """Shortest sampling interval and longest duration of a record [s]."""
        records = [e.record for e in self.experiments]
        return min(r.sample_time for r in records), max(r.duration for r in records)

    def voltage(self, k: int) -> FloatArray:
        """Voltage of a record over the range of all, 0 to 1."""
        every = [e.record.voltage for e in self.experiments]
        return _over_range(self.experiments[k].record.voltage, every)

    def displacement(self, k: int) -> FloatArray:
        """Predicted displacement of a record over the range of all, 0 to 1."""
        return _over_range(self.predicted[k], self.predicted)


@dataclass(frozen=True)
class Kind:
    """One form at one port: its name, its columns of a record (n, k) and the prior's shape (k,)."""

    name: str
    port: str
    columns: Callable[[Signals, int], FloatArray]
    shape: Callable[[int], FloatArray]
    fast: bool = False


def _over_range(values: FloatArray, every: Sequence[FloatArray]) -> FloatArray:
    low = min(float(np.min(v)) for v in every)
    high = max(float(np.max(v)) for v in every)
    return (values - low) / max(high - low, 1e-300)


def _cosines(q: FloatArray, first: int, count: int) -> FloatArray:
    return np.cos(np.pi * np.outer(q, np.arange(first, first + count)))


def _voltage_curve(s: Signals, k: int) -> FloatArray:
    return s.respond(k, _cosines(s.voltage(k), 1, CURVE))


def _force_curve(s: Signals, k: int) -> FloatArray:
    return s.respond(k, _cosines(s.displacement(k), 1, CURVE))


def _reading_curve(s: Signals, k: int) -> FloatArray:
    return _cosines(s.displacement(k), 1, CURVE)


def _direction(s: Signals, k: int) -> FloatArray:
    q = s.voltage(k)
    side = (q[:, None] - plays(q, [NARROW])) / NARROW
    return s.respond(k, side * _cosines(q, 0, BRANCH))


def _memory(s: Signals, k: int) -> FloatArray:
    q = s.voltage(k)
    radii = np.array([radius(k) for k in range(ELEMENTS)])
    followed = plays(q, radii)
    return s.respond(k, np.hstack([q[:, None] - followed, followed**2, followed**3]))


def _relaxation(s: Signals, k: int) -> FloatArray:
    record = s.experiments[k].record
    x = s.displacement(k)
    taus = time_constants([e.record for e in s.experiments])
    step = np.append(0.0, np.diff(record.time))
    return np.column_stack([_relaxed(x, step, float(tau)) - x for tau in taus])


def time_constants(records: Sequence[Record]) -> FloatArray:
    """Return the time constants of a relaxation [s], evenly over the decades of the records."""
    shortest = min(r.sample_time for r in records)
    longest = _LONGEST * max(r.duration for r in records)
    count = max(2, round(_PER_DECADE * float(np.log10(longest / shortest))))
    found: FloatArray = np.geomspace(shortest, longest, count)
    return found


def _modes(s: Signals, k: int) -> FloatArray:
    record = s.experiments[k].record
    x, dt = s.displacement(k), record.sample_time
    shortest, longest = s.times()
    columns = []
    lowest = max(_PERIODS / longest, _SLOWEST / shortest)
    for f in np.geomspace(lowest, 0.45 / shortest, MODES):
        columns += [_resonator(x, f, dt, order) for order in (0, 1)]
    return np.column_stack(columns)


def _time(s: Signals, k: int) -> FloatArray:
    t = s.experiments[k].record.time
    return _cosines((t - t[0]) / (t[-1] - t[0]), 1, BRANCH)


def _gain_in_time(s: Signals, k: int) -> FloatArray:
    return s.displacement(k)[:, None] * _time(s, k)


def _relaxed(x: FloatArray, step: FloatArray, tau: float) -> FloatArray:
    """Return z of tau z' + z = x with x linear between samples, z(0) = x(0)."""
    if np.ptp(step[1:]) < 1e-6 * step[-1]:
        a = float(np.exp(-step[-1] / tau))
        b = (1.0 - a) * tau / step[-1]
        even: FloatArray = x[0] + filtered([1.0 - b, b - a], [1.0, -a], x - x[0])
        return even
    z = np.empty_like(x)
    z[0] = x[0]
    for i in range(1, len(x)):
        a = float(np.exp(-step[i] / tau))
        b = (1.0 - a) * tau / max(step[i], 1e-300)
        z[i] = a * z[i - 1] + (b - a) * x[i - 1] + (1.0 - b) * x[i]
    return z


def _resonator(x: FloatArray, frequency: float, dt: float, order: int) -> FloatArray:
    pole = np.exp(2.0 * np.pi * frequency * dt * (-_DAMPING + 1j * np.sqrt(1.0 - _DAMPING**2)))
    change = np.append(0.0, np.diff(x))
    before = [1.0, 0.0] if order == 0 else [0.0, 1.0]
    return filtered(before, [1.0, -2.0 * pole.real, abs(pole) ** 2], change)


def _flat(count: int) -> FloatArray:
    return np.ones(count)


def _smooth(count: int) -> FloatArray:
    return 1.0 / np.arange(1, count + 1)


KINDS = (
    Kind("curve", "drive voltage", _voltage_curve, _smooth),
    Kind("curve", "reading", _reading_curve, _smooth),
    Kind("curve", "force", _force_curve, _smooth, fast=True),
    Kind("direction", "force", _direction, _smooth),
    Kind("memory", "force", _memory, _flat),
    Kind("relaxation", "force", _relaxation, _flat),
    Kind("modes", "force", _modes, _flat),
    Kind("time", "reading", _time, _smooth),
    Kind("gain in time", "force", _gain_in_time, _smooth),
)
