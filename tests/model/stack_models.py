"""Named stacks as models, what their linear part is, and a voltage that starts at rest."""

from collections.abc import Mapping

import numpy as np

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from tests.studies.plants.stack import Stack

#: The paper's stacks: the others are identified and have no published stroke.
PAPER_STACKS = ("P-885.51", "PTBS200", "WYDS0808020")
#: Values that take the hysteresis out of a stack.
LINEAR = {"A": 0.0, "beta": 0.0, "gamma": 0.0, "delta": 0.0}

_PLAIN = ("u_rated", "k_L", "beta", "gamma", "delta", "n", "h_ref", "tau")
_PARTS = ("R_s", "A", "m_P", "c_P", "k_P", "m_B", "c_B", "k_B")
#: The names of the plants' parameters by those of the model.
PLANT_NAMES = {"C_p": "c_p_el"} | {name: name.lower() for name in (*_PLAIN, *_PARTS)}


def plant_of(p: Mapping[str, float]) -> Stack:
    return Stack(**{field: p[name] for name, field in PLANT_NAMES.items()})


def values_of(plant: Stack) -> dict[str, float]:
    return {name: getattr(plant, field) for name, field in PLANT_NAMES.items()}


def stack_values(name: str, **changes: float) -> dict[str, float]:
    return {key: figure.value for key, figure in psa.STACKS[name].values.items()} | changes


def stack(name: str, **changes: float) -> psa.Model:
    return psa.compose(psa.BASE, stack_values(name, **changes))


def at_ordinary_size(model: psa.Model, effect: psa.Component) -> psa.Model:
    """Return a model with one more effect, its gain at an ordinary size or step."""
    model = model.with_effect(effect)
    gain = model.parameter(str(effect.gain))
    size = gain.typical({**model.values, gain.name: 0.0})
    if effect.finite_step:
        size *= effect.finite_step[len(effect.finite_step) // 2]
    return model.with_values({gain.name: float(np.clip(size, *gain.bounds))})


def sine(t: FloatArray, frequency: float) -> FloatArray:
    voltage: FloatArray = 60.0 * (1.0 - np.cos(2 * np.pi * frequency * t))
    return voltage


def jacobian(model: psa.Model) -> FloatArray:
    """Return df/dx at rest by differences of a linear function, shape (nx, nx)."""
    linear = model.with_values(LINEAR)
    p, size = linear.parameter_vector(), linear.state_nominals()
    columns = [
        np.array(linear.structure.f(0.0, row, [0.0, 0.0], p)[0]).ravel() for row in np.diag(size)
    ]
    return np.array(columns).T / size
