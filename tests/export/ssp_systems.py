"""Systems and their SSP archives for the tests; each is exported once per process."""

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.integrate import solve_ivp

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from tests.export.fmu_models import model_named

_FOLDER = TemporaryDirectory()

#: Stack, end [s] and rise of the voltage [V/s] of the pushed stage.
STACK, END, RATE = "P-885.51", 4e-4, 2e5


def pushed_stage() -> psa.System:
    """Return a stack that pushes on a flexure: two parts in a loop."""
    return psa.System(
        name="pushed_stage",
        parts={"stack": model_named(STACK).plant(), "flexure": model_named("flexure")},
        wires=(
            ("stack.displacement", "flexure.tip_position"),
            ("stack.velocity", "flexure.tip_velocity"),
            ("flexure.reaction_force", "stack.load_force"),
        ),
        inputs={"command": "stack.voltage"},
        outputs={"stage_position": "flexure.stage_position", "tip": "stack.displacement"},
    )


@cache
def closed_loop() -> psa.System:
    return psa.nanopositioner(STACK)


@cache
def archive_of(name: str) -> Path:
    system = pushed_stage() if name == "pushed_stage" else closed_loop()
    return psa.export_ssp(system, Path(_FOLDER.name) / f"{name}.ssp")


def _voltage(t: float) -> float:
    return RATE * t


@cache
def monolithic() -> tuple[FloatArray, FloatArray]:
    """Return the final displacements of stack and stage, from one set of equations."""
    stack, flexure = model_named(STACK).plant(), model_named("flexure")
    f, g = stack.structure.f, flexure.structure.f
    p, q = stack.parameter_vector(), flexure.parameter_vector()
    count = len(stack.state_names)
    at = [stack.output_names.index(name) for name in ("displacement", "velocity")]

    def rates(t: float, z: FloatArray) -> FloatArray:
        tip = np.array(f(t, z[:count], [_voltage(t), 0.0], p)[1]).ravel()[at]
        slope, out = g(t, z[count:], tip, q)
        force = float(out[flexure.output_names.index("reaction_force")])
        slopes = f(t, z[:count], [_voltage(t), force], p)[0]
        return np.concatenate([np.array(slopes).ravel(), np.array(slope).ravel()])

    size = np.concatenate([stack.state_nominals(), flexure.state_nominals()])
    solution = solve_ivp(
        rates, (0.0, END), np.zeros(len(size)), method="LSODA", rtol=1e-9, atol=1e-11 * size
    )
    assert solution.success
    final = solution.y[:, -1]
    return final[stack.state_names.index("x")], final[count]
