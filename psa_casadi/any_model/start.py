"""The state at the start of an experiment: that of the own physics is searched, effects rest there.

x_0 = declared start + deviation for the states of the own equations and for memories; what is left,
filters of effects, starts where it would rest: g(x_s, x_0, u_0, p) = 0 with g its rates.
"""

from dataclasses import dataclass
from functools import cache

import casadi as ca
import numpy as np
import numpy.typing as npt

from psa_casadi.model.compose import Model, Structure
from psa_casadi.simulation.stepper import SimulationError

FloatArray = npt.NDArray[np.float64]

_NEWTON_STEPS = 8


@dataclass(frozen=True)
class Begun:
    """Initial state (nx,), its derivatives by parameters (nx, np) and by deviations (nx, nx)."""

    x: FloatArray
    by_parameter: FloatArray
    by_state: FloatArray


def searched_states(structure: Structure) -> tuple[str, ...]:
    """Return the states whose start is searched: those of the own equations, and memories."""
    resting = resting_states(structure)
    return tuple(s.name for s in structure.states if s.name not in resting)


def resting_states(structure: Structure) -> tuple[str, ...]:
    """Return the states of effects that start where they would rest."""
    effects = [c for c in structure.components if c.gain is not None]
    return tuple(s.name for c in effects for s in c.states if not s.memory)


def start_of(model: Model, inputs: FloatArray, deviations: dict[str, float]) -> Begun:
    """Return the start for the first inputs (nu,) and deviations from the declared starts."""
    s = model.structure
    x = np.array([q.start + deviations.get(q.name, 0.0) for q in s.states])
    p, nx = model.parameter_vector(), len(s.states)
    by_p, by_x = np.zeros((nx, len(p))), np.eye(nx)
    resting = [k for k, q in enumerate(s.states) if q.name in resting_states(s)]
    if not resting:
        return Begun(x, by_p, by_x)
    rest = _rest(s)
    for _ in range(_NEWTON_STEPS):
        rates, slopes, _ = (np.array(a) for a in rest(0.0, x, inputs, p))
        move = np.linalg.lstsq(slopes[:, resting], -rates[:, 0], rcond=None)[0]
        x[resting] += move
        if np.max(np.abs(move) / np.maximum(np.abs(x[resting]), 1e-9)) < 1e-12:
            break
    _, slopes, by_parameter = (np.array(a) for a in rest(0.0, x, inputs, p))
    if not np.isfinite(x).all():
        raise SimulationError("The effects' states have no rest at the start; change the values.")
    others = [k for k in range(nx) if k not in resting]
    own = np.linalg.pinv(slopes[:, resting])
    by_p[resting] = -own @ by_parameter
    by_x[np.ix_(resting, others)] = -own @ slopes[:, others]
    by_x[np.ix_(resting, resting)] = 0.0
    return Begun(x, by_p, by_x)


@cache
def _rest(structure: Structure) -> ca.Function:
    """Casadi function (t, x, u, p) -> rates of the resting states, their slopes by x and by p."""
    names = resting_states(structure)
    rows = [k for k, s in enumerate(structure.states) if s.name in names]
    rates = structure.xdot[rows]
    return ca.Function(
        "rest",
        [structure.time, structure.x, structure.u, structure.p],
        [rates, *(ca.densify(structure.jacobian(rates, by)) for by in (structure.x, structure.p))],
    )
