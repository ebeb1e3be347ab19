"""The paper's identification, section 3: moments of a step, zero crossings of loops.

Source: Yang and Zhu 2015. The linear part comes from the response to a step, eqs. (15) to (21); the
hysteresis, eqs. (25) to (35), from loops below 1 Hz: zero crossings, then logarithmic least
squares. It is quasi-static, in displacement units: x = k u + h,
h' = A u' - beta |u'| |h|^(n-1) h - gamma u' |h|^n + delta u sgn(u').
The paper knows no drive: the voltage of the record, which is the command, is taken for the stack's
voltage, so that a slow amplifier counts as creep and mechanics.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np
import scipy

from psa_casadi.common.errors import InputError, PsaError
from psa_casadi.common.notes import Note, note, texts
from psa_casadi.common.units import BoolArray, ComplexArray, FloatArray, IndexArray
from psa_casadi.identification.determinacy import determinacy
from psa_casadi.identification.fitting.fit import fit
from psa_casadi.identification.fitting.unknowns import static_compliance
from psa_casadi.identification.identify import StackIdentification, with_provenance
from psa_casadi.identification.refitting import noise_levels
from psa_casadi.identification.start.ordinary import ordinary_values, starting_model
from psa_casadi.model.compose import Model
from psa_casadi.records.drive import reversals
from psa_casadi.records.noise import high_frequency_noise
from psa_casadi.records.record import Record
from psa_casadi.records.split import whole

#: How far the voltage may stray from its two levels, and how long the rise may take of the hold.
_LEVEL, _RISE = 0.05, 0.05
#: The prominence of a turning point over the voltage's range; turns come at even intervals.
_PROMINENCE, _EVEN = 0.05, 1.2
#: The mean over this last share of a step response is taken for its steady state.
STEADY_SHARE = 0.05
#: At the start of a loop the voltage counts as its first value within this share of its range.
_AT_REST = 1e-3


@dataclass(frozen=True, eq=False)
class Step:
    """The normalised response to one jump of the voltage that is then held.

    `time` (n,) [s] is 0 in the middle of the jump, `g` (n,) is (x - x_0)/(x_s - x_0),
    `volts` the height of the jump [V], `k` = (x_s - x_0)/volts [m/V].
    """

    name: str
    time: FloatArray
    g: FloatArray
    volts: float
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
    turns: IndexArray
    frequency: float
    first_volts: float
    missing: int


def find_steps(records: Sequence[Record]) -> list[Step]:
    """Return the step responses among the records, the smallest jump first.

    A step has two levels of voltage and a rise between them that takes less than 5 % of the hold.
    """
    return sorted((s for r in records if (s := _step_of(r))), key=lambda s: abs(s.volts))


def find_loops(records: Sequence[Record]) -> list[Loop]:
    """Return the records whose voltage goes up and down at even intervals, the slowest first."""
    return sorted((loop for r in records if (loop := _loop_of(r))), key=lambda o: o.frequency)


def _step_of(record: Record) -> Step | None:
    t, v, x = record.time, record.voltage, record.measured
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
    return Step(record.name, time, g, volts, (x_s - x_0) / volts)


def _loop_of(record: Record) -> Loop | None:
    valid, step = record.mask, record.sample_time
    if valid.sum() < 20:
        return None
    t = np.arange(record.time[0], record.time[-1] + 0.5 * step, step)
    v = np.interp(t, record.time, record.voltage)
    x = np.interp(t, record.time[valid], record.measured[valid])
    turns = reversals(v, _PROMINENCE * float(np.ptp(v)))
    if turns.size == 0:
        return None
    ends = np.array([turns[0], len(v) - 1 - turns[-1]])
    spacing = np.diff(turns) if turns.size > 1 else ends
    half = float(np.median(spacing))  # samples between two turns
    if spacing.max() > _EVEN * spacing.min() or ends.max() > _EVEN * half:
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


#: The coefficients of eq. (15) in the order in which arrays hold them.
COEFFICIENTS = ("a_1", "a_2", "a_3", "a_4", "a_5", "b_1")
#: The window is cut by this share to see whether the coefficients depend on where it ends.
_CUT = 0.1
#: A coefficient that changes by more than this share with the cut is not an estimate.
_STEADY = 0.05
_OVERSHOOT = 0.01


def linear_part(step: Step) -> tuple[dict[str, float], list[Note]]:
    """Return a_1..a_5 [s to s^5], b_1 [s], eq. (15), of one step response, and their doubts.

    They follow from its iterated integrals.
    """
    values = moment_coefficients(step.time, step.g)
    kept = step.time <= (1.0 - _CUT) * step.time[-1]
    other = moment_coefficients(step.time[kept], step.g[kept])
    change = np.abs(other - values) / np.maximum(np.abs(values), 1e-300)
    worst, notes = int(np.argmax(change)), []
    if change[worst] > _STEADY:
        reasons, name = _reasons(step) or [("short", 0.0)], COEFFICIENTS[worst]
        notes.append(
            note("window", name=step.name, coefficient=name, change=change[worst], reasons=reasons)
        )
    wrong = [name for name, value in zip(COEFFICIENTS, values, strict=True) if not value > 0.0]
    notes += [note("signs", names=wrong)] if wrong else []
    return dict(zip(COEFFICIENTS, values.tolist(), strict=True)), notes


def moment_coefficients(time: FloatArray, g: FloatArray) -> FloatArray:
    """Return a_1..a_5, b_1, shape (6,), of a normalised step response that starts at time 0.

    `time` (n,) [s], `g` (n,) [1]; exact only if g is free of noise and the window is endless. By
    K_1..K_6, eqs. (16), (19), with the trapezoidal rule: g_1' = 1 - g,  g_i' = K_(i-1) - g_(i-1),
    K_i = lim g_i, for which the last sample is taken.
    """
    limit, current, limits = 1.0, g, []
    for _ in range(6):
        current = scipy.integrate.cumulative_trapezoid(limit - current, time, initial=0)
        limit = float(current[-1])
        limits.append(limit)
    return coefficients_of_limits(np.array(limits))


def coefficients_of_limits(limits: FloatArray) -> FloatArray:
    """Solve eq. (21) for a_1..a_5, b_1, shape (6,), from K_1..K_6.

    K_1 = a_1 - b_1,  K_i = sum_(j=1..5) (-1)^(j-1) K_(i-j) a_j with K_0 = 1 and K_m = 0 for m < 0.
    Times are counted in units of |K_1| while solving, so that the six equations have similar sizes.
    """
    unit = abs(float(limits[0])) or 1.0
    k = np.concatenate([[1.0], limits / unit ** np.arange(1, 7)])
    matrix = scipy.linalg.toeplitz(k[:6], np.zeros(6)) * (-1.0) ** np.arange(6)
    matrix[:, 5] = [-1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    scaled = np.linalg.lstsq(matrix, k[1:], rcond=None)[0]
    values: FloatArray = scaled * unit ** np.array([1.0, 2.0, 3.0, 4.0, 5.0, 1.0])
    return values


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
    reasons = (
        ("truncated", drift, drift > max(4.0 * noise / np.sqrt(last), 1e-12)),
        ("noise", noise, noise > 1e-9),
        ("ringing", 100.0 * overshoot, overshoot > max(_OVERSHOOT, 6.0 * noise)),
    )
    return [(name, size) for name, size, counts in reasons if counts]


#: What the factors of the denominator stand for.
_FACTORS = ("tau", "m_P", "c_P", "m_B", "c_B")
#: A root counts as real where its imaginary part is below this share of its size.
_REAL = 1e-6
#: The zero that the factors imply may differ from b_1 by this share without a note.
_ZERO_AGREES = 0.2


def mechanics_of(
    coefficients: Mapping[str, float], k_P: float, k_B: float
) -> tuple[dict[str, float], tuple[Note, ...]]:
    """Return tau, m_P, c_P, m_B, c_B (SI), and notes; tau alone where no stack has the roots.

    a_5 s^5 + ... + a_1 s + 1 = (tau s + 1) (m_P/k_P s^2 + c_P/k_P s + 1) (m_B/k_B s^2 + ...).
    A real root gives tau, the other four make two pairs. Where several readings exist (the
    displacement does not separate them, but for the zero) the one is taken whose zero,
    (c_B + c_P)/(k_B + k_P), comes nearest to b_1, and of those the one with the longest tau. Where
    a pole does not decay, tau = K_1 = a_1 - b_1, the first line of (21), is all that is left.
    """
    delay, b_1 = coefficients["a_1"] - coefficients["b_1"], coefficients["b_1"]
    alone = {"tau": delay} if delay > 0.0 else {}
    denominator = [coefficients[name] for name in reversed(COEFFICIENTS[:5])]
    if not np.all(np.isfinite(denominator)) or denominator[0] == 0.0:
        return alone, (note("no_a_5"),)
    roots = np.roots([*denominator, 1.0]).astype(np.complex128)
    if np.any(roots.real >= 0.0):
        count = int(np.sum(roots.real >= 0.0))
        return alone, (note("growing_poles", count=count),)
    stiffness = np.array([1.0, k_P, k_P, k_B, k_B])
    ranked = []
    for factors in readings(roots):
        values = dict(zip(_FACTORS, stiffness * factors, strict=True))
        zero = (values["c_B"] + values["c_P"]) / (k_B + k_P)
        off = round(abs(zero - b_1) / max(abs(b_1), 1e-12), 6)
        ranked.append((off, -values["tau"], zero, values))
    off, _, zero, best = min(ranked, key=lambda r: r[:2])
    if off <= _ZERO_AGREES:
        return best, ()
    return best, (note("other_zero", b_1=b_1, nearest=zero, ratio=k_P / k_B),)


def readings(roots: ComplexArray) -> Iterator[tuple[float, ...]]:
    """Yield tau, m_P/k_P, c_P/k_P, m_B/k_B, c_B/k_B for every way to split five stable roots.

    Into a real one and two pairs with real factors; of five roots of a real polynomial one is real,
    and complex ones stay with their conjugates.
    """
    for alone in (k for k, r in enumerate(roots) if abs(r.imag) <= _REAL * abs(r)):
        rest = [k for k in range(5) if k != alone]
        for pair in combinations(rest, 2):
            other = [k for k in rest if k not in pair]
            one, two = (_pair(roots[list(p)]) for p in (pair, other))
            if one is not None and two is not None:
                yield float(-1.0 / roots[alone].real), *one, *two


def _pair(roots: ComplexArray) -> tuple[float, float] | None:
    """Return (m/k, c/k) of (s - s_1)(s - s_2) = 0, None where that is no real polynomial."""
    product, total = roots[0] * roots[1], roots[0] + roots[1]
    size = float(np.max(np.abs(roots)))
    if abs(product.imag) > _REAL * size**2 or abs(total.imag) > _REAL * size:
        return None
    return float(1.0 / product.real), float(-total.real / product.real)


#: Order of the local polynomial, and its shortest window in samples.
_ORDER, _SHORTEST = 3, 5
#: The window grows until the noise of x' is below this share of the mean speed of the loop,
#: and to this share of a period at most.
_QUIET, _LONGEST = 2e-3, 0.1
#: The noise of x' over what is allowed, beyond which there is a note.
_TOO_MUCH = 2.0


class Rates(NamedTuple):
    """A loop, smoothed: u [V], u' [V/s], h = x - k u [m], h' [m/s], all (n,).

    `branches` are slices of samples on which the voltage goes one way and whose windows hold no
    turn and no end; each with 1 where the voltage rises, else -1.
    """

    u: FloatArray
    u_rate: FloatArray
    h: FloatArray
    h_rate: FloatArray
    branches: list[tuple[float, slice]]


def rates_of(loop: Loop, k: float) -> tuple[Rates, list[Note]]:
    """Differentiate a loop by Savitzky and Golay's filter of third order.

    The window is the shortest odd one with s |c| <= 0.002 * 2 f range(x), where s is the white
    noise of the displacement, c the filter's coefficients, f the loop's frequency; it is a tenth
    of a period at most, with a note if that is not enough. Voltage and displacement pass through
    the same filter, which distorts both equally.
    """
    period = 1.0 / (loop.frequency * loop.sample_time)
    longest = max(_SHORTEST, int(_LONGEST * period) // 2 * 2 - 1)
    allowed = _QUIET * 2.0 * loop.frequency * float(np.ptp(loop.displacement))
    noise, window = high_frequency_noise(loop.displacement), _SHORTEST
    while True:
        weights = scipy.signal.savgol_coeffs(window, _ORDER, deriv=1, delta=loop.sample_time)
        excess = noise * float(np.linalg.norm(weights)) / allowed
        if excess <= 1.0 or window >= longest:
            break
        window = min(longest, max(window + 2, int(1.2 * window) // 2 * 2 + 1))
    smooth = partial(scipy.signal.savgol_filter, window_length=window, polyorder=_ORDER)
    u, u_rate, h, h_rate = (
        np.asarray(smooth(values, deriv=order, delta=loop.sample_time), dtype=np.float64)
        for values in (loop.voltage, loop.displacement - k * loop.voltage)
        for order in (0, 1)
    )
    margin = window // 2 + 1
    branches = [
        slice(first + margin, last - margin + 1)
        for first, last in pairwise([0, *loop.turns.tolist(), len(u) - 1])
        if last - first > 2 * margin + 2
    ]
    signs = [float(np.sign(np.mean(u_rate[branch]))) for branch in branches]
    rough = note("rough_velocity", loop=loop.name, share=100.0 * _QUIET * excess)
    rates = Rates(u, u_rate, h, h_rate, list(zip(signs, branches, strict=True)))
    return rates, [rough] if excess > _TOO_MUCH else []


#: Samples count in (31), (34) where h and |u'| exceed this share of their largest values.
_CLEAR = 0.1
#: A crossing counts above this share of the largest voltage.
_NEAR_REST = 0.05
#: More logarithms of negative numbers than this share have a note.
_FEW = 0.1
#: Scatter of A_i over the periods, and h at the loop's top, that make k doubtful.
_SCATTER, _CLOSED = 0.1, 0.3


class Bends(NamedTuple):
    """n [1], beta and gamma [m^(1-n)/V] of eq. (26), in displacement units."""

    n: float
    beta: float
    gamma: float


@dataclass(frozen=True)
class HysteresisPart:
    """The hysteresis from the loops; None without any. A remains alone if n, beta, gamma fail.

    `A` [m/V] and `delta` [m/(V.s)] are those of eq. (30), `bends` n, beta and gamma (35).
    """

    A: float | None = None
    delta: float | None = None
    bends: Bends | None = None
    notes: tuple[Note, ...] = ()


class _Line(NamedTuple):
    """Slope and factor of sign e^intercept h^slope, and the share of samples of the other sign."""

    sign: float
    n: float
    mean_log: float
    mean_log_h: float
    lost: float


def hysteresis_part(loops: Sequence[Loop], k: float) -> HysteresisPart:
    """Return A, delta by eqs. (28) to (30), n, beta, gamma by (31) to (35), at k [m/V].

    (34) takes the logarithm of (gamma - beta) h^n. A loop that lags has beta > gamma; then the
    logarithm of (beta - gamma) h^n is taken, which is equivalent, with a note.
    """
    differentiated = [rates_of(loop, k) for loop in loops]
    rates = [r for r, _ in differentiated]
    notes = [note for _, notes in differentiated for note in notes]
    crossed = [[(sign, _crossing(r, b)) for sign, b in r.branches] for r in rates]
    pairs = [pair for branches in crossed for pair in _periods(branches)]
    if not pairs:
        signs = {sign for loop in crossed for sign, at in loop if at is not None}
        missing = [n for n, sign in (("rising", 1.0), ("falling", -1.0)) if sign not in signs]
        return HysteresisPart(notes=(*notes, note("no_crossing", branches=missing)))
    # eq. (29) less k u': h'_+ = A_i u'_+ + delta_i u_+,  h'_- = A_i u'_- - delta_i u_-
    each = np.array([_solved(up, down) for up, down in pairs])
    A, delta = (float(v) for v in each.mean(axis=0))
    scatter = float(np.std(each[:, 0]) / max(abs(float(np.mean(each[:, 0]))), 1e-300))
    if scatter > _SCATTER:
        notes.append(note("scatter", share=100.0 * scatter))
    loop, widest = max(zip(loops, rates, strict=True), key=lambda pair: float(np.ptp(pair[1].u)))
    top = int(np.argmax(np.abs(widest.u)))
    share = abs(float(widest.h[top])) / float(np.max(np.abs(widest.h)))
    if share < _CLOSED:  # the loop closes on the line x = k u
        notes.append(note("secant", loop=loop.name, share=100.0 * share))
    rising, falling = (_logarithms(rates, A, delta, sign) for sign in (1.0, -1.0))
    notes += _lost(rising, "rising", "beta + gamma") + _lost(falling, "falling", "gamma - beta")
    if rising is None or falling is None:
        return HysteresisPart(A=A, delta=delta, notes=tuple(notes))
    n = rising.n
    total, difference = (
        line.sign * float(np.exp(line.mean_log - n * line.mean_log_h)) for line in (rising, falling)
    )
    if falling.sign < 0.0:
        notes.append(note("lagging_loop"))
    bends = Bends(n, 0.5 * (total - difference), 0.5 * (total + difference))
    return HysteresisPart(A, delta, bends, tuple(notes))


def _periods(
    branches: Sequence[tuple[float, FloatArray | None]],
) -> list[tuple[FloatArray, FloatArray]]:
    """Return each crossing of x = k u on a rising branch with that of the next falling branch.

    Where no rising branch with a crossing is followed by such a falling one, a falling branch is
    paired with the next rising one.
    """
    pairs = [
        (sign, at, then)
        for (sign, at), (other, then) in pairwise(branches)
        if sign * other < 0.0 and at is not None and then is not None
    ]
    return [p[1:] for p in pairs if p[0] > 0.0] or [p[:0:-1] for p in pairs]


def _solved(up: FloatArray, down: FloatArray) -> tuple[float, float]:
    """Return A_i [m/V] and delta_i [m/(V.s)] of two crossings (u, u', h'), eq. (29)."""
    below = up[1] * down[0] + down[1] * up[0]
    if below == 0.0:
        return (up[2] + down[2]) / (up[1] + down[1]), 0.0
    slope = (up[2] * down[0] + down[2] * up[0]) / below
    return slope, (up[2] * down[1] - down[2] * up[1]) / below


def _crossing(r: Rates, branch: slice) -> FloatArray | None:
    """Return u, u', h' (3,) at the middle crossing of x = k u, linear between samples, or None.

    Near 0 V none counts: there h is 0 at rest, on either side of the line by noise alone.
    """
    h, u = r.h[branch], np.abs(r.u[branch])
    away = u > _NEAR_REST * float(np.max(np.abs(r.u)))
    where = np.flatnonzero((h[1:] * h[:-1] <= 0.0) & away[1:] & away[:-1])
    if where.size == 0:
        return None
    j = int(where[where.size // 2])
    jump = float(h[j] - h[j + 1])
    share = float(h[j]) / jump if jump else 0.5
    pairs = np.array([values[branch][j : j + 2] for values in (r.u, r.u_rate, r.h_rate)])
    return np.asarray(pairs[:, 0] + share * (pairs[:, 1] - pairs[:, 0]))


def _logarithms(rates: Sequence[Rates], A: float, delta: float, sign: float) -> _Line | None:
    """Fit ln |A - (h' - sign delta u)/u'| = constant + n ln h on rising (+1) or falling branches.

    Eqs. (31) to (34), over samples with h > 0. The sign that most arguments have is taken for all;
    the others are left out. None where fewer than three samples remain.
    """
    h, argument = [np.empty(0)], [np.empty(0)]
    for r in rates:
        inner: BoolArray = np.zeros(len(r.u), dtype=np.bool_)
        for _, branch in r.branches:
            inner[branch] = True
        part: BoolArray = inner & (r.h > _CLEAR * float(np.max(np.abs(r.h[inner]))))
        part &= sign * r.u_rate > _CLEAR * float(np.max(np.abs(r.u_rate)))
        h.append(r.h[part])
        argument.append(A - (r.h_rate[part] - sign * delta * r.u[part]) / r.u_rate[part])
    bend, log_h = np.concatenate(argument), np.log(np.concatenate(h))
    common = 1.0 if np.count_nonzero(bend > 0.0) >= 0.5 * bend.size else -1.0
    good = common * bend > 0.0
    if np.count_nonzero(good) < 3 or np.ptp(log_h[good]) == 0.0:
        return None
    logs = np.log(common * bend[good])
    slope = float(np.polyfit(log_h[good], logs, 1)[0])
    lost = 1.0 - float(np.mean(good))
    return _Line(common, slope, float(np.mean(logs)), float(np.mean(log_h[good])), lost)


def _lost(line: _Line | None, branch: str, what: str) -> list[Note]:
    """Note where (31) or (34) had no samples, or logarithms of numbers of the wrong sign."""
    if line is None:
        return [note("no_samples", branch=branch, what=what)]
    notes = [note("negative_rising")] if branch == "rising" and line.sign < 0.0 else []
    if line.lost > _FEW:
        notes.append(note("wrong_sign", lost=100.0 * line.lost, branch=branch, what=what))
    return notes


#: The paper's loops are slower than this [Hz], and their lag should stay below this angle [rad].
_SLOW, _QUASI_STATIC = 1.0, 0.01


def conditions(
    step: Step | None, loops: Sequence[Loop], linear: Mapping[str, float] | None
) -> list[Note]:
    """Note what the records lack: a step, a loop, loops that are slow, from 0 V, without gaps."""
    notes = [note("no_step", loops=bool(loops))] if step is None else []
    notes += [] if loops else [note("no_loop")]
    if not loops:
        return notes
    frequency = loops[0].frequency
    if frequency > 1.001 * _SLOW:
        notes.append(note("fast_loops", frequency=frequency))
    if linear is not None:
        delay = linear["a_1"] - linear["b_1"]
        angle = 2.0 * np.pi * frequency * delay
        if angle > _QUASI_STATIC:
            notes.append(note("lagging_step", delay=1e3 * delay, angle=angle, frequency=frequency))
    away = [o.name for o in loops if abs(o.first_volts) > 0.02 * float(np.ptp(o.voltage))]
    gaps = [f"{loop.name} ({loop.missing})" for loop in loops if loop.missing]
    notes += [note("not_from_rest", names=away)] if away else []
    notes += [note("bridged", names=gaps)] if gaps else []
    return notes


def in_forces(
    start: Model, k: float | None, coefficients: Mapping[str, float] | None, bend: HysteresisPart
) -> tuple[Model, tuple[str, ...], list[Note]]:
    """Return `start` with all that is identified, k_P and k_B being those of `start`.

    With it the names of the identified parameters, and notes on values out of their bounds.
    k_L = k/C with C = 1/k_P + 1/k_B [m/N]; lag, masses and dampings are factors of the denominator.
    Without a loop f_H is 0; without factors the parts are damped critically, c >= 2 sqrt(k m),
    since nothing is known to ring. A value out of its bounds is refused, n is clipped.
    """
    p = start.values
    compliance = static_compliance(p)
    critical = {f"c_{q}": 2.0 * float(np.sqrt(p[f"k_{q}"] * p[f"m_{q}"])) for q in "PB"}
    still = dict.fromkeys(("A", "beta", "gamma", "delta"), 0.0)
    usual = start.with_values({**still, **{c: max(v, p[c]) for c, v in critical.items()}})
    motion, doubts = (
        ({}, ()) if coefficients is None else mechanics_of(coefficients, p["k_P"], p["k_B"])
    )
    wanted = dict(motion)
    if bend.A is not None and bend.delta is not None and bend.bends is not None:
        # h = C f_H; as eq. (8) is in r = |f_H|/h_ref here, beta becomes beta C^(n-1) h_ref^n
        n, beta, gamma = bend.bends
        unit = compliance ** (n - 1.0) * p["h_ref"] ** n
        wanted |= {"A": bend.A / compliance, "delta": bend.delta / compliance, "n": n}
        wanted |= {"beta": beta * unit, "gamma": gamma * unit}
    if k is not None:
        wanted["k_L"] = k / compliance
    kept, notes = {}, list(doubts)
    for name, value in wanted.items():
        parameter = usual.parameter(name)
        low, high = parameter.bounds
        within = low <= value <= high
        if within or (name == "n" and np.isfinite(value)):
            kept[name] = float(np.clip(value, low, high))
        if not within:
            instead = kept.get(name, usual.values[name])
            notes.append(note("out_of_range", name=name, value=value, instead=instead,
                              unit=parameter.unit, low=low, high=high))  # fmt: skip
    names = tuple(name for name in start.parameter_names if name in kept)
    return usual.with_values(kept), names, notes


#: The part of the rising branch, over the largest voltage, whose slope replaces a step's.
_TIP = (0.8, 0.97)


@dataclass(frozen=True, eq=False)
class PaperIdentification:
    """The result of the paper's method; None where it has none.

    `coefficients` are a_1 [s] to a_5 [s^5] and b_1 [s] of eq. (15), `k` [m/V] is that of eq. (25).
    `model` has all in forces; without a loop its f_H is 0, and what else is not identified has
    ordinary values.
    `identified` names the parameters that the method set; `notes` are what failed or is doubtful.
    """

    coefficients: Mapping[str, float] | None
    k: float | None
    model: Model
    identified: tuple[str, ...]
    notes: tuple[Note, ...]

    @property
    def sentences(self) -> tuple[str, ...]:
        """What failed or is doubtful, in words."""
        return texts(self.notes)


def paper_method(
    records: Sequence[Record], *, stiffness: float | None = None
) -> PaperIdentification:
    """Identify a stack as the paper does: moments of the smallest step, crossings of the loops.

    `stiffness` [N/m] fixes the scale of the forces as in `starting_model`. Of the loops the slowest
    are taken, all amplitudes together. Raises InputError where a record has no displacement.
    """
    steps, loops = find_steps(records), find_loops(records)
    step = steps[0] if steps else None
    linear, doubts = (None, list[Note]()) if step is None else linear_part(step)
    slowest = [loop for loop in loops if loop.frequency < 1.05 * loops[0].frequency]
    k = step.k if step is not None else _slope_at_tip(slowest)
    bend = hysteresis_part(slowest, k) if slowest and k is not None else HysteresisPart()
    model, names, notes = in_forces(starting_model(records, stiffness), k, linear, bend)
    notes = [*doubts, *conditions(step, slowest, linear), *bend.notes, *notes]
    return PaperIdentification(linear, k, model, names, tuple(notes))


def identify_by_paper(
    records: Sequence[Record],
    *,
    stiffness: float | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> StackIdentification:
    """Return the paper's identification with its residuals on all records, as `identify` does.

    Nothing is fitted but each record's memory and offset; so there are no intervals. The warnings
    are the method's sentences. Raises InputError, SimulationError.
    """
    progress("moments and zero crossings")
    paper = paper_method(records, stiffness=stiffness)
    experiments = tuple(whole(r) for r in records)
    sigma, doubts, result = noise_levels(experiments), paper.notes, paper.identified
    progress("the model on all records")
    try:
        best = fit(paper.model, experiments, [], sigma=sigma)
    except InputError:
        raise
    except PsaError:
        usual = paper.model.with_values(ordinary_values(paper.model, records))
        best = fit(usual, experiments, [], sigma=sigma)
        doubts, result = (*doubts, note("runs_away")), ()
    nothing = determinacy(best)
    model = with_provenance(best.model, nothing, records, stiffness is not None)
    notes = (*model.provenance.notes, str(note("paper", names=result)))
    provenance = replace(model.provenance, notes=notes)
    return StackIdentification(
        model=replace(model, provenance=provenance),
        fit=best,
        determinacy=nothing,
        doubts=doubts,
        read_off=result,
    )


def _slope_at_tip(loops: Sequence[Loop]) -> float | None:
    """Return dx/du near the tip of the widest loop's rising branches [m/V], None without loops.

    Where eq. (8) is saturated, h' = 0 and x' = k u'; so it replaces the slope of a step.
    """
    if not loops:
        return None
    widest = max(loops, key=lambda loop: float(np.ptp(loop.voltage)))
    u, x = widest.voltage, widest.displacement
    top = float(u[np.argmax(np.abs(u))])
    outward = np.gradient(u / top) > 0.0
    part = outward & (u / top > _TIP[0]) & (u / top < _TIP[1])
    if part.sum() < 3:
        return None
    return float(np.polyfit(u[part], x[part], 1)[0])
