"""The memory that a voltage played before a record leaves: a virtual history.

A stack's hysteresis and creep begin a record where the voltage before it has left them. A model
that begins relaxed instead errs by up to half its loop at first, and by all of it at the end of
the range. So the history is played into the same equations:

    0 V, relaxed -> V_1 -> V_2 -> ... -> V(0), one sweep each -> rest

Of the hysteresis only the paper's asymmetry delta depends on the duration of a sweep, and much on a
slow one; creep does, and on the rest. A voltage slower than `hold_rate` counts as held.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from psa_casadi.errors import InputError, Problems
from psa_casadi.model.compose import Model
from psa_casadi.simulation.simulate import simulate
from psa_casadi.simulation.start import memory_names, start_state

#: Samples of a sweep and of a rest.
_SAMPLES = 200


def memory_after(
    model: Model, voltages: Sequence[float], *, at: float, sweep: float = 1.0, rest: float = 0.0
) -> dict[str, float]:
    """Return the `memory` (see `simulate`) of a model after a virtual history.

    From relaxed at 0 V the voltage goes to each of the `voltages` [V] in turn and then to `at`, the
    record's first one, in `sweep` [s] each, and stays there for `rest` [s]. Equal voltages in a row
    count once. Take sweeps as long as those that the stack has made: `delta` and creep see them.

    Raises InputError for bad numbers; SimulationError where the model cannot follow.
    """
    problems = Problems()
    if not np.all(np.isfinite([*voltages, at])):
        problems.add("The history has a voltage that is not finite; give numbers in V.")
    if not (np.isfinite(sweep) and sweep > 0.0):
        problems.add(f"A sweep of the history takes {sweep:g} s; give a duration above 0.")
    if not (np.isfinite(rest) and rest >= 0.0):
        problems.add(f"The rest after the history takes {rest:g} s; give a duration of 0 or more.")
    problems.raise_if_any()
    names = memory_names(model.structure)
    turns = [0.0, *voltages, at]
    share = np.linspace(0.0, 1.0, _SAMPLES + 1)
    parts = [a + (b - a) * share[1:] for a, b in pairwise(turns) if a != b]
    steps = [sweep / _SAMPLES] * (_SAMPLES * len(parts))
    if rest > 0.0:
        parts.append(np.full(_SAMPLES, at))
        steps += [rest / _SAMPLES] * _SAMPLES
    if not parts:
        return dict.fromkeys(names, 0.0)
    times, played_voltage = np.append(0.0, np.cumsum(steps)), np.concatenate([[0.0], *parts])
    played = simulate(model, times, played_voltage, as_exported=False)
    ended = {n: float(played.states[n][-1]) for n in names}
    stays = {s.name: ended[s.name] for s in model.structure.states if s.memory and not s.settles}
    settled = start_state(model, _held(model, at), memory=stays).x
    for state, value in zip(model.structure.states, settled, strict=True):
        if state.memory and state.settles:
            ended[state.name] -= float(value)
    return ended


def settled_at(
    model: Model,
    voltage: float,
    history: Sequence[float] = (),
    *,
    sweep: float = 1.0,
    rest: float = 0.0,
) -> Model:
    """Return the model with start values where a `voltage` [V] holds it, for an export.

    States and the voltage input start there: the memory after a virtual `history` (see
    `memory_after`), all other continuous ones settled; sampled states keep theirs. Raises as
    `memory_after`, and InputError without a voltage.
    """
    if "voltage" not in model.input_names:
        raise InputError(
            f"The model has no input 'voltage' to be held at; it has {model.input_names}."
        )
    memory = memory_after(model, history, at=voltage, sweep=sweep, rest=rest)
    x = start_state(model, _held(model, voltage), memory=memory).x
    starts = dict(zip(model.state_names, x.tolist(), strict=True))
    return model.with_starts({**starts, "voltage": voltage})


def _held(model: Model, voltage: float) -> list[float]:
    """Return the inputs of a model at a voltage [V], the others at their start values."""
    return [voltage if i.name == "voltage" else i.start for i in model.structure.inputs]
