"""Two FMUs coupled, a stack that pushes on a flexure, against one monolithic simulation."""

from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from psa_casadi.export.importer.fmu import CO_SIMULATION, Fmu, Instance
from psa_casadi.units import FloatArray
from tests.fmu_models import exported, model_named

STACK, END, RATE = "P-885.51", 4e-4, 2e5
#: Output of the one FMU, input of the other.
TO_FLEXURE = (("displacement", "tip_position"), ("velocity", "tip_velocity"))
TO_STACK = (("reaction_force", "load_force"),)


def _voltage(t: float) -> float:
    return RATE * t


@cache
def monolithic() -> tuple[FloatArray, FloatArray]:
    """Return the final displacements of stack and stage, from one set of equations."""
    stack, flexure = model_named(STACK).plant(), model_named("flexure")
    f, g = stack.structure.f, flexure.structure.f
    p, q = stack.parameter_vector(), flexure.parameter_vector()
    count = len(stack.state_names)
    at = [stack.output_names.index(name) for name, _ in TO_FLEXURE]

    def rates(t: float, z: FloatArray) -> FloatArray:
        tip = np.array(f(t, z[:count], [_voltage(t), 0.0], p)[1]).ravel()[at]
        slope, out = g(t, z[count:], tip, q)
        force = float(out[flexure.output_names.index("reaction_force")])
        own = f(t, z[:count], [_voltage(t), force], p)[0]
        return np.concatenate([np.array(own).ravel(), np.array(slope).ravel()])

    size = np.concatenate([stack.state_nominals(), flexure.state_nominals()])
    solution = solve_ivp(
        rates, (0.0, END), np.zeros(len(size)), method="LSODA", rtol=1e-9, atol=1e-11 * size
    )
    assert solution.success
    final = solution.y[:, -1]
    return final[stack.state_names.index("x")], final[count]


def _pass(
    source: Instance, target: Instance, names: tuple[tuple[str, str], ...], rates: bool
) -> None:
    outputs, inputs = [n for n, _ in names], [n for _, n in names]
    target.set(dict(zip(inputs, source.get(outputs), strict=True)))
    if rates:
        target.set_rates(dict(zip(inputs, source.output_rates(outputs), strict=True)))


def coupled(step: float, *, rates: bool) -> tuple[float, float]:
    """Step both FMUs in turn; each takes the other's values, with `rates` their slopes too."""
    with Fmu(exported(STACK)) as one, Fmu(exported("flexure")) as two:
        stack, flexure = (
            one.start(CO_SIMULATION, tolerance=1e-8),
            two.start(CO_SIMULATION, tolerance=1e-8),
        )
        with stack, flexure:
            for k in range(round(END / step)):
                t = k * step
                stack.set({"voltage": _voltage(t)})
                stack.set_rates({"voltage": RATE})
                _pass(flexure, stack, TO_STACK, rates)
                _pass(stack, flexure, TO_FLEXURE, rates)
                stack.step(t, step)
                flexure.step(t, step)
            return float(stack.get(["x"])[0]), float(flexure.get(["x_f"])[0])


@pytest.mark.parametrize(("rates", "order"), [(False, 1), (True, 2)])
def test_coupled_fmus_approach_the_monolithic_solution(rates: bool, order: int) -> None:
    """The error falls with the communication step, to first order; with slopes to second."""
    x, x_f = monolithic()
    errors = []
    for step in (1e-6, 5e-7, 2.5e-7):
        found = coupled(step, rates=rates)
        errors.append(max(abs(found[0] - x), abs(found[1] - x_f)) / abs(x))
    ratios = [errors[0] / errors[1], errors[1] / errors[2]]
    assert all(r > 0.8 * 2**order for r in ratios), ratios
    assert errors[-1] < (1e-2 if order == 1 else 1e-4)
