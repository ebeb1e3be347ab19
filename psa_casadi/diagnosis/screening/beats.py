"""A sawtooth in the local delay of a residual: two clocks that are not synchronous."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.records.split import Experiment

FloatArray = npt.NDArray[np.float64]

#: Intervals of a record whose delays are compared; phases of a beat that are tried, and how much
#: finer than 1/duration its rates; steps in which the best is refined on either side.
_INTERVALS, _PHASES, _FINER, _REFINED = 256, 32, 8, 6
#: A beat must hold so many reversals of the motion, else it may be a form of the loops.
_REVERSALS = 8
#: What a sawtooth must remove of the squares, over what an interval's own scatter is.
_CLEAR = 30.0


@dataclass(frozen=True)
class Beat:
    """Phase at the record's start [beats], rate [Hz], the age's size [s], and how clear it is.

    `clear` is what the sawtooth removes of the weighted squares of local delays, beyond a constant
    and a straight line in time, over the scatter that is left.
    """

    phase: float
    rate: float
    age: float
    clear: float


def residual_beats(fit: Fit, experiments: Sequence[Experiment]) -> list[Beat | None]:
    """Return of each record the beat in its residual's local delay, None where none is clear.

    Where the reading is the displacement at `t - d(t)`, the residual is `-d v` with the velocity v;
    d is fitted in intervals of time, and to it a sawtooth that jumps at least once.
    """
    found: list[Beat | None] = []
    for k, (e, residual) in enumerate(zip(experiments, fit.residuals_of(experiments), strict=True)):
        used = e.used[: e.stop]
        time = e.record.time[: e.stop][used] - e.record.time[0]
        shown = measured(e.record)[: e.stop][used]
        found.append(beat_of(time, shown - residual - fit.offset(k), residual))
    return found


def beat_of(time: FloatArray, displacement: FloatArray, residual: FloatArray) -> Beat | None:
    """Return the beat in a residual (n,) [m] of a predicted displacement (n,) [m] at times (n,).

    Times [s] count from the record's start, and may have gaps.
    """
    if time.size < _INTERVALS:
        return None
    step = np.diff(time)
    joined = step < 1.5 * np.median(step)
    velocity = (np.diff(displacement) / step)[joined]
    middle = (0.5 * (time[1:] + time[:-1]))[joined]
    left = (0.5 * (residual[1:] + residual[:-1]))[joined]
    if not np.any(velocity):
        return None
    duration = float(time[-1])
    turns = int(np.count_nonzero(np.diff(np.sign(velocity[velocity != 0.0]))))
    most = turns / _REVERSALS / duration
    rates = np.arange(_FINER, _FINER * duration * most + 1) / (_FINER * duration)
    if not rates.size:
        return None
    place = np.minimum((_INTERVALS * middle / duration).astype(np.int64), _INTERVALS - 1)
    weight = np.bincount(place, velocity**2, _INTERVALS).astype(float)
    moved = np.bincount(place, -(left - np.mean(left)) * velocity, _INTERVALS)
    counted = np.maximum(np.bincount(place, minlength=_INTERVALS), 1)
    when = np.bincount(place, middle, _INTERVALS) / counted
    on = weight > 1e-3 * np.mean(weight)
    delays = _Delays(when[on], moved[on] / weight[on], weight[on])
    rate, phase = delays.best(rates, np.arange(_PHASES) / _PHASES)
    steps = np.arange(-_REFINED, _REFINED + 1) / _REFINED
    rate, phase = delays.best(rate + steps / (_FINER * duration), phase + steps / _PHASES)
    return delays.beat(rate, phase)


@dataclass(frozen=True, eq=False)
class _Delays:
    """Local delays (k,) [s] at times (k,) [s], with weights."""

    time: FloatArray
    delay: FloatArray
    weight: FloatArray

    def best(self, rates: FloatArray, phases: FloatArray) -> tuple[float, float]:
        """Return rate and phase of the sawtooth that removes most."""
        removed = np.array([[self._slope(f, p)[1] for p in phases] for f in rates])
        row, column = np.unravel_index(int(np.argmax(removed)), removed.shape)
        return float(rates[row]), float(phases[column])

    def beat(self, rate: float, phase: float) -> Beat | None:
        """Return the beat of that rate, turned so that its age is positive."""
        slope, removed = self._slope(rate, phase)
        total = float(self._without(self.delay) @ self._without(self.delay))
        clear = removed / max((total - removed) / max(self.time.size - 5, 1), 1e-300)
        if clear < _CLEAR:
            return None
        sign = 1.0 if slope > 0 else -1.0  # frac(-p) is 1 - frac(p)
        return Beat(sign * phase % 1.0, sign * rate, abs(slope), clear)

    def _slope(self, rate: float, phase: float) -> tuple[float, float]:
        saw = self._without((phase + rate * self.time) % 1.0)
        power = max(float(saw @ saw), 1e-300)
        along = float(saw @ self._without(self.delay))
        return along / power, along**2 / power

    def _without(self, values: FloatArray) -> FloatArray:
        """Return weighted values (k,) without a constant and a straight line."""
        root = np.sqrt(self.weight / np.max(self.weight))
        line = np.linalg.qr(np.column_stack([root, root * self.time]))[0]
        weighted = root * values
        left: FloatArray = weighted - line @ (line.T @ weighted)
        return left
