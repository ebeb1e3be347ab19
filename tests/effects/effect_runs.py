"""Runs of a stack with one effect, for the tests of effects."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from psa_casadi.component import Component
from psa_casadi.components import BASE, SIMPLIFIED
from psa_casadi.model.compose import Model
from psa_casadi.model.stacks import STACKS
from psa_casadi.simulation.stepper import Steps, run
from tests.model.stack_models import LINEAR, stack

FloatArray = NDArray[np.float64]

#: The stack without its lags, so that slow drives are quasi-static to 1e-3.
QUICK = {"tau": 1e-6, "R_s": 0.1, "delta": 0.0}


#: The hysteresis of the stack.
HYSTERESIS = {name: STACKS["P-885.51"].values[name].value for name in LINEAR}


def linear(
    effect: Component, gain: float, base: Sequence[Component] = BASE, **more: float
) -> Model:
    """Return the stack without hysteresis and with one effect."""
    model = stack("P-885.51", **LINEAR, **{k: v for k, v in QUICK.items() if k != "delta"})
    if base is SIMPLIFIED:
        model = model.with_components(SIMPLIFIED).with_values({"c": 2e3})
    return model.with_effect(effect, {str(effect.gain): gain, **more})


def driven(model: Model, t: FloatArray, voltage: FloatArray, force: float = 0.0) -> Steps:
    u = np.column_stack([voltage, np.full_like(t, force)])
    return run(model, t, u, np.zeros(len(model.state_names)))


def ordinary(effect: Component, **values: float) -> Model:
    """Return the whole stack with one effect at the ordinary size of its gain."""
    model = stack("P-885.51").with_effect(effect, values)
    gain = model.parameter(str(effect.gain))
    return model.with_values({gain.name: gain.typical({**model.values, gain.name: 0.0})})


def sine_and_steps() -> tuple[FloatArray, FloatArray]:
    """Two seconds at 1 kHz: six cycles of 60 V, a step to 90 V, a step to 30 V."""
    t = np.arange(2001) / 1000.0
    cycles = 30.0 * (1.0 - np.cos(2 * np.pi * 5.0 * t))
    return t, np.where(t < 1.2, cycles, np.where(t < 1.6, 90.0, 30.0))


def triangle(frequency: float, peak: float, cycles: int = 3) -> tuple[FloatArray, FloatArray]:
    n = 400
    t = np.arange(cycles * n + 1) / (n * frequency)
    return t, peak * (1.0 - np.abs(2.0 * ((t * frequency) % 1.0) - 1.0))


def third_harmonic(effect: Component, gain: float, peak: float) -> tuple[float, float]:
    """Return fundamental and third harmonic [m] of a slow sine drive of both signs."""
    n = 2000
    t = np.arange(2 * n + 1) / n
    model = linear(effect, gain)
    x = driven(model, t, peak * np.sin(2 * np.pi * t)).y[n:-1, -1]
    parts = np.fft.rfft(x) * 2.0 / n
    return float(-parts[1].imag), float(-parts[3].imag)
