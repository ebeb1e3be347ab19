"""The paper's hysteresis part, eqs. (25) to (35): zero crossings, then logarithmic least squares.

Quasi-static, in displacement units: x = k u + h,
h' = A u' - beta |u'| |h|^(n-1) h - gamma u' |h|^n + delta u sgn(u').
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from psa_casadi.identification.paper.linear import Loop
from psa_casadi.notes import Note, note
from psa_casadi.records.noise import high_frequency_noise
from psa_casadi.units import FloatArray

BoolArray = npt.NDArray[np.bool_]

#: Order of the local polynomial, and its shortest window in samples.
_ORDER, _SHORTEST = 3, 5
#: The window grows until the noise of x' is below this share of the mean speed of the loop,
#: and to this share of a period at most.
_QUIET, _LONGEST = 2e-3, 0.1
#: The noise of x' over what is allowed, beyond which a sentence says so.
_TOO_MUCH = 2.0


@dataclass(frozen=True, eq=False)
class Rates:
    """A loop, smoothed: u [V], u' [V/s], h = x - k u [m], x' [m/s], all (n,).

    `inner` marks samples whose window holds no turn and no end; `branches` are its runs, slices of
    samples on which the voltage goes one way.
    """

    name: str
    k: float
    u: FloatArray
    u_rate: FloatArray
    h: FloatArray
    x_rate: FloatArray
    inner: BoolArray
    branches: tuple[slice, ...]
    notes: tuple[Note, ...]

    def sign(self, branch: slice) -> float:
        """Return 1 on a branch on which the voltage rises, else -1."""
        return float(np.sign(np.mean(self.u_rate[branch])))


def rates_of(loop: Loop, k: float) -> Rates:
    """Differentiate a loop by Savitzky and Golay's filter of third order.

    The window is the shortest odd one with s |c| <= 0.002 * 2 f range(x), where s is the white
    noise of the displacement, c the filter's coefficients, f the loop's frequency; it is a tenth
    of a period at most, and a sentence says where that is not enough. Voltage and displacement
    pass through the same filter, so that what it bends it bends alike.
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
    u, u_rate, x, x_rate = (
        np.asarray(
            scipy.signal.savgol_filter(
                values, window, _ORDER, deriv=derivative, delta=loop.sample_time
            ),
            dtype=np.float64,
        )
        for values in (loop.voltage, loop.displacement)
        for derivative in (0, 1)
    )
    margin = window // 2 + 1
    branches = tuple(
        slice(first + margin, last - margin + 1)
        for first, last in pairwise([0, *loop.turns.tolist(), len(u) - 1])
        if last - first > 2 * margin + 2
    )
    inner = np.zeros(len(u), dtype=np.bool_)
    for branch in branches:
        inner[branch] = True
    notes = (note("rough_velocity", loop=loop.name, share=100.0 * _QUIET * excess),)
    return Rates(
        loop.name, k, u, u_rate, x - k * u, x_rate, inner, branches,
        notes if excess > _TOO_MUCH else (),
    )  # fmt: skip


#: Samples count in (31), (34) where h and |u'| exceed this share of their largest values.
_CLEAR = 0.1
#: A crossing counts above this share of the largest voltage.
_NEAR_REST = 0.05
#: More logarithms of negative numbers than this share are worth a sentence.
_FEW = 0.1
#: Scatter of A_i over the periods, and h at the loop's top, that make k doubtful.
_SCATTER, _CLOSED = 0.1, 0.3


@dataclass(frozen=True)
class Bends:
    """n [1], beta and gamma [m^(1-n)/V] of eq. (26), in displacement units."""

    n: float
    beta: float
    gamma: float


@dataclass(frozen=True)
class HysteresisPart:
    """What the loops tell; None where they tell nothing. A alone stands when n, beta, gamma fail.

    `A` [m/V] and `delta` [m/(V.s)] are those of eq. (30), `bends` n, beta and gamma (35).
    """

    A: float | None = None
    delta: float | None = None
    bends: Bends | None = None
    notes: tuple[Note, ...] = ()


class Crossing(NamedTuple):
    """Voltage [V], u' [V/s] and x' [m/s] where x = k u on one branch."""

    u: float
    u_rate: float
    x_rate: float


class _Line(NamedTuple):
    """Slope and factor of sign e^intercept h^slope, and the share of samples of the other sign."""

    sign: float
    n: float
    mean_log: float
    mean_log_h: float
    lost: float


def hysteresis_part(loops: Sequence[Loop], k: float) -> HysteresisPart:
    """Return A, delta by eqs. (28) to (30), n, beta, gamma by (31) to (35), given k [m/V].

    (34) takes the logarithm of (gamma - beta) h^n. A loop that lags has beta > gamma; then the
    logarithm of (beta - gamma) h^n is taken, which says the same, and a sentence tells it.
    """
    rates = [rates_of(loop, k) for loop in loops]
    notes = [note for r in rates for note in r.notes]
    crossed = [[(r.sign(b), _crossing(r, b)) for b in r.branches] for r in rates]
    pairs = [pair for own in crossed for pair in _periods(own)]
    if not pairs:
        seen = {sign for own in crossed for sign, at in own if at is not None}
        missing = [n for n, sign in (("rising", 1.0), ("falling", -1.0)) if sign not in seen]
        return HysteresisPart(notes=(*notes, note("no_crossing", branches=missing)))
    each = np.array([_slope_and_asymmetry(up, down, k) for up, down in pairs])
    A, delta = (float(v) for v in each.mean(axis=0))
    scatter = float(np.std(each[:, 0]) / max(abs(float(np.mean(each[:, 0]))), 1e-300))
    if scatter > _SCATTER:
        notes.append(note("scatter", share=100.0 * scatter))
    widest = max(rates, key=lambda r: float(np.ptp(r.u)))
    top = int(np.argmax(np.abs(widest.u)))
    share = abs(float(widest.h[top])) / float(np.max(np.abs(widest.h)))
    if share < _CLOSED:  # the loop closes on the line x = k u
        notes.append(note("secant", loop=widest.name, share=100.0 * share))
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
    branches: Sequence[tuple[float, Crossing | None]],
) -> list[tuple[Crossing, Crossing]]:
    """Return each crossing of x = k u on a rising branch with that of the next falling branch.

    Where no rising branch with a crossing is followed by such a falling one, a falling branch is
    paired with the next rising one.
    """
    pairs = [
        (first[0], first[1], then[1])
        for first, then in pairwise(branches)
        if first[0] * then[0] < 0.0 and first[1] is not None and then[1] is not None
    ]
    up_first = [(first, then) for sign, first, then in pairs if sign > 0.0]
    return up_first or [(then, first) for _, first, then in pairs]


def _slope_and_asymmetry(up: Crossing, down: Crossing, k: float) -> tuple[float, float]:
    """Return A_i [m/V] and delta_i [m/(V.s)] of one period, eq. (29).

    x'_+ = (A_i + k) u'_+ + delta_i u_+,  x'_- = (A_i + k) u'_- - delta_i u_-.
    """
    below = up.u_rate * down.u + down.u_rate * up.u
    if below == 0.0:
        return (up.x_rate + down.x_rate) / (up.u_rate + down.u_rate) - k, 0.0
    slope = (up.x_rate * down.u + down.x_rate * up.u) / below
    return slope - k, (up.x_rate * down.u_rate - down.x_rate * up.u_rate) / below


def _crossing(r: Rates, branch: slice) -> Crossing | None:
    """Return the middle one of the crossings on a branch, linear between samples, or None.

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
    pairs = [values[branch][j : j + 2] for values in (r.u, r.u_rate, r.x_rate)]
    return Crossing(*(float(first + share * (then - first)) for first, then in pairs))


def _logarithms(rates: Sequence[Rates], A: float, delta: float, sign: float) -> _Line | None:
    """Fit ln |A - (h' - sign delta u)/u'| = constant + n ln h on rising (+1) or falling branches.

    Eqs. (31) to (34), over samples with h > 0. The sign that most arguments have is taken for all;
    the others are left out. None where fewer than three samples remain.
    """
    h, argument = [np.empty(0)], [np.empty(0)]
    for r in rates:
        largest = float(np.max(np.abs(r.h[r.inner])))
        part: BoolArray = r.inner & (r.h > _CLEAR * largest)
        part &= sign * r.u_rate > _CLEAR * float(np.max(np.abs(r.u_rate)))
        h.append(r.h[part])
        h_rate = r.x_rate[part] - r.k * r.u_rate[part]
        argument.append(A - (h_rate - sign * delta * r.u[part]) / r.u_rate[part])
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
