"""Importers that others wrote, on both versions of the standard: fmpy and ecos.

fmpy integrates model exchange with inputs that it sets once a step, not at every right-hand side,
so its CVode is shown voltages that jump and are constant in between.

CasADi's importer is in `test_fmu_derivatives`. ecos is a co-simulation engine.
"""

from typing import Any

import fmpy
import numpy as np
import pytest

from psa_casadi.reference import simulate
from psa_casadi.units import FloatArray
from tests.export.fmu_models import exported, model_named
from tests.export.ssp_systems import END, RATE, monolithic
from tests.studies.benchmarks.coupling import load_ecos
from tests.tiers import slow, slow_but

STACK = "P-885.51"
VERSIONS = pytest.mark.parametrize("fmi", [2, 3])


def _jumps() -> np.ndarray[tuple[int], np.dtype[np.void]]:
    """Return a voltage with two jumps: rows of one time."""
    rows = [(0.0, 0.0), (5e-3, 0.0), (5e-3, 100.0), (15e-3, 100.0), (15e-3, 20.0), (30e-3, 20.0)]
    return np.array(
        [(t, v, 0.0) for t, v in rows],
        dtype=[(n, float) for n in ("time", "voltage", "load_force")],
    )


def _truth(times: FloatArray) -> FloatArray:
    return simulate(
        model_named(STACK).values,
        lambda t: 0.0 if t < 5e-3 else 100.0 if t < 15e-3 else 20.0,
        times,
        breakpoints=(5e-3, 15e-3),
    ).displacement


def _error(result: Any) -> float:
    """Return the largest error over the range of a result with repeated times at events."""
    times, first = np.unique(result["time"], return_index=True)
    truth = _truth(times)
    return float(np.max(np.abs(result["displacement"][first] - truth)) / np.ptp(truth))


@VERSIONS
@pytest.mark.parametrize("tolerance", slow_but([1e-6], [1e-4, 1e-6, 1e-8]))
def test_fmpy_co_simulation(fmi: int, tolerance: float) -> None:
    result = fmpy.simulate_fmu(
        str(exported(STACK, fmi)), stop_time=0.03, fmi_type="CoSimulation",
        relative_tolerance=tolerance, output_interval=1e-3, input=_jumps(), output=["displacement"],
    )  # fmt: skip
    assert len(np.unique(result["time"])) >= 31
    assert _error(result) < 10.0 * tolerance


@slow
def test_fmpy_co_simulation_with_events_and_early_return() -> None:
    """FMI 3: the importer enters event mode at the jumps and may be returned to early."""
    result = fmpy.simulate_fmu(
        str(exported(STACK, 3)), stop_time=0.03, fmi_type="CoSimulation", relative_tolerance=1e-7,
        output_interval=1e-3, input=_jumps(), output=["displacement"], use_event_mode=True,
        early_return_allowed=True,
    )  # fmt: skip
    assert _error(result) < 1e-6


@pytest.mark.parametrize("fmi", slow_but([3], [2, 3]))
def test_fmpy_cvode(fmi: int) -> None:
    errors = []
    for tolerance in (1e-4, 1e-9):
        result = fmpy.simulate_fmu(
            str(exported(STACK, fmi)), stop_time=0.03, fmi_type="ModelExchange", solver="CVode",
            relative_tolerance=tolerance, output_interval=1e-3, input=_jumps(),
            output=["displacement"],
        )  # fmt: skip
        errors.append(_error(result))
    assert errors[1] < 1e-6
    assert errors[1] < 1e-2 * errors[0]


@VERSIONS
def test_fmpy_euler(fmi: int) -> None:
    """Forward Euler at steps far below the fastest time constant: the error is of order one."""
    errors = []
    for step in (2e-6, 1e-6):
        result = fmpy.simulate_fmu(
            str(exported(STACK, fmi)), stop_time=7e-3, fmi_type="ModelExchange", solver="Euler",
            step_size=step, output_interval=step, input=_jumps(), output=["displacement"],
        )  # fmt: skip
        errors.append(_error(result))
    assert errors[1] < 0.03
    assert 1.6 < errors[0] / errors[1] < 2.4


def _coupled_by_ecos(ecos: Any, fmi: int, step: float) -> tuple[float, float]:
    """Couple stack and flexure; return their displacements at the end [m].

    All FMUs step in parallel with what the others gave at the point before (Jacobi iteration).
    """
    structure = ecos.EcosSimulationStructure()
    structure.add_model("stack", exported(STACK, fmi))
    structure.add_model("flexure", exported("flexure", fmi))
    structure.make_real_connection("stack::displacement", "flexure::tip_position")
    structure.make_real_connection("stack::velocity", "flexure::tip_velocity")
    structure.make_real_connection("flexure::reaction_force", "stack::load_force")
    simulation = ecos.EcosSimulation(step_size=step, structure=structure)
    simulation.init()
    for k in range(round(END / step)):
        simulation.set_real("stack::voltage", RATE * (k + 0.5) * step)
        simulation.step(1)
    found = simulation.get_real("stack::x"), simulation.get_real("flexure::x_f")
    simulation.terminate()
    simulation.free()
    structure.free()
    return found


@VERSIONS
def test_ecos_couples_two_fmus(fmi: int) -> None:
    """The error against one monolithic simulation falls with the step, to first order."""
    ecos = load_ecos() or pytest.skip("ecospy, or the TBB library that it needs, is missing")
    expected = monolithic()
    errors = []
    for step in (1e-6, 5e-7, 2.5e-7):
        found = _coupled_by_ecos(ecos, fmi, step)
        errors.append(max(abs(a - b) for a, b in zip(found, expected, strict=True)) / expected[0])
    assert errors[0] / errors[1] > 1.6, errors
    assert errors[1] / errors[2] > 1.6, errors
    assert errors[2] < 1e-2
