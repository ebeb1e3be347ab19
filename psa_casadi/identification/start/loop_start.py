"""Starting values of the hysteresis: the paper's formulas (26) to (35) in integrated form.

The paper reads A and delta at the crossings of h and n, beta, gamma from logarithms of velocities.
Noise spoils velocities, and h must cross zero. Integrated over time, eq. (26) needs neither:

    x - x_0 = s (u - u_0) - beta I_1 - gamma I_2 + delta I_3,    s = k + A,
    I_1 = int |h|^(n-1) h |du|,  I_2 = int |h|^n du,  I_3 = int u sgn(u') dt,

with h = h_0 + (x - x_0) - k (u - u_0) from the measured x, so that s, beta, gamma and delta follow
by linear least squares at given k, n and h_0. Those are searched (variable projection).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.identification.fitting.unknowns import static_compliance
from psa_casadi.identification.start.doubts import static_slope
from psa_casadi.model.compose import Model
from psa_casadi.records.drive import turns
from psa_casadi.records.noise import high_frequency_noise
from psa_casadi.records.record import Record
from psa_casadi.units import FloatArray

#: Loops that take part, samples of each, and how much faster than the slowest they may be.
_LOOPS, _SAMPLES, _FASTER = 4, 2000, 5.0
#: Ranges of n, and of k over the slope of displacement on voltage.
_N, _K = (1.0, 3.0), (0.5, 3.5)
#: k over the slope, and n, from which the search starts.
_STARTS = ((1.1, 1.2), (1.6, 1.2), (2.5, 1.05))
#: How many standard deviations h_0 may be off: the noise at rest, an ordinary hysteresis elsewhere.
_DOUBT = 4.0
#: Least noise over the range: what formulas without lags miss.
_LOOP_FLOOR = 1e-3
#: A sample's voltage counts as held where it moves less than this share of the mean step.
_HELD = 1e-2


@dataclass(frozen=True, eq=False)
class _Loop:
    """Displacement x [m], voltage u [V], both (n,) from the first sample, and what is fixed."""

    x: FloatArray
    u: FloatArray
    steps: FloatArray
    skew: FloatArray
    rests: bool


def loop_start(model: Model, records: Sequence[Record]) -> dict[str, float] | None:
    """Return k_L, A, beta, gamma [N/V], delta [N/(V.s)] and n of the slowest loops, or None.

    Forces follow from the model's stiffnesses by eq. (14), beta and gamma belong to its h_ref.
    None where no record's voltage turns, or nothing moves. Only where a search begins depends on
    these values, so they may come from all samples, held-out ones too.
    """
    loops = [_loop(r) for r in _slowest(records)]
    slope = abs(static_slope(records))
    level = max((float(np.ptp(loop.x)) for loop in loops), default=0.0)
    if level == 0.0 or slope == 0.0:
        return None
    compliance = static_compliance(model.values)
    size = compliance * model.values["h_ref"]
    noise = max(_LOOP_FLOOR * level, *(high_frequency_noise(loop.x) for loop in loops))
    doubt = np.array([noise if loop.rests else size for loop in loops])

    def parts(theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        return _eliminated(loops, theta[0] * slope, theta[1], theta[2:] * doubt, size)

    def weighted(theta: FloatArray) -> FloatArray:
        return np.concatenate([parts(theta)[1] / noise, theta[2:]])

    low = np.array([_K[0], _N[0], *[-_DOUBT] * len(loops)])
    high = np.array([_K[1], _N[1], *[_DOUBT] * len(loops)])
    none = [0.0] * len(loops)
    found = [
        scipy.optimize.least_squares(weighted, [*start, *none], bounds=(low, high), max_nfev=30)
        for start in _STARTS
    ]
    best = min(found, key=lambda f: float(f.cost)).x
    s, beta, gamma, delta = parts(best)[0]
    k = best[0] * slope
    values = {"k_L": k, "A": s - k, "beta": beta, "gamma": gamma, "delta": delta}
    forces = {n: float(v) / compliance for n, v in values.items()} | {"n": float(best[1])}
    return {n: float(np.clip(v, *model.parameter(n).bounds)) for n, v in forces.items()}


def _eliminated(
    loops: Sequence[_Loop], k: float, n: float, starts: FloatArray, size: float
) -> tuple[FloatArray, FloatArray]:
    """Return s, beta, gamma, delta [m/V, m/(V.s)] and the residual [m] of all loops, stacked."""
    blocks, targets = [], []
    for loop, start in zip(loops, starts, strict=True):
        ratio = (start + loop.x - k * loop.u) / size
        middle = 0.5 * (ratio[1:] + ratio[:-1])
        bend = np.abs(middle) ** n
        turning = np.sign(middle) * bend * np.abs(loop.steps)
        columns = [loop.u, -_integral(turning), -_integral(bend * loop.steps), _integral(loop.skew)]
        blocks.append(np.column_stack([c - np.mean(c) for c in columns]))
        targets.append(loop.x - np.mean(loop.x))
    matrix, target = np.vstack(blocks), np.concatenate(targets)
    scale = np.linalg.norm(matrix, axis=0)
    scale[scale == 0.0] = 1.0
    weights = np.linalg.lstsq(matrix / scale, target, rcond=1e-6)[0] / scale
    return weights, target - matrix @ weights


def _integral(steps: FloatArray) -> FloatArray:
    return np.concatenate([[0.0], np.cumsum(steps)])


def _slowest(records: Sequence[Record]) -> list[Record]:
    """Return the records whose voltage turns, the slowest and those that are not much faster."""
    turning = [r for r in records if r.mask.sum() > 20 and turns(r.voltage)]
    turning.sort(key=_rate)
    return [r for r in turning if _rate(r) <= _FASTER * _rate(turning[0])][:_LOOPS]


def _rate(record: Record) -> float:
    """Mean speed of the voltage [1/s], over its range."""
    travelled = float(np.sum(np.abs(np.diff(record.voltage))))
    return travelled / float(np.ptp(record.voltage)) / record.duration


def _loop(record: Record) -> _Loop:
    """Return a record, averaged in blocks where it has many samples; at rest if it begins so."""
    valid = record.mask
    y = np.interp(record.time, record.time[valid], measured(record)[valid])
    every = -(-record.n // _SAMPLES)
    blocks = record.n // every
    t, u, x = (
        np.mean(values[: blocks * every].reshape(blocks, every), axis=1)
        for values in (record.time, record.voltage, y)
    )
    steps = np.diff(u)
    moving = np.abs(steps) > _HELD * float(np.mean(np.abs(steps)))
    skew = 0.5 * (u[1:] + u[:-1]) * np.sign(steps) * moving * np.diff(t)
    rests = abs(float(u[0])) < 1e-2 * float(np.ptp(u))
    return _Loop(x - x[0], u - u[0], steps, skew, rests)
