"""What a measured current tells of the drive, without the mechanics.

    C_p u' = i,   i = (G v - u) / R_s,   G = 1

With the voltage v linear between samples h apart the current has an exact step,

    i_(k+1) = a i_k + (1 - a) C_p (v_(k+1) - v_k) / h,   a = exp(-h / (R_s C_p)),

where h hardly varies (its mean is taken). It is linear in C_p, the zero of the sensor and the
current before the record; the lag R_s C_p is sought along one line. Displacements only show the
product R_s C_p: what tells the capacitance is the current.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from psa_casadi.records.quality.filtering import filtered
from psa_casadi.records.record import Record
from psa_casadi.variables import Interval

FloatArray = npt.NDArray[np.float64]

#: Lags that are tried first, over the sampling interval: shorter ones do not show.
_LAGS, _ROUNDS = np.geomspace(0.1, 200.0, 25), 4
#: Capacitances of stacks [F], with a wide margin: what lies outside is of another unit or thing.
_ORDINARY = (1e-10, 1e-2)
#: Least share of the current's variance that the drive must explain for its figures to count.
_EXPLAINED = 0.9
#: Standard errors of half a 95 % interval, and the largest one of ln(R_s C_p) that tells it.
_NORMAL, _TOLD = 1.96, 0.25


@dataclass(frozen=True)
class Drive:
    """Capacitance [F] and lag R_s C_p [s] by a measured current, each with its standard error.

    The lag is None where the current does not show one. `explained` is the share of the current's
    variance.
    """

    capacitance: float
    capacitance_error: float
    lag: float | None
    lag_error: float
    explained: float

    @property
    def interval(self) -> tuple[float, float]:
        """The capacitance's 95 % interval [F]."""
        half = _NORMAL * self.capacitance_error
        return self.capacitance - half, self.capacitance + half

    def intervals(self, values: Mapping[str, float]) -> dict[str, Interval]:
        """Return the 95 % intervals of those of a model's values that are the current's."""
        c_p, r_s = values.get("C_p", 0.0), values.get("R_s", 0.0)
        low, high = self.interval
        found = {"C_p": Interval(low, high)} if low <= c_p <= high else {}
        if found and self.lag is not None:
            ends = [(self.lag + q * _NORMAL * self.lag_error) / c_p for q in (-1.0, 1.0)]
            if ends[0] <= r_s <= ends[1]:
                found["R_s"] = Interval(*ends)
        return found

    @property
    def sentence(self) -> str:
        """What the current says, in words."""
        low, high = (1e6 * q for q in self.interval)
        lag = ""
        if self.lag is not None:
            lag = (
                f" and R_s C_p = {1e6 * self.lag:.3g} us"
                f" (give or take {1e6 * _NORMAL * self.lag_error:.2g} us)"
            )
        return (
            f"The measured current tells C_p = {1e6 * self.capacitance:.4g} uF"
            f" ({low:.4g} to {high:.4g}; times the amplifier's gain, if the voltage is its"
            f" input){lag}, which explain {100 * self.explained:.1f} % of it."
        )


def drive_of(records: Sequence[Record]) -> Drive | None:
    """Return what the measured currents tell; None without one, or where they follow no drive.

    A current that is limited, leaks, or belongs to another voltage is explained badly.
    """
    own = [r for r in records if r.current is not None and r.n > 3]
    given = [np.asarray(r.current)[:, None] for r in own]
    if not own or not any(np.ptp(i) > 0.0 for i in given):
        return None
    h = min(r.sample_time for r in own)
    total = sum(float(np.sum((i - np.mean(i)) ** 2)) for i in given)

    lags = h * _LAGS
    for _ in range(_ROUNDS):
        tried = [_solved(own, float(q))[1] for q in lags]
        k = int(np.argmin(tried))
        best = float(lags[k])
        lags = np.geomspace(lags[max(k - 1, 0)], lags[min(k + 1, len(lags) - 1)], len(_LAGS))
    solution, rest, columns = _solved(own, best)
    explained = 1.0 - rest / total
    if explained < _EXPLAINED or not _ORDINARY[0] < solution[0] < _ORDINARY[1]:
        return None
    slope = (_columns(own, best * 1.001)[:, 0] - columns[:, 0]) * solution[0] / 0.001
    both = np.column_stack([columns, slope])
    freedom = max(len(columns) - both.shape[1], 1)
    spread = np.sqrt(np.diag(np.linalg.pinv(both.T @ both)) * rest / freedom)
    told = h * _LAGS[0] < best < h * _LAGS[-1] and spread[-1] < _TOLD
    return Drive(
        capacitance=float(solution[0]),
        capacitance_error=float(spread[0]),
        lag=best if told else None,
        lag_error=float(best * spread[-1]),
        explained=explained,
    )


def _solved(records: Sequence[Record], lag: float) -> tuple[FloatArray, float, FloatArray]:
    """Return the linear unknowns, C_p first, at a lag [s]; the sum of squares left; the columns."""
    columns = _columns(records, lag)
    shown = np.concatenate([np.asarray(r.current, dtype=np.float64) for r in records])
    found = np.linalg.lstsq(columns, shown, rcond=None)[0]
    rest = shown - columns @ found
    return found, float(rest @ rest), columns


def _columns(records: Sequence[Record], lag: float) -> FloatArray:
    """Return the current per farad, and of every record the sensor's zero and the start."""
    every = []
    for k, record in enumerate(records):
        step = np.diff(record.time)
        keep = float(np.exp(-record.sample_time / lag))
        rate = np.append(0.0, np.diff(record.voltage) / step)
        own = np.zeros((record.n, 1 + 2 * len(records)))
        own[:, 0] = filtered([1.0 - keep], [1.0, -keep], rate)
        own[:, 1 + 2 * k] = 1.0
        own[:, 2 + 2 * k] = np.exp(-(record.time - record.time[0]) / lag)
        every.append(own)
    return np.vstack(every)
