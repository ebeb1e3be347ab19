"""The states in which many sets of parameters start on one record, all at once."""

from functools import cache

import casadi as ca
import numpy as np
import numpy.typing as npt

from psa_casadi.model.compose import Model, Structure
from psa_casadi.simulation.start import (
    NEWTON_STEPS,
    initial_slope,
    memory_names,
    no_equilibrium,
    start_functions,
)

FloatArray = npt.NDArray[np.float64]


def starts_on(
    model: Model, p: FloatArray, nominal: FloatArray, t: FloatArray, u: FloatArray
) -> FloatArray:
    """Return initial states (nx, m) for parameters p (np, m) and inputs u (n, nu) at times t (n,).

    `nominal` (nx, m) are the states' usual sizes. A column has the bits of `start_on` for a model
    with these parameters, in a tenth of its time. Raises PsaError where a set has no equilibrium.
    """
    structure = model.structure
    sets = p.shape[1]
    if structure.foreign:
        return np.tile([[s.start] for s in structure.states], sets)
    settle, rest, moving = _functions(structure)
    rates = np.array([[initial_slope(t, column)] for column in u.T]).reshape(-1, 1)
    where = (t[:1, None], u[:1].T)
    deviation = np.zeros((len(memory_names(structure)), 1))
    gains = [model.parameter_names.index(c.gain) for c in model.effects if c.gain]
    without = p.copy()
    without[gains] = 0.0  # as in `start_state`
    x = np.zeros((len(structure.states), sets))
    strong = np.any(p[gains] != 0.0, axis=0)
    x[:, strong] = _at_rest(
        settle, x[:, strong], nominal[:, strong], (*where, without[:, strong], deviation)
    )
    settled = _at_rest(settle, x, nominal, (*where, p, deviation))
    x = settled
    if any(s.memory and s.settles for s in structure.states):
        x = _at_rest(rest, settled, nominal, (*where, p, deviation, settled))
    return _columns(moving, x, (*where, p, deviation, settled, rates))


@cache
def _functions(structure: Structure) -> tuple[ca.Function, ca.Function, ca.Function]:
    """Return the functions of `start_state`, of the motion without its derivatives."""
    settle, rest, moving = start_functions(structure)
    given = moving.sx_in()
    return settle, rest, ca.Function("start", given, [moving.call(given)[0]])


def _columns(function: ca.Function, x: FloatArray, where: tuple[FloatArray, ...]) -> FloatArray:
    """Return a function of time, states x (nx, m) and the rest; what has one column is for all."""
    return np.asarray(function(where[0], x, *where[1:]), dtype=np.float64)


def _at_rest(
    newton: ca.Function, x: FloatArray, nominal: FloatArray, where: tuple[FloatArray, ...]
) -> FloatArray:
    """Return where Newton's method leads from each column; one that is there stays."""
    x = x.copy()
    change = np.full(x.shape[1], np.inf)
    moves = np.ones(x.shape[1], dtype=bool)
    for _ in range(NEWTON_STEPS if x.size else 0):
        new = _columns(newton, x, where)
        with np.errstate(invalid="ignore"):  # as in start.py
            step = np.max(np.abs(new - x) / (np.abs(new) + nominal), axis=0, initial=0.0)
        change[moves] = step[moves]
        x[:, moves] = new[:, moves]
        moves &= change > 1e-13
        if not moves.any():
            break
    if x.size and not (change < 1e-9).all():
        raise no_equilibrium()
    return x
