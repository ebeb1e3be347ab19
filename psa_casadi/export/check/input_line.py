"""The line of the inputs over a step, which the parameter `input_line` of an FMU draws."""

import numpy as np

from psa_casadi.export.common.variable_table import INPUT_LINE
from psa_casadi.export.fmu.sources import fixed_step_of
from psa_casadi.export.importer.fmu import CO_SIMULATION, Fmu
from psa_casadi.units import FloatArray

#: Parts of a step in which its line is followed by values that are held.
_PARTS = 50
_TOLERANCE = 1e-9
#: Rise of the inputs over a step, in nominal values: small beside the limits of a slew rate, else
#: large enough to leave a dead band.
_RISES = (1e-3, 1e-1)
#: Changes of states, over the rise, below which the inputs count as without effect.
_SMALL = 1e-5


def input_line_error(fmu: Fmu) -> float:
    """Return how far a step along the line is from where the inputs lead that follow it.

    As a share of what holding the inputs over that step changes, the larger one of two rises. Two
    values are given, a step apart; then the line through them goes on over the next step. The same
    is done by `_PARTS` short steps with values held that lie on it. What these leave, an instant
    of sampled states among them, is twice their difference from half as many at most, and is taken
    off. Inputs that move no state within a step leave nothing to compare: 0.
    """
    return max(_share(fmu, rise) for rise in _RISES)


def _share(fmu: Fmu, rise: float) -> float:
    line, held = (_moved(fmu, value, rise, 1) for value in (1.0, 0.0))
    coarse, fine = (_moved(fmu, 0.0, rise, parts) for parts in (_PARTS // 2, _PARTS))
    change = float(np.max(np.abs(held - fine), initial=0.0))
    left = np.abs(line - fine) - 2.0 * np.abs(coarse - fine)
    return max(0.0, float(np.max(left))) / change if change > _SMALL * rise else 0.0


def _moved(fmu: Fmu, line: float, rise: float, parts: int) -> FloatArray:
    """Return the states, in nominal values, after two steps; the second one in parts."""
    fixed, inputs = fixed_step_of(fmu.directory), fmu.names("input")
    size = fmu.step_size if fixed is None else _PARTS * fixed  # a part must be a multiple of it
    names = fmu.states() or fmu.sampled()
    sizes: FloatArray = np.array([fmu.nominals[n] for n in names])
    values = {INPUT_LINE.name: line}
    with fmu.start(CO_SIMULATION, tolerance=_TOLERANCE, values=values) as instance:
        instance.set({n: rise * fmu.nominals[n] for n in inputs})
        instance.step(0.0, size)
        for part in range(parts):
            along = (part + 0.5) / parts if parts > 1 else 0.0
            instance.set({n: rise * (2.0 + along) * fmu.nominals[n] for n in inputs})
            instance.step(size * (1.0 + part / parts), size / parts)
        return instance.get(names) / sizes
