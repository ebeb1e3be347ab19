"""Derivatives of exact steps: of the discrete equations, against differences of the stepper.

Tolerances come from measurement, in shares of a column's largest value. At 1e-8 most columns are
right to 3e-4. That of delta, whose force jumps at each turn of the voltage, is right to 7e-3, and
no better than at 1e-6; at 1e-10 to 3e-4. The stepper's own columns at 1e-10 are off by up to 6e-3
(current limit), so that 1e-12 is the truth here.
"""

import numpy as np
import pytest
from numpy.typing import NDArray

from psa_casadi.effects import EFFECTS
from psa_casadi.model.compose import Model
from psa_casadi.simulation.exact.run import run_exact
from psa_casadi.simulation.start import start_on
from psa_casadi.simulation.stepper import run
from tests.exact_cases import OUTPUT, composite, inputs, times, with_effect

FloatArray = NDArray[np.float64]

BASE_UNKNOWNS = ("R_s", "C_p", "k_L", "A", "beta", "gamma", "delta", "n", "tau", "k_P", "c_B")
NAMES = ("base", *EFFECTS)
SAMPLES, STEP = 240, 2e-4
#: What a run at 1e-8 may be off, over the largest value of a column; delta's own jumps.
ALLOWED, OF_DELTA = 2e-3, 1e-2


def unknowns_of(name: str, model: Model) -> list[str | int]:
    """Return the effect's own parameters, some of the base, and initial states."""
    own = [] if name == "base" else [p.name for p in EFFECTS[name].parameters]
    memories = [s.name for s in model.structure.states if s.memory]
    starts = [model.state_names.index(n) for n in (*memories, "f_out")]
    return [*own, *BASE_UNKNOWNS, *starts]


def record(model: Model) -> tuple[FloatArray, FloatArray, FloatArray]:
    t = times(SAMPLES, STEP)
    u = inputs(model, t, composite(SAMPLES))
    return t, u, start_on(model, t, u).x


def initial(model: Model, unknowns: list[str | int]) -> FloatArray:
    s0 = np.zeros((len(model.state_names), len(unknowns)))
    for column, unknown in enumerate(unknowns):
        if isinstance(unknown, int):
            s0[unknown, column] = 1.0
    return s0


def columns(name: str, tolerance: float) -> tuple[list[str | int], FloatArray, FloatArray]:
    """Return the unknowns, the derivatives of exact steps, and those of the stepper at 1e-12."""
    model = with_effect(name)
    t, u, x0 = record(model)
    unknowns = unknowns_of(name, model)
    s0 = initial(model, unknowns)
    found = run_exact(model, t, u, x0, tolerance=tolerance, unknowns=unknowns, s0=s0)
    own = run(model, t, u, x0, rtol=1e-12, unknowns=unknowns, s0=s0, output=OUTPUT)
    assert found.sensitivity is not None
    assert own.sensitivity is not None
    return unknowns, found.sensitivity, own.sensitivity


def off(found: FloatArray, true: FloatArray) -> float:
    """Return the largest difference over the column's largest value; 0 for columns of zeros."""
    size = float(np.abs(true).max())
    gap = float(np.abs(found - true).max())
    return gap / size if size > 0.0 else gap


@pytest.mark.parametrize("name", NAMES)
def test_derivatives_are_the_stepper_s(name: str) -> None:
    unknowns, found, own = columns(name, 1e-8)
    gaps = {q: off(found[:, k], own[:, k]) for k, q in enumerate(unknowns)}
    for unknown, gap in gaps.items():
        assert gap < (OF_DELTA if unknown == "delta" else ALLOWED), unknown


def test_a_column_does_not_depend_on_the_others() -> None:
    """Columns stand side by side in vectors of four."""
    model = with_effect("load_stiffness")
    t, u, x0 = record(model)
    many: list[str | int] = ["k_L", "A", "tau", "k_P", "load_gain", "c_B", 6]

    def derivatives(unknowns: list[str | int]) -> FloatArray:
        s0 = initial(model, unknowns)
        found = run_exact(model, t, u, x0, tolerance=1e-6, unknowns=unknowns, s0=s0).sensitivity
        assert found is not None
        return found

    together = derivatives(many)
    for column, unknown in enumerate(many):
        np.testing.assert_array_equal(derivatives([unknown])[:, 0], together[:, column])
