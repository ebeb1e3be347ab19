"""What the FMU of a sampled model says of itself, and what it refuses."""

from pathlib import Path

import fmpy
import numpy as np
import pytest

from psa_casadi.export.check.check import check_fmu
from psa_casadi.export.fmu.sources import STRICT, write_sources
from psa_casadi.export.importer.fmu import CO_SIMULATION, DISCARD, ERROR, Fmu, FmuError
from psa_casadi.simulation.compiler import compiler_command, run_compiler
from tests.sampled_fmus import exported
from tests.sampled_models import PERIOD, controller, loop
from tests.tiers import slow_but

VERSIONS = pytest.mark.parametrize("fmi", [2, 3])


@VERSIONS
def test_starts_of_sampled_states(fmi: int) -> None:
    with Fmu(exported("controller", fmi)) as fmu:
        with fmu.open(CO_SIMULATION) as slave:
            slave.setup(values={"integral": 0.4, "command": 5.0}, start_time=0.5 * PERIOD)
            assert slave.get(["integral", "command", "voltage"]) == pytest.approx([0.4, 5.0, 5.0])
            with pytest.raises(FmuError, match="can be set only before the first step"):
                slave.set({"integral": 1.0})
            with pytest.raises(FmuError, match="'T_s' cannot be set to 0: it must be at least"):
                slave.set({"T_s": 0.0})
        with fmu.open(CO_SIMULATION) as slave:
            slave.setup(values={"integral": 0.4, "command": 5.0})
            assert slave.get(["integral", "command"]) == pytest.approx([0.4, 0.4])


@VERSIONS
def test_derivatives_hold_the_sampled_states(fmi: int) -> None:
    knowns = ["reference", "command"]
    with Fmu(exported("loop", fmi)) as fmu, fmu.start(CO_SIMULATION) as slave:
        slave.set({"reference": 1.0})
        rates = [slave.directional(["voltage", "der(position)"], [k], [1.0]) for k in knowns]
        assert np.array(rates) == pytest.approx(np.array([[0.0, 0.0], [1.0, 500.0]]))
        slave.step(0.0, 0.5 * PERIOD)
        with pytest.raises(FmuError, match="sample instant fell into it") as refused:
            slave.directional(["position"], ["position"], [1.0])
        assert refused.value.status == DISCARD
        slave.step(0.5 * PERIOD, 0.25 * PERIOD)
        through = slave.directional(["position"], ["position"], [1.0])
        assert through[0] == pytest.approx(np.exp(-0.25 * PERIOD / 4e-3), rel=1e-6)


@VERSIONS
def test_description(fmi: int) -> None:
    described = fmpy.read_model_description(str(exported("loop", fmi)))
    found = {v.name: v for v in described.modelVariables}
    for name in ("integral", "command"):
        v = found[name]
        assert (v.causality, v.variability, v.initial) == ("local", "discrete", "exact")
        assert (v.unit, float(v.start)) == ("V", 0.0)
    listed = {e.variable.name: {d.name for d in e.dependencies} for e in described.outputs}
    through = {"integral", "command"}
    known = {"position", "reference", "k_p"}
    assert listed == {"shown": {"position"}, "voltage": known}
    rates = {e.variable.name: {d.name for d in e.dependencies} for e in described.derivatives}
    assert rates == {"der(position)": {"disturbance", "gain", "lag"} | known}
    initial = {e.variable.name: {d.name for d in e.dependencies} for e in described.initialUnknowns}
    assert initial["voltage"] == known | through


def test_measured_dependencies_are_listed() -> None:
    """Whatever moves the voltage at an instant is among its dependencies, and the reverse."""
    listed = {"reference", "position", "k_p"}
    with Fmu(exported("controller", 2)) as fmu:
        names = [*fmu.names("input"), *fmu.varying("tunable")]
        moving = set()
        for name in names:
            with fmu.start(CO_SIMULATION) as slave:
                slave.set({"reference": 1.0, "position": 0.3})
                slave.step(0.0, PERIOD)
                before = slave.get(["voltage"])[0]
                slave.set({name: slave.get([name])[0] * 1.01})
                if slave.get(["voltage"])[0] != before:
                    moving.add(name)
        (entry,) = fmu.description.outputs
        assert moving == {d.name for d in entry.dependencies} == listed


@pytest.mark.usefixtures("code_runs_here")
@pytest.mark.parametrize(("name", "fmi"), slow_but([("loop", 3)], [("loop", 3), ("controller", 2)]))
def test_check_passes(name: str, fmi: int) -> None:
    model = loop() if name == "loop" else controller()
    report = check_fmu(exported(name, fmi), model)
    assert report.compared
    assert report.failures == ()


@pytest.mark.parametrize("name", ["loop", "controller"])
def test_sources_compile_without_a_warning(name: str, tmp_path: Path) -> None:
    model = loop() if name == "loop" else controller()
    for fmi in (2, 3):
        folder = tmp_path / str(fmi)
        names = [p.name for p in write_sources(model, folder, fmi=fmi) if p.suffix == ".c"]
        flags = ["-std=c99", "-I.", *STRICT, "-fsyntax-only"]
        run_compiler([*compiler_command(), *flags, *names], folder)


def test_illegal_values_leave_an_error() -> None:
    """A sample that is not finite is a step that failed, with a sentence."""
    with Fmu(exported("controller", 2)) as fmu, fmu.start(CO_SIMULATION) as slave:
        slave.set({"reference": 1e308, "position": -1e308})
        with pytest.raises(FmuError, match="sampled states cannot be evaluated") as failed:
            slave.step(0.0, PERIOD)
        assert failed.value.status in (DISCARD, ERROR)
