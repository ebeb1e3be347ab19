"""Hysteresis by differential equations and by play operators: voltage in, voltage out [V].

Each function takes the voltage (M,) and the history, the voltages that a stack turned at before the
record starts; the last of them is the record's first voltage.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RectBivariateSpline

from tests.studies.exam.record import Floats

History = Sequence[float]


def bouc_wen(
    u: Floats, history: History, values: tuple[float, float, float, float, float], step: float
) -> Floats:
    """Bouc-Wen with a term of the voltage's direction, R = u + h.

    h' = A u' - beta |u'| |h|^(n-1) h - gamma u' |h|^n + delta u sgn(u'), by the midpoint rule over
    the voltage. `values`: A, beta, gamma, n, delta. Source: Y. K. Wen, J. Eng. Mech. 102 (1976)
    249; T. S. Low, W. Guo, J. Microelectromech. Syst. 4 (1995) 230.
    """
    A, beta, gamma, n, delta = values

    def slope(h: float, du: float) -> float:
        power = math.pow(abs(h), n - 1)
        return A * du - beta * abs(du) * power * h - gamma * du * power * abs(h)

    def moved(h: float, du: float) -> float:
        return h + slope(h + slope(h, du) / 2, du)

    h = 0.0
    for a, b in itertools.pairwise(approach(history, 200).tolist()):
        h = moved(h, b - a)
    states = [h]
    for a, b in itertools.pairwise(u.tolist()):
        h = moved(h, b - a)
        if delta:
            h += delta * b * float(np.sign(b - a)) * step
        states.append(h)
    return np.asarray(u + np.array(states))


def relays(
    u: Floats, history: History, limits: tuple[float, float], rng: np.random.Generator
) -> Floats:
    """Return 0.7 u plus the mean of 900 relays of random thresholds.

    A relay switches up at m + w/2 and down at m - w/2. Source: I. D. Mayergoyz, "Mathematical
    Models of Hysteresis", ch. 1, whose integral is a sum here.
    """
    count, share, span = 900, 0.3, limits[1] - limits[0]
    width = rng.exponential(0.13, count).clip(0, 0.9) * span
    middle = limits[0] + span * rng.beta(1.6, 1.6, count)
    up, down = middle + width / 2, middle - width / 2
    state = np.where(rng.random(count) < 0.5, 1.0, -1.0)
    before = approach(history, 50)
    means = relay_means(np.concatenate((before, u)), up, down, state)
    return (1 - share) * u + share * means[before.size :] * span / 2


def relay_means(path: Floats, up: Floats, down: Floats, state: Floats) -> Floats:
    """Return the mean of relays of thresholds up and down along a path; `state` is moved."""
    means = []
    for x in path.tolist():
        state[x >= up] = 1.0
        state[x <= down] = -1.0
        means.append(state.mean())
    return np.array(means)


def prandtl_ishlinskii(
    u: Floats, history: History, scale: float, step: float, growth: float = 0.0
) -> Floats:
    """Generalised Prandtl-Ishlinskii: 0.66 u plus 12 plays between two different envelopes.

    w_j = max(g_r(u) - r_j, min(g_l(u) + r_j, w_j before)); with `growth` a threshold is r_j +
    growth V ln(1 + |u'|/(2 V)). `scale`: V [V]. Source: M. Al Janaideh, S. Rakheja, C.-Y. Su,
    IEEE/ASME Trans. Mechatronics 16 (2011) 734.
    """
    count, asymmetry = 12, 0.12
    thresholds = np.linspace(0.02, 0.75, count) * scale * 0.5
    weights = np.exp(-np.linspace(0, 2.2, count))
    weights *= 0.34 / weights.sum()
    before = approach(history, 120)
    path = np.concatenate((before, u))
    right = path + asymmetry * scale * np.tanh((path / scale - 0.55) * 1.5) * 0.5
    left = path + asymmetry * scale * 0.35 * np.sin(2.2 * path / scale)
    speed = np.zeros(path.size)
    speed[before.size + 1 :] = np.abs(np.diff(u)) / step
    more = growth * scale * np.log1p(speed / (2 * scale))
    plays = np.zeros(count)
    sums = []
    for r, low, high in zip(more.tolist(), right.tolist(), left.tolist(), strict=True):
        plays = np.maximum(low - (thresholds + r), np.minimum(high + (thresholds + r), plays))
        sums.append(float(weights @ plays))
    return np.asarray(0.66 * u + np.array(sums[before.size :]))


def coleman_hodgdon(u: Floats, history: History, scale: float) -> Floats:
    """Coleman-Hodgdon: h' = a |u'| (f(u) - h) + u' g(u), R = 0.75 u + h.

    a = 5.5/V, f = 0.42 V tanh(1.3 (u/V - 0.1)), g = 0.14 (1 + cos(2 u/V)/2), exact for f and g
    constant within a step. Source: B. D. Coleman, M. L. Hodgdon, Int. J. Eng. Sci. 24 (1986) 897.
    """
    before = approach(history, 300)
    path = np.concatenate((before, u))
    middle, increments = (path[1:] + path[:-1]) / 2, np.diff(path)
    target = 0.42 * scale * np.tanh(1.3 * (middle / scale - 0.1))
    drift = 0.14 * (1 + 0.5 * np.cos(2 * middle / scale)) * increments
    kept = np.exp(-5.5 / scale * np.abs(increments))
    h = float(0.42 * scale * np.tanh(1.3 * (path[0] / scale - 0.1)))
    states = [h]
    for f, k, g in zip(target.tolist(), kept.tolist(), drift.tolist(), strict=True):
        h = f + (h - f) * k + g
        states.append(h)
    return np.asarray(0.75 * u + np.array(states[before.size :]))


def duhem(u: Floats, history: History, scale: float) -> Floats:
    """Duhem: h' = f_1(u, h) u' on the way up, f_2(u, h) u' on the way down; R = 0.8 u + h.

    Source: A. Visintin, "Differential Models of Hysteresis".
    """
    before = approach(history, 300)
    path = np.concatenate((before, u)).tolist()
    h = 0.0
    states = [h]
    for a, b in itertools.pairwise(path):
        y = b / scale
        if b > a:
            h += (b - a) * (0.13 + 4.8 / scale * (0.30 * b / (1 + 0.35 * abs(y)) - h))
        else:
            h += (b - a) * (0.15 - 3.6 / scale * (0.27 * b / (1 + 0.15 * abs(y)) - h))
        states.append(h)
    return np.asarray(0.8 * u + np.array(states[before.size :]))


def approach(history: History, count: int) -> Floats:
    """Return the way through the voltages of a history, `count` points for each leg."""
    legs = [np.linspace(a, b, count) for a, b in itertools.pairwise(history)]
    return np.concatenate(legs)


_CELLS = 240


@dataclass(frozen=True)
class Density:
    """A density by its Everett function between two voltages, and its share of the stroke."""

    low: float
    high: float
    share: float
    everett: RectBivariateSpline

    def swept(self, a: float, b: float) -> float:
        """Return E(a, b), 0 where a is not above b."""
        return float(self.everett.ev([a], [b])[0]) if a > b else 0.0


def draw_density(limits: tuple[float, float], rng: np.random.Generator) -> Density:
    """Draw a density: exponential in the width of a loop, a bell in its middle, and a ridge."""
    margin = 0.02 * (limits[1] - limits[0])
    low, high = limits[0] - margin, limits[1] + margin
    span, grid = high - low, np.linspace(low, high, _CELLS)
    up, down = np.meshgrid(grid, grid, indexing="ij")
    width, middle = (up - down) / span, (up + down) / 2
    centre = (low + high) / 2 + rng.uniform(-0.1, 0.15) * span
    density = np.exp(-width / rng.uniform(0.10, 0.18))
    density *= 1 + 0.8 * np.exp(-(((middle - centre) / (0.3 * span)) ** 2))
    density += 0.12 * np.exp(-(((width - 0.5) / 0.3) ** 2))
    density[up < down] = 0.0
    above = np.cumsum(density[:, ::-1], axis=1)[:, ::-1]
    swept = np.where(up >= down, np.cumsum(above, axis=0), 0.0)
    share = float(rng.uniform(0.30, 0.40))
    everett = RectBivariateSpline(grid, grid, swept / swept[-1, 0] * span, kx=1, ky=1)
    return Density(low, high, share, everett)


def preisach(u: Floats, history: History, density: Density) -> Floats:
    """Preisach hysteresis of a continuous density, by its Everett function.

        E(a, b) = integral of the density over b <= beta <= alpha <= a
        y = y_r + E(u, u_r) on the way up, y_r - E(u_r, u) on the way down

    (u_r, y_r): the last reversal that is not wiped out; the output is centred and has a part
    without hysteresis. Source: D. H. Everett, Trans. Faraday Soc. 51 (1955) 1551; I. D. Mayergoyz,
    "Mathematical Models of Hysteresis", ch. 1.
    """
    way = np.clip(np.concatenate((np.array(history), u)), density.low, density.high)
    base, sign, upper, lower = _branches(way, density)
    out = base + sign * density.everett.ev(upper, lower) * (upper > lower)
    centred = out[len(history) :] - (density.high - density.low) / 2
    return np.asarray((1 - density.share) * u + 1.6 * density.share * centred)


def _branches(way: Floats, density: Density) -> tuple[Floats, Floats, Floats, Floats]:
    """Return y_r, the direction, and the two arguments of the Everett function along a way."""
    memory = [(density.low, 0.0)]
    direction, last = 1.0, density.low
    rows = []
    for x in way.tolist():
        if (x - last) * direction < 0:
            start, level = memory[-1]
            upper, lower = max(last, start), min(last, start)
            memory.append((last, level + direction * density.swept(upper, lower)))
            direction = -direction
        while len(memory) >= 3 and direction * (x - memory[-2][0]) >= 0:
            del memory[-2:]
        start, level = memory[-1]
        rows.append((level, direction, *((x, start) if direction > 0 else (start, x))))
        last = x
    base, sign, upper_arguments, lower_arguments = np.array(rows).T
    return base, sign, upper_arguments, lower_arguments
