"""FMUs of several models, unusual ones too, against computations that share no code with them."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import fmpy
import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.generic import effects_of, extended
from psa_casadi.export.check.agreement import has_reference
from psa_casadi.export.check.check import as_exported
from psa_casadi.export.check.description import wrong_dependencies, wrong_start_values
from psa_casadi.export.common.variable_table import variable_table
from psa_casadi.export.importer.archive import Archive
from psa_casadi.export.importer.fmu import CO_SIMULATION, Fmu
from psa_casadi.export.modelica.package import modelica_text
from psa_casadi.reference import simulate
from psa_casadi.simulation.sizes import Sizes
from tests.contract.helpers import samples
from tests.export.fmu_models import exported, model_named
from tests.export.modelica_runs import simulated
from tests.export.ssp_master import END, RATE, load_ecos, monolithic, pushed_stage
from tests.tiers import slow_but

STACK = "P-885.51"
#: The two versions are two faces of one core: each kind of model in one of them. A stack is checked
#: in both by `tests/contract`; others are played in `test_fmu_accuracy`.
CHECKED = ((STACK, 3), ("flexure", 3), ("single_mass", 2), ("every_effect", 3))


@pytest.mark.parametrize(("name", "fmi"), slow_but(CHECKED[:1], CHECKED))
def test_check_passes(name: str, fmi: int) -> None:
    report = psa.check_fmu(exported(name, fmi), model_named(name))
    assert report.compared
    assert [(r.name, r.figure, r.remark) for r in report.failures] == []
    steps = [r for r in report.rows if r.name.startswith("co-simulation, step")]
    assert len(steps) == 4
    assert all(r.limit == 1e-6 for r in steps)
    against = "reference" if has_reference(model_named(name)) else "simulator"
    assert all(r.remark.endswith(f"against the {against}") for r in steps)


@pytest.mark.parametrize("name", [name for name, _ in CHECKED])
def test_nominal_values_of_parameters_are_within_their_bounds(name: str) -> None:
    for v in variable_table(model_named(name)):
        if v.kind == "parameter" and v.bounds and v.bounds[1] > 0.0:
            assert v.nominal is not None
            assert v.bounds[0] <= v.nominal <= v.bounds[1], v


_X, _U, _P, _T = (ca.SX.sym(name) for name in "xupt")


def _ode(name: str, **ode: ca.SX) -> psa.Model:
    values = {"p": 2.0} if "p" in ode else {}
    return psa.ode_model({"x": _X, **ode}, name=name, values=values)


@cache
def _without_outputs() -> psa.Model:
    tank = psa.Component(
        "tank", "a state that follows an input, without an output", "a first-order lag",
        lambda s: psa.Equations(der={"level": s.rate * (s.inflow - s.level)}),
        parameters=(psa.Parameter("rate", 2.0, "1/s", (0.0, 10.0), "rate of the lag"),),
        states=(psa.State("level", "m", "level", 1.0),),
        inputs=(psa.Input("inflow", "m", "what the level follows", 0.0, 1.0),),
    )  # fmt: skip
    return psa.compose([tank], name="tank")


def _with_lag() -> psa.Model:
    """A first-order model whose output has a lag."""
    model = _ode("late", u=_U, p=_P, ode=_P * (_U - _X), y=_X)
    ones = dict.fromkeys((*model.state_names, *model.input_names, *model.output_names), 1.0)
    sizes = Sizes(ones, ones, sample=0.01, duration=1.0)
    lag = next(e for e in effects_of(model, sizes) if e.name.startswith("lag_of_y"))
    return extended(model, [lag]).with_values({f"{lag.name}_time": 0.05})


MODELS: dict[str, Callable[[], psa.Model]] = {
    "neither input nor parameter": lambda: _ode("decay", ode=-_X),
    "no input": lambda: _ode("decay", p=_P, ode=-_P * _X),
    "at rest, parameter without effect": lambda: _ode("rest", u=_U, p=_P, ode=-_P * _X),
    "constant rate": lambda: _ode("clock", ode=ca.SX(1.0)),
    "parameter that acts beyond a threshold": lambda: _ode(
        "threshold", u=_U, p=_P, ode=_P * ca.fmax(_U - 5.0, 0.0) - _X, zero=_U - 5.0
    ),
    "switch by time": lambda: _ode(
        "late", u=_U, p=_P, t=_T, ode=_P * _U - _X + ca.fmax(_T - 0.5, 0.0), zero=_T - 0.5
    ),
    "switch by a state": lambda: _ode(
        "bump", u=_U, p=_P, ode=_U - _X - _P * ca.fmax(_X - 0.3, 0.0), zero=_X - 0.3
    ),
    "no output": _without_outputs,
}
QUICK = [("switch by a state", 3), ("no output", 3)]
#: Every model in one of the versions.
IN_TURN = [(n, 2 + k % 2) for k, n in enumerate(MODELS) if (n, 3) not in QUICK]


@pytest.mark.usefixtures("code_runs_here")
@pytest.mark.parametrize(("name", "fmi"), slow_but(QUICK[:1], [*QUICK, *IN_TURN]))
def test_an_unusual_model_passes_the_check(name: str, fmi: int, tmp_path: Path) -> None:
    report = psa.check_fmu(psa.export_fmu(MODELS[name](), tmp_path / "m.fmu", fmi=fmi))
    assert report.passed, report.failures


def test_a_sensors_effect_is_left_out_where_the_fmu_leaves_it_out(tmp_path: Path) -> None:
    """It has no output, but a state and parameters."""
    whole = _with_lag()
    assert whole.state_names != ("x",)
    with Archive(psa.export_fmu(whole, tmp_path / "m.fmu")) as archive:
        chosen = as_exported(archive, whole)
        assert chosen.state_names == ("x",)
        assert list(wrong_start_values(archive, chosen)) == []
        assert list(wrong_dependencies(archive, chosen)) == []


def test_a_model_without_outputs_runs_everywhere(tmp_path: Path) -> None:
    """Its state is the lag's exponential in Python, in an FMU and in Modelica."""
    model, end = _without_outputs(), 1.0
    assert isinstance(model.structure.y, ca.SX)
    assert model.structure.y.shape == (0, 1)
    exact = 1.0 - np.exp(-2.0 * end)
    t = np.linspace(0.0, end, 11)
    steps = psa.run(model, t, np.ones((11, 1)), np.zeros(1), rtol=1e-9)
    assert steps.x[-1, 0] == pytest.approx(exact, rel=1e-7)
    assert steps.y.shape == (11, 0)
    with (
        Fmu(psa.export_fmu(model, tmp_path / "m.fmu")) as fmu,
        fmu.start(CO_SIMULATION, tolerance=1e-9) as slave,
    ):
        slave.set({"inflow": 1.0})
        slave.step(0.0, end)
        assert slave.get(["level"])[0] == pytest.approx(exact, rel=1e-7)
    harness = "model Harness Tank.Signal tank(inflow = 1.0); end Harness;"
    got = simulated(modelica_text(model, name="Tank") + harness, "Harness", end)
    assert got["tank.level"][-1] == pytest.approx(1.0 - np.exp(-2.0 * got["time"][-1]), rel=1e-4)


VERSIONS = pytest.mark.parametrize("fmi", [2, 3])


def _errors(fmi: int, end: float, *options: dict[str, Any]) -> list[float]:
    """Return the largest error over the range of fmpy's runs in model exchange, with two jumps."""
    times = (0.0, 5e-3, 5e-3, 15e-3, 15e-3, 30e-3)
    jumps = samples(time=times, voltage=(0.0, 0.0, 100.0, 100.0, 20.0, 20.0))
    errors = []
    for option in options:
        result = fmpy.simulate_fmu(
            str(exported(STACK, fmi)), stop_time=end, fmi_type="ModelExchange", input=jumps,
            output=["displacement"], **option,
        )  # fmt: skip
        grid, first = np.unique(result["time"], return_index=True)  # it repeats times at events
        truth: FloatArray = simulate(
            model_named(STACK).values, lambda t: (0.0, 100.0, 20.0)[(t >= 5e-3) + (t >= 15e-3)],
            grid, breakpoints=(5e-3, 15e-3),
        ).displacement  # fmt: skip
        errors.append(np.max(np.abs(result["displacement"][first] - truth)) / np.ptp(truth))
    return errors


@pytest.mark.parametrize("fmi", slow_but([3], [2, 3]))
def test_fmpy_cvode(fmi: int) -> None:
    options = {"solver": "CVode", "output_interval": 1e-3}
    coarse, fine = _errors(fmi, 0.03, *({**options, "relative_tolerance": t} for t in (1e-4, 1e-9)))
    assert fine < 1e-6
    assert fine < 1e-2 * coarse


@VERSIONS
def test_fmpy_euler(fmi: int) -> None:
    """Forward Euler at steps far below the fastest time constant: the error is of order one."""
    steps = ({"solver": "Euler", "step_size": h, "output_interval": h} for h in (2e-6, 1e-6))
    coarse, fine = _errors(fmi, 7e-3, *steps)
    assert fine < 0.03
    assert 1.6 < coarse / fine < 2.4


def _coupled_by_ecos(ecos: Any, fmi: int, step: float) -> tuple[float, float]:
    """Couple stack and flexure; return their displacements at the end [m].

    All FMUs step in parallel with what the others gave at the point before (Jacobi iteration).
    """
    structure = ecos.EcosSimulationStructure()
    structure.add_model("stack", exported(STACK, fmi))
    structure.add_model("flexure", exported("flexure", fmi))
    for wire in pushed_stage().wires:
        structure.make_real_connection(*(port.replace(".", "::") for port in wire))
    simulation = ecos.EcosSimulation(step_size=step, structure=structure)
    simulation.init()
    for k in range(round(END / step)):
        simulation.set_real("stack::voltage", RATE * (k + 0.5) * step)
        simulation.step(1)
    result = simulation.get_real("stack::x"), simulation.get_real("flexure::x_f")
    simulation.terminate()
    simulation.free()
    structure.free()
    return result


@VERSIONS
def test_ecos_couples_two_fmus(fmi: int) -> None:
    """The error against one monolithic simulation falls with the step, to first order."""
    ecos = load_ecos() or pytest.skip("ecospy, or the TBB library that it needs, is missing")
    expected = monolithic()
    errors = []
    for step in (1e-6, 5e-7, 2.5e-7):
        result = _coupled_by_ecos(ecos, fmi, step)
        errors.append(max(abs(a - b) for a, b in zip(result, expected, strict=True)) / expected[0])
    assert min(errors[0] / errors[1], errors[1] / errors[2]) > 1.6, errors
    assert errors[2] < 1e-2
