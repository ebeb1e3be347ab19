"""Models at random parameter values, states and inputs, drawn from a seed."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import psa_casadi as psa
from psa_casadi.common.units import FloatArray


@dataclass(frozen=True)
class Point:
    """Where a model's functions are evaluated: time, states (nx,), inputs (nu,)."""

    time: float
    x: FloatArray
    u: FloatArray


def random_model(
    effects: Sequence[psa.Component],
    generator: np.random.Generator,
    *,
    gains: bool,
    base: Sequence[psa.Component] = psa.BASE,
) -> psa.Model:
    """Return the base with effects; every value within 30 % of its default or ordinary size.

    The gains are 0, or with `gains` one to three times their ordinary size.
    """
    model = psa.compose((*base, *effects))
    values: dict[str, float] = {}
    for parameter in model.structure.parameters:
        share = generator.uniform(0.7, 1.3)
        value = parameter.value or 0.3 * parameter.typical(model.values)
        low, high = parameter.bounds
        values[parameter.name] = float(np.clip(value * share, low, high))
    model = model.with_values(values)
    for effect in effects:
        gain = model.parameter(str(effect.gain))
        size = generator.uniform(1.0, 3.0) * gain.typical(model.values)
        values[gain.name] = size if gains else 0.0
    return model.with_values(values)


def random_point(model: psa.Model, generator: np.random.Generator) -> Point:
    """Return states of their ordinary size with either sign, and inputs within the ratings."""
    x = model.state_nominals() * generator.normal(size=len(model.state_names))
    rated = model.values["u_rated"]
    drawn = {
        "voltage": generator.uniform(-0.3, 1.0) * rated,
        "load_force": generator.uniform(-200.0, 200.0),
    }
    if "temperature" in model.input_names:
        drawn["temperature"] = generator.uniform(280.0, 310.0)
    u = np.array([drawn[name] for name in model.input_names])
    return Point(float(generator.uniform(0.0, 10.0)), x, u)
