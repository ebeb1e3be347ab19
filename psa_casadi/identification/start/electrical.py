"""The capacitance that a measured current or charge tells, without the mechanics.

    C_p u' = i,   i = (G v - u) / R_s,   G = 1

With the voltage v linear between samples h apart the current has an exact step,

    i_(k+1) = a i_k + (1 - a) C_p (v_(k+1) - v_k) / h,   a = exp(-h / T),

linear in C_p, in the sensor's zero and in the current before the record. The time T is sought along
one line and then left alone: a loss of the ceramic's polarisation looks like a lag of the drive,
R_s C_p, so that only their sum shows. Displacements show the product R_s C_p; the capacitance is
the current's.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from psa_casadi.records.noise import filtered
from psa_casadi.records.record import Record
from psa_casadi.variables import Interval

FloatArray = npt.NDArray[np.float64]

#: Times T that are tried, over the sampling interval, and how often the grid closes in.
_TIMES, _ROUNDS = np.geomspace(0.1, 200.0, 25), 3
#: Capacitances of stacks [F], with a wide margin: what lies outside is of another unit or thing.
_ORDINARY = (1e-10, 1e-2)
#: Least share of the current's variance that the drive must explain for its figures to count.
_EXPLAINED = 0.9
#: Standard errors of half a 95 % interval; steps that differ by more are uneven; a model's
#: capacitance is the current's if it differs by less.
_NORMAL, _UNEVEN, _SAME = 1.96, 1e-2, 0.02


@dataclass(frozen=True)
class Capacitance:
    """Capacitance [F] by a measured current, or charge, with its standard error.

    `explained` is the share of the `source`'s variance.
    """

    value: float
    error: float
    explained: float
    source: str = "current"

    @property
    def interval(self) -> Interval:
        """The 95 % interval [F]."""
        half = _NORMAL * self.error
        return Interval(self.value - half, self.value + half)

    def is_that_of(self, value: float) -> bool:
        """Whether a model has this capacitance."""
        return abs(value - self.value) < _SAME * self.value

    def sentence(self, value: float) -> str:
        """What the current says, in words; `value` [F] is that of the model."""
        low, high = 1e6 * self.interval.low, 1e6 * self.interval.high
        kept = "" if self.is_that_of(value) else f" The model keeps the {1e6 * value:.4g} uF given."
        return (
            f"The measured {self.source} tells C_p = {1e6 * self.value:.4g} uF ({low:.4g} to"
            f" {high:.4g}; times the amplifier's gain, if the voltage is its input): it explains"
            f" {100 * self.explained:.1f} % of it.{kept}"
        )


def capacitance_of(records: Sequence[Record]) -> Capacitance | None:
    """Return what measured currents tell, else charges; None where neither follows a capacitance.

    A current that is limited, leaks, has its sign turned, or belongs to another voltage is
    explained badly. Records with uneven time steps tell nothing.
    """
    own = [r for r in records if r.current is not None and r.n > 3 and _even(r)]
    shown = [np.asarray(r.current, dtype=np.float64) for r in own]
    total = sum(float(np.sum((i - np.mean(i)) ** 2)) for i in shown)
    if total == 0.0:
        return _by_charge(records)
    times = min(r.sample_time for r in own) * _TIMES
    for _ in range(_ROUNDS):
        left = [_solved(own, float(q))[1] for q in times]
        k = int(np.argmin(left))
        best = float(times[k])
        times = np.geomspace(times[max(k - 1, 0)], times[min(k + 1, len(times) - 1)], len(_TIMES))
    value, rest, error = _solved(own, best)
    explained = 1.0 - rest / total
    if explained < _EXPLAINED or not _ORDINARY[0] < value < _ORDINARY[1]:
        return None
    return Capacitance(value, error, explained)


def _by_charge(records: Sequence[Record]) -> Capacitance | None:
    """Return the charge per volt, every record about its mean; None without a charge."""
    given = [(r.voltage, np.asarray(r.charge)) for r in records if r.charge is not None]
    pairs = [(v - np.mean(v), q - np.mean(q)) for v, q in given]
    power = sum(float(v @ v) for v, _ in pairs)
    total = sum(float(q @ q) for _, q in pairs)
    if power == 0.0 or total == 0.0:
        return None
    value = sum(float(v @ q) for v, q in pairs) / power
    rest = sum(float(np.sum((q - value * v) ** 2)) for v, q in pairs)
    explained = 1.0 - rest / total
    if explained < _EXPLAINED or not _ORDINARY[0] < value < _ORDINARY[1]:
        return None
    # what is left is a loop, not noise: its width does not average out
    return Capacitance(value, float(np.sqrt(rest / power)), explained, "charge")


def _even(record: Record) -> bool:
    steps = np.diff(record.time)
    return bool(np.ptp(steps) < _UNEVEN * float(np.mean(steps)))


def _solved(records: Sequence[Record], time: float) -> tuple[float, float, float]:
    """Return C_p at a time T [s], the sum of squares left, and C_p's standard error.

    For a residual that is an autoregression of first order.
    """
    columns = _columns(records, time)
    scale = np.linalg.norm(columns, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    shown = np.concatenate([np.asarray(r.current, dtype=np.float64) for r in records])
    found, *_ = np.linalg.lstsq(columns / scale, shown, rcond=None)
    rest = shown - (columns / scale) @ found
    power = float(rest @ rest)
    alike = min(max(float(rest[1:] @ rest[:-1]) / max(power, 1e-300), 0.0), 0.999)
    inflation = (1.0 + alike) / (1.0 - alike)
    spread = np.linalg.pinv((columns / scale).T @ (columns / scale), hermitian=True)[0, 0]
    freedom = max(len(rest) - columns.shape[1], 1)
    error = float(np.sqrt(spread * power / freedom * inflation)) / scale[0]
    return float(found[0] / scale[0]), power, error


def _columns(records: Sequence[Record], time: float) -> FloatArray:
    """Return the current per farad, and of every record the sensor's zero and the start."""
    every = []
    for k, record in enumerate(records):
        keep = float(np.exp(-record.sample_time / time))
        rate = np.append(0.0, np.diff(record.voltage) / np.diff(record.time))
        own = np.zeros((record.n, 1 + 2 * len(records)))
        own[:, 0] = filtered([1.0 - keep], [1.0, -keep], rate)
        own[:, 1 + 2 * k] = 1.0
        own[:, 2 + 2 * k] = np.exp(-(record.time - record.time[0]) / time)
        every.append(own)
    return np.vstack(every)
