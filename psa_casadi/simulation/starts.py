"""The states in which many sets of parameters start on one record, all at once."""

from functools import cache, lru_cache

import casadi as ca
import numpy as np
import numpy.typing as npt

from psa_casadi.model.compose import Model, Structure
from psa_casadi.simulation.start import (
    NEWTON_STEPS,
    Call,
    initial_slope,
    memory_names,
    no_equilibrium,
    start_functions,
)

FloatArray = npt.NDArray[np.float64]

#: Sets that one call of a function takes.
_CHUNK = 1024


def starts_on(
    model: Model, p: FloatArray, nominal: FloatArray, t: FloatArray, u: FloatArray
) -> FloatArray:
    """Return initial states (nx, m) for parameters p (np, m) and inputs u (n, nu) at times t (n,).

    `nominal` (nx, m) are the states' usual sizes. A column has the bits of `start_on` for a model
    with these parameters, in a fraction of its time. Raises PsaError where a set has no
    equilibrium.
    """
    structure = model.structure
    if structure.foreign:
        return np.tile([[s.start] for s in structure.states], p.shape[1])
    rates = np.array([initial_slope(t, column) for column in u.T])
    gains = [model.parameter_names.index(c.gain) for c in model.effects if c.gain]
    x = np.empty((len(structure.states), p.shape[1]))
    for first in range(0, p.shape[1], _CHUNK):
        part = slice(first, first + _CHUNK)
        begin = t[:1], u[0], rates
        x[:, part] = _starts(structure, p[:, part], nominal[:, part], begin, gains)
    return x


def _starts(
    structure: Structure,
    p: FloatArray,
    nominal: FloatArray,
    begin: tuple[FloatArray, FloatArray, FloatArray],
    gains: list[int],
) -> FloatArray:
    """Return what `start_state` does for every column: begin with time, inputs and their rates."""
    sets = p.shape[1]
    settle, rest, moving = _functions(structure, sets)
    time, u, rates = (np.repeat(a[:, None], sets, axis=1) for a in begin)
    deviation = np.zeros((len(memory_names(structure)), sets))
    without = p.copy()
    without[gains] = 0.0  # as there
    every = np.ones(sets, dtype=bool)
    x = np.zeros((len(structure.states), sets), order="F")
    if np.any(p[gains]):
        strong = np.any(p[gains] != 0.0, axis=0)
        _to_rest(_call(settle, time, x, u, without, deviation), x, nominal, strong)
    _to_rest(_call(settle, time, x, u, p, deviation), x, nominal, every)
    settled = x.copy(order="F")
    if any(s.memory and s.settles for s in structure.states):
        _to_rest(_call(rest, time, x, u, p, deviation, settled), x, nominal, every)
    return _call(moving, time, x, u, p, deviation, settled, rates)()[0]


@lru_cache(maxsize=64)
def _functions(structure: Structure, sets: int) -> tuple[ca.Function, ca.Function, ca.Function]:
    """Return the functions of `start_state` for so many columns, the last without derivatives."""
    settle, rest, moving = (f.map(sets) for f in _single(structure))
    return settle, rest, moving


@cache
def _single(structure: Structure) -> tuple[ca.Function, ca.Function, ca.Function]:
    settle, rest, moving = start_functions(structure)
    given = moving.sx_in()
    return settle, rest, ca.Function("start", given, [moving.call(given)[0]])


def _call(function: ca.Function, *given: FloatArray) -> Call:
    """Return a call in place: column by column, as CasADi has its numbers."""
    return Call(function, [np.asfortranarray(a) for a in given])


def _to_rest(
    newton: Call, x: FloatArray, nominal: FloatArray, moves: npt.NDArray[np.bool_]
) -> None:
    """Follow Newton's method from each column of x that moves, in place, to where it ends."""
    moves = moves.copy()
    change = np.where(moves, np.inf, 0.0)
    for _ in range(NEWTON_STEPS):
        new = newton()[0]
        with np.errstate(invalid="ignore"):  # as in start.py
            step = np.max(np.abs(new - x) / (np.abs(new) + nominal), axis=0, initial=0.0)
        change[moves] = step[moves]
        x[:, moves] = new[:, moves]
        moves &= change > 1e-13
        if not moves.any():
            break
    if not (change < 1e-9).all():
        raise no_equilibrium()
