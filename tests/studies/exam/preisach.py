"""Preisach hysteresis of a continuous density, by its Everett function.

    E(a, b) = integral of the density over b <= beta <= alpha <= a
    y = y_r + E(u, u_r) on the way up, y_r - E(u_r, u) on the way down

(u_r, y_r): the last reversal that is not wiped out. Source: D. H. Everett, Trans. Faraday Soc. 51
(1955) 1551; I. D. Mayergoyz, "Mathematical Models of Hysteresis", ch. 1.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RectBivariateSpline

from tests.studies.exam.hysteresis import History
from tests.studies.exam.record import Floats

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
    """Return the output along a voltage, centred and with a part without hysteresis."""
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
