"""A fixed step beyond the rated voltage: as good as it says, or limited and told."""

import ctypes
import json

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.export.fixed_step.export import GOOD, FixedStep, fixed_step
from psa_casadi.export.fixed_step.probe import Probe, played_inputs
from psa_casadi.export.fmu.sources import FIXED_ENTRY
from psa_casadi.export.importer.fmu import CO_SIMULATION, Fmu
from psa_casadi.scratch import temporary_folder
from psa_casadi.simulation.compiler import shared_library
from psa_casadi.simulation.stepper import run
from tests.exact_cases import FloatArray, error
from tests.stack_models import stack
from tests.tiers import slow

STEP = 1e-4
TOLD = """#include "stack.h"
#if !defined(_WIN32)
__attribute__((visibility("default")))
#endif
int told(const double *voltage, int count, double *x) {
    stack_state state;
    stack_input input = {0};
    stack_output output;
    int all = 0;
    stack_init(&state);
    for (int k = 0; k < count; ++k) {
        input.voltage = voltage[k];
        all = 2 * all + stack_step(&state, &input, &output);
    }
    *x = output.displacement;
    return all;
}
"""


def planned(precision: str = "double") -> FixedStep:
    return fixed_step(stack("P-885.51").plant(), name="stack", step=STEP, precision=precision)


def jumps(voltage: float) -> FloatArray:
    share = np.linspace(0.0, 1.0, 401)
    return voltage * np.select([share < 0.1, share < 0.5, share < 0.8], [0.0, 1.0, -1.0], 1.0)


def played(found: FixedStep, voltage: FloatArray) -> FloatArray:
    u = played_inputs(found.plan.model, np.zeros(len(voltage)))
    u[:, 0] = voltage
    return Probe(found.plan, found.texts).play(u)[:, 0]


def test_up_to_the_limit_it_is_good_and_beyond_it_stays_there() -> None:
    """900 V, 7.5 times the rated voltage, gave half a range of error; the limit is far above it."""
    found = planned()
    limit, model = found.plan.limit, found.plan.model
    assert 1.25 * model.values["u_rated"] <= limit < 900.0
    u = played_inputs(model, np.zeros(401))
    u[:, 0] = jumps(limit)
    x0, t = np.zeros(len(model.state_names)), STEP * np.arange(401, dtype=np.float64)
    true = run(model, t, u, x0, rtol=1e-10).y[1:, 0]
    assert error(played(found, u[:, 0]), true) <= max(GOOD, found.worst.error)
    for share in (1.001, 900.0 / limit, 1e9, 1e305):
        assert np.array_equal(played(found, share * u[:, 0]), played(found, u[:, 0]))


@pytest.mark.parametrize("precision", ["double", pytest.param("single", marks=slow)])
def test_the_step_tells_it_and_no_number_leaves_the_voltage(precision: str) -> None:
    found = planned(precision)
    library = ctypes.CDLL(str(shared_library({**found.texts, "told.c": TOLD}, ())))
    assert "Returns 1 if the voltage was beyond" in " ".join(found.texts["stack.h"].split())

    def told(*voltage: float) -> tuple[int, float]:
        x = ctypes.c_double()
        given = (ctypes.c_double * len(voltage))(*voltage)
        return library.told(given, len(voltage), ctypes.byref(x)), x.value

    assert told(0.0, 100.0, 900.0, 100.0, -900.0)[0] == 0b00101
    assert told(60.0, 60.0, np.nan) == (0b001, told(60.0, 60.0, 60.0)[1])
    assert told(60.0, np.inf)[1] == told(60.0, found.plan.limit)[1]


@pytest.mark.parametrize("fmi", [2, pytest.param(3, marks=slow)])
def test_an_fmu_says_it_once(fmi: int) -> None:
    with temporary_folder() as folder:
        path = psa.export_fmu(stack("P-885.51"), folder / "fixed.fmu", fmi=fmi, step=STEP)
        with Fmu(path) as fmu:
            ends = []
            limit = json.loads((fmu.directory / FIXED_ENTRY).read_text())["voltage_limit"]
            for voltage in (limit, -limit, 900.0, -1e6, 1e6):
                with fmu.start(CO_SIMULATION) as slave:
                    slave.set({"voltage": voltage})
                    slave.step(0.0, 10 * STEP)
                    slave.step(10 * STEP, 10 * STEP)
                    ends.append(slave.get(["displacement"])[0])
                    said = [m for m in slave.messages if "beyond" in m]
                    assert len(said) == (abs(voltage) > limit), said
    assert ends[0] == ends[2] == ends[4] != ends[1] == ends[3]
