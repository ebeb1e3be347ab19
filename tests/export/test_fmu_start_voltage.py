"""The parameter `start_voltage` of an FMU: settled at a voltage, as `psa.settled_at` has it."""

import time
from ctypes import c_bool

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.export.common.variable_table import START_VOLTAGE
from psa_casadi.export.importer.fmu import CO_SIMULATION, MODEL_EXCHANGE, Fmu, FmuError, Instance
from psa_casadi.files import temporary_folder
from psa_casadi.simulation.start import start_state
from tests.export.fmu_models import exported, model_named
from tests.tiers import slow

STACK = "P-885.51"
BOTH = pytest.mark.parametrize("fmi", [2, 3])


def settled(model: psa.Model, voltage: float) -> dict[str, float]:
    """Return the states of a model that is settled at a voltage."""
    return {q.name: q.start for q in psa.settled_at(model, voltage).structure.states}


def apart(fmu: Fmu, instance: Instance, expected: dict[str, float]) -> float:
    """Return the largest difference from values, in nominal ones."""
    size = np.array([fmu.nominals[n] for n in expected])
    return float(np.max(np.abs(instance.get(list(expected)) - list(expected.values())) / size))


def begun(fmu: Fmu, voltage: float) -> Instance:
    """Return an instance in initialization mode with this `start_voltage`."""
    instance = fmu.open(MODEL_EXCHANGE)
    if fmu.version == 2:
        instance.require("SetupExperiment", 0, 0.0, 0.0, 0, 0.0)
        instance.require("EnterInitializationMode")
    else:
        instance.require("EnterInitializationMode", c_bool(False), 0.0, 0.0, c_bool(False), 0.0)
    instance.set({START_VOLTAGE: voltage})
    return instance


@BOTH
@pytest.mark.parametrize("voltage", [60.0, 0.0])
def test_the_derivatives_by_it_are_those_of_the_settled_start(fmi: int, voltage: float) -> None:
    """Until the initialization ends, as the description says that outputs depend on it."""
    with Fmu(exported(STACK, fmi)) as fmu:
        entries = {e.variable.name: e for e in fmu.description.initialUnknowns}
        names = [n for n, e in entries.items() if START_VOLTAGE in [d.name for d in e.dependencies]]
        assert {"displacement", "der(u)"} <= set(names)
        ends = []
        for side in (0.05, -0.05):
            with begun(fmu, voltage + side) as instance:
                ends.append(instance.get(names))
        change = (ends[0] - ends[1]) / 0.1
        with begun(fmu, voltage) as instance:
            found = instance.directional(names, [START_VOLTAGE], [1.0])
            moved = np.array([n in ("charge", "displacement", "blocked_force") for n in names])
            assert np.allclose(found[moved], change[moved], rtol=1e-4, atol=0.0)
            jump = instance.directional(names, ["voltage"], [1.0])  # of one that does not settle
            rests = [names.index(n) for n in ("der(u)", "der(f_H)", "current")]
            assert np.all(np.abs(found[rests]) < 1e-9 * np.abs(jump[rests]))
            (twice,) = instance.directional(["displacement"], [START_VOLTAGE, "k_L"], [2.0, 0.0])
            assert twice == pytest.approx(2.0 * found[names.index("displacement")], rel=1e-12)
            if fmi == 3:
                for name, slope in zip(np.array(names)[moved], found[moved], strict=True):
                    both = instance.adjoint([name], ["time", START_VOLTAGE], [1.0])
                    assert both[1] == pytest.approx(slope, rel=1e-9)
            instance.require("ExitInitializationMode")
            assert instance.directional(["displacement"], [START_VOLTAGE], [1.0])[0] == 0.0


@BOTH
def test_what_is_set_by_itself_stays_whatever_the_order(fmi: int) -> None:
    """States and the voltage; parameters and other inputs count as they are at the end."""
    softer = model_named(STACK).plant().with_values({"k_L": 6.3})
    own = {"f_H": -40.0, "v_x": 2e-4, "voltage": 55.0}
    values = {START_VOLTAGE: 60.0, **own, "k_L": 6.3, "load_force": -20.0}
    at_rest = start_state(softer, [60.0, -20.0], memory={"f_H": -40.0}).x
    expected = dict(zip(softer.state_names, at_rest.tolist(), strict=True)) | own
    assert softer.input_names == ("voltage", "load_force")
    with Fmu(exported(STACK, fmi)) as fmu:
        for names in (list(values), list(values)[::-1]):
            with fmu.start(CO_SIMULATION, values={n: values[n] for n in names}) as slave:
                assert apart(fmu, slave, own) == 0.0
                assert apart(fmu, slave, expected) < 1e-8
    assert abs(expected["x"] / settled(softer, 60.0)["x"] - 1.0) > 1e-2


def test_within_the_initialization_it_counts_at_once_and_can_be_taken_back() -> None:
    model = model_named(STACK).plant()
    with Fmu(exported(STACK)) as fmu, fmu.open(CO_SIMULATION) as slave:
        slave.require("SetupExperiment", 0, 0.0, 3.0, 0, 0.0)
        slave.require("EnterInitializationMode")
        for voltage in (60.0, 25.0):
            slave.set({START_VOLTAGE: voltage})
            assert apart(fmu, slave, settled(model, voltage) | {"voltage": voltage}) < 1e-8
            assert slave.get(["displacement"])[0] == slave.get(["x"])[0]
        snapshot = slave.save()
        copy = slave.serialize(snapshot)
        slave.set({START_VOLTAGE: 0.0})
        assert apart(fmu, slave, dict.fromkeys((*model.state_names, "voltage"), 0.0)) == 0.0
        back = slave.deserialize(copy)
        slave.restore(back)
        assert apart(fmu, slave, settled(model, 25.0)) < 1e-8
        for data in (snapshot, back):
            slave.drop(data)
        slave.require("ExitInitializationMode")
        with pytest.raises(FmuError, match="'start_voltage' can be set only before"):
            slave.set({START_VOLTAGE: 10.0})
        slave.require("Reset")
        slave.setup()
        assert apart(fmu, slave, dict.fromkeys((*model.state_names, START_VOLTAGE), 0.0)) == 0.0


def test_the_exported_start_is_that_of_the_exported_value() -> None:
    """With its history, to the last bit; another value begins without that history."""
    held = psa.settled_at(model_named(STACK), 60.0, [120.0, 0.0]).plant()
    starts = {q.name: q.start for q in held.structure.states} | {"voltage": 60.0}
    with temporary_folder() as folder:
        fmu = Fmu(psa.export_fmu(held, folder / "held.fmu"))
    with fmu:
        for values in ({}, {START_VOLTAGE: 60.0}):
            with fmu.start(CO_SIMULATION, values=values) as slave:
                assert slave.get(list(starts)).tolist() == list(starts.values())
        with fmu.start(CO_SIMULATION, values={START_VOLTAGE: 0.0}) as slave:
            assert apart(fmu, slave, dict.fromkeys(starts, 0.0)) < 1e-12
        assert abs(starts["f_H"] - settled(model_named(STACK), 60.0)["f_H"]) > 1.0


@pytest.mark.parametrize("voltage", [1e200, -1e300])
def test_a_voltage_without_a_settled_state_is_an_error_soon(voltage: float) -> None:
    with Fmu(exported(STACK)) as fmu, fmu.open(CO_SIMULATION) as slave:
        begin = time.perf_counter()
        with pytest.raises(FmuError, match="There is no settled state at the start_voltage"):
            slave.setup(values={START_VOLTAGE: voltage})
        assert time.perf_counter() - begin < 5.0


@slow
def test_memories_that_relax_and_bent_effects_settle_as_in_the_model() -> None:
    model = model_named(STACK).plant()
    for effect in ("slow_creep", "charge_leakage", "saturation_of_strain"):
        model = model.with_effect(psa.EFFECTS[effect])
    model = model.with_values({"creep_gain": 0.1, "leak_gain": 0.1, "saturation_gain": 0.1})
    with temporary_folder() as folder:
        fmu = Fmu(psa.export_fmu(model, folder / "bent.fmu"))
    with fmu:
        for voltage in (60.0, 100.0):
            with fmu.start(CO_SIMULATION, values={START_VOLTAGE: voltage}) as slave:
                assert apart(fmu, slave, settled(model, voltage)) < 1e-6
