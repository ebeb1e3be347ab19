"""The paper's linear part: steps, moments, factors of the denominator."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt
import scipy

from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.notes import Note, note
from psa_casadi.records.noise import high_frequency_noise
from psa_casadi.records.record import Record
from psa_casadi.units import FloatArray

#: How far the voltage may stray from its two levels, and how long the rise may take of the hold.
_LEVEL, _RISE = 0.05, 0.05
#: A turning point stands out by this share of the voltage's range; turns come at even intervals.
_PROMINENCE, _EVEN = 0.05, 1.2
#: The mean over this last share of a step response stands for its steady state.
STEADY_SHARE = 0.05
#: At the start of a loop the voltage counts as its first value within this share of its range.
_AT_REST = 1e-3


@dataclass(frozen=True, eq=False)
class Step:
    """The normalised response to one jump of the voltage that is then held.

    `time` (n,) [s] begins at 0 in the middle of the jump, `g` (n,) is (x - x_0)/(x_s - x_0),
    `volts` the height of the jump [V], `rise` its duration [s], `k` = (x_s - x_0)/volts [m/V].
    """

    name: str
    time: FloatArray
    g: FloatArray
    volts: float
    rise: float
    k: float


@dataclass(frozen=True, eq=False)
class Loop:
    """A periodic voltage and its displacement on a uniform grid, both 0 at their first sample.

    `voltage` (n,) [V] and `displacement` (n,) [m] are counted from the first sample; `turns` are
    the samples at which the voltage turns, `frequency` [Hz] follows from them; `first_volts` [V]
    is the voltage at the first sample as recorded, `missing` counts samples that were bridged.
    """

    name: str
    sample_time: float
    voltage: FloatArray
    displacement: FloatArray
    turns: npt.NDArray[np.int64]
    frequency: float
    first_volts: float
    missing: int


def find_steps(records: Sequence[Record]) -> list[Step]:
    """Return the step responses among the records, the smallest jump first.

    A step has two levels of voltage and a rise between them that takes less than 5 % of the hold.
    """
    found = [s for r in records if (s := _step(r)) is not None]
    return sorted(found, key=lambda s: abs(s.volts))


def find_loops(records: Sequence[Record]) -> list[Loop]:
    """Return the records whose voltage goes up and down at even intervals, the slowest first."""
    found = [loop for r in records if (loop := _loop(r)) is not None]
    return sorted(found, key=lambda loop: loop.frequency)


def _step(record: Record) -> Step | None:
    t, v, x = record.time, record.voltage, measured(record)
    volts = float(np.median(v[record.n // 2 :]) - v[0])
    if abs(volts) < 0.5 * float(np.ptp(v)) or volts == 0.0:
        return None
    share = (v - v[0]) / volts
    high = np.flatnonzero(share > 1.0 - _LEVEL)
    last_low, first_high = int(np.flatnonzero(share < _LEVEL)[-1]), int(high[0])
    rise, hold = float(t[first_high] - t[last_low]), float(t[-1] - t[first_high])
    levels = np.concatenate([share[: last_low + 1], share[first_high:] - 1.0])
    if first_high < last_low or rise > _RISE * hold or np.max(np.abs(levels)) > _LEVEL:
        return None
    between = slice(last_low, first_high + 1)
    middle = t[last_low] + float(np.trapezoid(1.0 - share[between], t[between]))
    valid = record.mask
    before, after = valid & (t <= t[last_low]), valid & (t > middle)
    late = valid & (t > t[-1] - STEADY_SHARE * hold)
    if not before.any() or after.sum() < 20 or not late.any():
        return None
    x_0, x_s = float(np.mean(x[before])), float(np.mean(x[late]))
    if x_s == x_0:
        return None
    g = np.concatenate([[0.0], (x[after] - x_0) / (x_s - x_0)])
    time = np.concatenate([[0.0], t[after] - middle])
    return Step(record.name, time, g, volts, rise, (x_s - x_0) / volts)


def _loop(record: Record) -> Loop | None:
    valid, step = record.mask, record.sample_time
    if valid.sum() < 20:
        return None
    t = np.arange(record.time[0], record.time[-1] + 0.5 * step, step)
    v = np.interp(t, record.time, record.voltage)
    x = np.interp(t, record.time[valid], measured(record)[valid])
    turns = _turns(v)
    half = _half_period(turns, len(v))
    if half is None:
        return None
    moved = np.abs(v - v[0]) > _AT_REST * float(np.ptp(v))
    resting = max(1, int(np.argmax(moved)))
    return Loop(
        name=record.name,
        sample_time=step,
        voltage=v - v[0],
        displacement=x - float(np.mean(x[:resting])),
        turns=turns,
        frequency=1.0 / (2.0 * half * step),
        first_volts=float(v[0]),
        missing=int(record.n - valid.sum()),
    )


def _turns(voltage: FloatArray) -> npt.NDArray[np.int64]:
    """Return the samples at which the voltage turns, those at its ends excepted."""
    prominence = _PROMINENCE * float(np.ptp(voltage))
    peaks = [
        scipy.signal.find_peaks(sign * voltage, prominence=prominence)[0] for sign in (1.0, -1.0)
    ]
    return np.sort(np.concatenate(peaks)).astype(np.int64)


def _half_period(turns: npt.NDArray[np.int64], samples: int) -> float | None:
    """Return the samples between turns, None where the turns are not even or there are none."""
    if turns.size == 0:
        return None
    spacing = np.diff(turns)
    ends = np.array([turns[0], samples - 1 - turns[-1]])
    if spacing.size == 0:
        spacing = ends
    half = float(np.median(spacing))
    even = spacing.max() <= _EVEN * spacing.min() and ends.max() <= _EVEN * half
    return half if even else None


#: The coefficients of eq. (15) in the order in which arrays hold them.
COEFFICIENTS = ("a_1", "a_2", "a_3", "a_4", "a_5", "b_1")
#: The window is cut by this share to see whether the coefficients depend on where it ends.
_CUT = 0.1
#: A coefficient that changes by more than this share with the cut is not an estimate.
_STEADY = 0.05
_OVERSHOOT = 0.01


@dataclass(frozen=True, eq=False)
class LinearPart:
    """Coefficients of eq. (15) [s to s^5, then s] and what is doubtful about them."""

    coefficients: Mapping[str, float]
    notes: tuple[Note, ...]


def linear_part(step: Step) -> LinearPart:
    """Return a_1..a_5, b_1 by the iterated integrals of one step response, and their doubts."""
    found = moment_coefficients(step.time, step.g)
    notes = _dependence(step, found)
    wrong = [name for name, value in zip(COEFFICIENTS, found, strict=True) if not value > 0.0]
    if wrong:
        notes.append(note("signs", names=wrong))
    return LinearPart(dict(zip(COEFFICIENTS, found.tolist(), strict=True)), tuple(notes))


def moment_coefficients(time: FloatArray, g: FloatArray) -> FloatArray:
    """Return a_1..a_5, b_1, shape (6,), of a normalised step response that begins at time 0.

    `time` (n,) [s], `g` (n,) [1]. Exact only if g is free of noise and the window is endless.
    """
    limits = iterated_limits(time, g)
    return coefficients_of_limits(limits)


def iterated_limits(time: FloatArray, g: FloatArray) -> FloatArray:
    """Return K_1..K_6 [s, s^2 ...], shape (6,), eqs. (16), (19), by the trapezoidal rule.

    g_1' = 1 - g,  g_i' = K_(i-1) - g_(i-1),  K_i = lim g_i, for which the last sample stands.
    """
    width = np.diff(time)
    limit, current, limits = 1.0, g, []
    for _ in range(6):
        rest = limit - current
        current = np.concatenate([[0.0], np.cumsum(0.5 * (rest[1:] + rest[:-1]) * width)])
        limit = float(current[-1])
        limits.append(limit)
    return np.array(limits)


def coefficients_of_limits(limits: FloatArray) -> FloatArray:
    """Solve eq. (21) for a_1..a_5, b_1, shape (6,), given K_1..K_6.

    K_1 = a_1 - b_1,  K_i = sum_(j=1..5) (-1)^(j-1) K_(i-j) a_j with K_0 = 1 and K_m = 0 for m < 0.
    Times are counted in units of |K_1| while solving, which keeps the six equations alike in size.
    """
    unit = abs(float(limits[0])) or 1.0
    k = np.concatenate([[1.0], limits / unit ** np.arange(1, 7)])
    matrix = np.zeros((6, 6))
    for i in range(1, 7):
        for j in range(1, min(i, 5) + 1):
            matrix[i - 1, j - 1] = (-1) ** (j - 1) * k[i - j]
    matrix[0, 5] = -1.0
    scaled = np.linalg.lstsq(matrix, k[1:], rcond=None)[0]
    found: FloatArray = scaled * unit ** np.array([1.0, 2.0, 3.0, 4.0, 5.0, 1.0])
    return found


def _dependence(step: Step, found: FloatArray) -> list[Note]:
    """Return a note where the coefficients depend on the end of the window, and why that may be."""
    kept = step.time <= (1.0 - _CUT) * step.time[-1]
    other = moment_coefficients(step.time[kept], step.g[kept])
    change = np.abs(other - found) / np.maximum(np.abs(found), 1e-300)
    worst = int(np.argmax(change))
    if change[worst] <= _STEADY:
        return []
    reasons = _reasons(step) or [("short", 0.0)]
    return [
        note(
            "window",
            name=step.name,
            coefficient=COEFFICIENTS[worst],
            change=change[worst],
            reasons=reasons,
        )
    ]


def _reasons(step: Step) -> list[tuple[str, float]]:
    """Return what keeps the iterated integrals of a step from converging, and of what size it is.

    Truncation: the means of the last two twentieths differ. Noise: the high-frequency noise of the
    last quarter. Ringing: the response passes its steady state by more than 1 %.
    """
    g, n = step.g, len(step.g)
    noise = high_frequency_noise(g[-max(n // 4, 8) :])
    last = max(int(STEADY_SHARE * n), 4)
    drift = abs(float(np.mean(g[-last:]) - np.mean(g[-2 * last : -last])))
    overshoot = float(np.max(g)) - 1.0
    reasons = []
    if drift > max(4.0 * noise / np.sqrt(last), 1e-12):
        reasons.append(("truncated", drift))
    if noise > 1e-9:
        reasons.append(("noise", noise))
    if overshoot > max(_OVERSHOOT, 6.0 * noise):
        reasons.append(("ringing", 100.0 * overshoot))
    return reasons


#: A root counts as real where its imaginary part is below this share of its size.
_REAL = 1e-6
#: The zero that the factors imply may differ from b_1 by this share before a sentence says so.
_ZERO_AGREES = 0.2


@dataclass(frozen=True)
class Factors:
    """One way to read the denominator: tau [s], then m/k [s^2] and c/k [s] of both parts."""

    tau: float
    m_P: float
    c_P: float
    m_B: float
    c_B: float


def mechanics_of(
    coefficients: Mapping[str, float], k_P: float, k_B: float
) -> tuple[dict[str, float], tuple[Note, ...]]:
    """Return tau, m_P, c_P, m_B, c_B (SI), and notes; tau alone where no stack has the roots.

    a_5 s^5 + ... + a_1 s + 1 = (tau s + 1) (m_P/k_P s^2 + c_P/k_P s + 1) (m_B/k_B s^2 + ...).
    A real root gives tau, the other four make two pairs. Where several readings exist (the
    displacement does not tell them apart, but for the zero) the one is taken whose zero,
    (c_B + c_P)/(k_B + k_P), comes nearest to b_1, and of those the one with the longest tau. Where
    a pole does not decay, tau = K_1 = a_1 - b_1, the first line of (21), is all that is left.
    """
    denominator = [coefficients[name] for name in reversed(COEFFICIENTS[:5])]
    if not np.all(np.isfinite(denominator)) or denominator[0] == 0.0:
        return _delay_alone(coefficients), (note("no_a_5"),)
    roots = np.roots([*denominator, 1.0]).astype(np.complex128)
    if np.any(roots.real >= 0.0):
        count = int(np.sum(roots.real >= 0.0))
        return _delay_alone(coefficients), (note("growing_poles", count=count),)
    b_1 = coefficients["b_1"]

    def distance(f: Factors) -> tuple[float, float]:
        off = abs(_zero(f, k_P, k_B) - b_1)
        return round(off / max(abs(b_1), 1e-12), 6), -f.tau

    best = min(readings(roots), key=distance)
    values = {
        "tau": best.tau,
        "m_P": best.m_P * k_P,
        "c_P": best.c_P * k_P,
        "m_B": best.m_B * k_B,
        "c_B": best.c_B * k_B,
    }
    if distance(best)[0] <= _ZERO_AGREES:
        return values, ()
    return values, (note("other_zero", b_1=b_1, nearest=_zero(best, k_P, k_B), ratio=k_P / k_B),)


def readings(roots: npt.NDArray[np.complex128]) -> Iterator[Factors]:
    """Yield every way to split five stable roots into a real one and two pairs with real factors.

    Of five roots of a real polynomial one is real; complex ones stay with their conjugates.
    """
    real = [k for k, r in enumerate(roots) if abs(r.imag) <= _REAL * abs(r)]
    for alone in real:
        rest = [k for k in range(5) if k != alone]
        for pair in combinations(rest, 2):
            other = [k for k in rest if k not in pair]
            one, two = (_pair(roots[list(p)]) for p in (pair, other))
            if one is not None and two is not None:
                yield Factors(float(-1.0 / roots[alone].real), *one, *two)


def _pair(roots: npt.NDArray[np.complex128]) -> tuple[float, float] | None:
    """Return (m/k, c/k) of (s - s_1)(s - s_2) = 0, None where that is no real polynomial."""
    product, total = roots[0] * roots[1], roots[0] + roots[1]
    size = float(np.max(np.abs(roots)))
    if abs(product.imag) > _REAL * size**2 or abs(total.imag) > _REAL * size:
        return None
    return float(1.0 / product.real), float(-total.real / product.real)


def _delay_alone(coefficients: Mapping[str, float]) -> dict[str, float]:
    delay = coefficients["a_1"] - coefficients["b_1"]
    return {"tau": delay} if delay > 0.0 else {}


def _zero(f: Factors, k_P: float, k_B: float) -> float:
    return (f.c_B * k_B + f.c_P * k_P) / (k_B + k_P)
