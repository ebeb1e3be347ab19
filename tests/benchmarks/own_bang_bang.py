"""The bang-bang move of a stack with its hysteresis and creep, on the independent reference.

The linear part's bound knows neither. Between its limits, with five switches, the voltage takes the
six states of the paper's chain from rest to rest, which linear time-optimal control would do too;
here the chain is the nonlinear one. Unknown are the six arcs' lengths and the voltage that holds
afterwards, given are seven equations: electrodes at that voltage, force, positions and velocities
at rest, displacement with creep at the end of the move. No part of the symbolic model is in it.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from psa_casadi import reference
from tests.benchmarks.creeping_reference import crept

FloatArray = npt.NDArray[np.float64]

ARCS = 6
#: Samples of a trajectory, along which creep is summed; lengths of the last arcs at the start of
#: the search over the whole move; evaluations; residual, over the move, that is a solution.
_SAMPLES, _TAIL, _EVALUATIONS, _SOLVED = 200, (0.02, 0.002), 200, 1e-6


@dataclass(frozen=True)
class BangBang:
    """A move between the `limits` [V] from a rest in `initial` states, of which x has crept."""

    values: Mapping[str, float]
    initial: Mapping[str, float]
    begin: float
    end: float
    limits: tuple[float, float]
    upward: bool

    def shortest(self, voltage: FloatArray, length: float) -> float | None:
        """Return the length [s] of the move; None if the search does not settle.

        It starts from the arcs of a `voltage` [V] on equal intervals of a designed move.
        """
        arcs = _arcs(voltage, self.limits, length)
        scale = np.append(np.maximum(arcs / length, 0.01), 0.5)
        start = np.append(arcs / length, voltage[-1] / self._span)
        low = np.append(np.zeros(ARCS), self.limits[0] / self._span)
        high = np.append(np.full(ARCS, np.inf), self.limits[1] / self._span)

        def miss(q: FloatArray) -> FloatArray:
            return self._miss(q[:-1] * length, float(q[-1]) * self._span)

        found = least_squares(
            miss, start, bounds=(low, high), x_scale=scale, diff_step=[1e-5],
            xtol=1e-12, ftol=1e-12, max_nfev=_EVALUATIONS,
        )  # fmt: skip
        solved = float(np.max(np.abs(found.fun))) < 100.0 * _SOLVED
        return float(np.sum(found.x[:-1]) * length) if solved else None

    @property
    def _span(self) -> float:
        return self.limits[1] - self.limits[0]

    def _miss(self, arcs: FloatArray, held: float) -> FloatArray:
        """Return the distances from rest at the end (7,), in percent of the move."""
        p, move = self.values, abs(self.end - self.begin)
        ends = np.cumsum(np.maximum(arcs, 1e-12))
        time = np.unique(np.concatenate([[0.0], ends, np.linspace(0.0, ends[-1], _SAMPLES)]))

        def voltage(t: float) -> float:
            arc = min(int(np.searchsorted(ends, t, side="right")), ARCS - 1)
            return self.limits[int((arc % 2 == 0) == self.upward)]

        found = reference.simulate(
            p, voltage, time, initial=self.initial, breakpoints=ends[:-1].tolist(), rtol=1e-9
        )
        s = {n: float(v[-1]) for n, v in found.states.items()}
        shown = float(crept(p, time, found.displacement)[-1])
        force = p["k_L"] * p["G"] * held + s["f_H"]
        y, x = force / p["k_P"], force * (1.0 / p["k_P"] + 1.0 / p["k_B"])
        w_p, w_b = np.sqrt(p["k_P"] / p["m_P"]), np.sqrt(p["k_B"] / p["m_B"])
        positions = [s["y"] - y, s["x"] - x, shown - self.end, s["v_y"] / w_p, s["v_x"] / w_b]
        electric = (s["u"] - p["G"] * held) / self._span
        mechanic = (s["f_out"] - force) * (1.0 / p["k_P"] + 1.0 / p["k_B"]) / move
        return 100.0 * np.array([electric, mechanic, *(d / move for d in positions)])


def _arcs(voltage: FloatArray, limits: tuple[float, float], length: float) -> FloatArray:
    """Return the lengths [s] of the first four arcs of a designed voltage, and two short ones."""
    high = voltage > 0.5 * sum(limits)
    switches = np.flatnonzero(np.diff(high.astype(int))) + 1
    edges = np.concatenate([[0], switches, [high.size]]) / high.size
    seen = np.diff(edges)[: ARCS - len(_TAIL)]
    rest = np.full(ARCS - len(_TAIL) - len(seen), _TAIL[0])
    return length * np.concatenate([seen, rest, _TAIL])
