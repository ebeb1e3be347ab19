"""The state at the start of a record, its derivatives, and how they go on into a run."""

import html
import time
from ctypes import c_bool
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.export.check.agreement import truth_of
from psa_casadi.export.check.description import wrong_start_values
from psa_casadi.export.check.structure import wrong_start
from psa_casadi.export.common.variable_table import START_VOLTAGE
from psa_casadi.export.fmu.documentation import documentation
from psa_casadi.export.importer.archive import Archive
from psa_casadi.export.importer.fmu import CO_SIMULATION, MODEL_EXCHANGE, Fmu, FmuError, Instance
from psa_casadi.export.importer.masters import Signals, co_simulate
from psa_casadi.model.model_file import dumps, loads
from psa_casadi.simulation.start import initial_slope, start_state
from tests.contract.helpers import done, refused
from tests.export.fmi3_instances import restore, saved
from tests.export.fmu_models import exported, model_named
from tests.model.stack_models import jacobian, sine, stack
from tests.tiers import slow


@pytest.mark.parametrize(
    "effects", [(), pytest.param(tuple(psa.EFFECTS), marks=slow)], ids=["base", "all"]
)
@pytest.mark.parametrize("name", sorted(psa.STACKS))
def test_rest_is_rest(name: str, effects: tuple[str, ...]) -> None:
    model = stack(name)
    gains = {"creep_gain": 0.05, "mode_gain": 0.1, "memory_gain": 0.1, "sensor_delay": 1e-3}
    for effect in effects:
        model = model.with_effect(psa.EFFECTS[effect])
    model = model.with_values({k: v for k, v in gains.items() if k in model.values})
    memory = {"f_H": 0.3 * model.values["h_ref"]}
    inputs = [{"voltage": 80.0, "load_force": 50.0}.get(n, 293.15) for n in model.input_names]
    start = start_state(model, inputs, memory=memory)
    rate = np.array(model.structure.f(0.0, start.x, inputs, model.parameter_vector())[0])
    size = model.state_nominals()
    assert start.x[model.state_names.index("u")] == pytest.approx(80.0, rel=1e-12)
    assert start.x[model.state_names.index("f_H")] == memory["f_H"]
    fastest = np.abs(np.linalg.eigvals(jacobian(stack(name)))).max()
    assert np.all(np.abs(rate.ravel()) < 1e-9 * fastest * size)
    held = psa.simulate(model, [0.0, 0.1, 2.0], [80.0] * 3, load_force=[50.0] * 3, memory=memory)
    assert np.ptp(held.displacement) < 1e-9 * held.displacement[0]


def test_a_memory_that_relaxes_in_a_bent_model_leaves_the_others_at_rest() -> None:
    """They only follow it."""
    gains = {"saturation_gain": 0.1, "leak_gain": 0.1}
    model = stack("P-885.51")
    for effect in ("saturation_of_strain", "charge_leakage"):
        model = model.with_effect(psa.EFFECTS[effect])
    model = model.with_values(gains)
    start = start_state(model, [60.0, 0.0], memory={"leak_voltage": 9.0})
    rate = np.array(model.structure.f(0.0, start.x, [60.0, 0.0], model.parameter_vector())[0])
    shares = np.abs(rate.ravel()) / model.state_nominals()
    fast = np.array([not s.memory for s in model.structure.states])
    assert shares[model.state_names.index("leak_voltage")] > 1e-2
    assert np.max(shares[fast]) < 1e-2


@pytest.mark.parametrize("name", sorted(psa.STACKS))
def test_a_record_that_starts_in_motion_starts_without_a_transient(name: str) -> None:
    """The start on a ramp is the state that a long ramp has led to."""
    model = stack(name)
    p = model.values
    end = max(0.04, 200 * p["tau"])
    rate = 0.5 * p["u_rated"] / end
    bend = p["tau"] * abs(p["delta"]) / (p["k_L"] + p["A"])  # delta bends the ramp of the force
    t = np.linspace(0.0, end, 41)
    led = psa.simulate(model, t, rate * t, from_rest_at_zero=True, rtol=1e-10)
    memory = {"f_H": float(led.states["f_H"][-1])}
    moving = start_state(model, [rate * t[-1], 0.0], [rate, 0.0], memory, t[-1]).x
    still = start_state(model, [rate * t[-1], 0.0], None, memory, t[-1]).x
    for k, state in enumerate(model.state_names):
        off, lag = (abs(x[k] - led.states[state][-1]) for x in (moving, still))
        assert off <= (1e-3 + bend) * lag + 1e-9 * model.state_nominals()[k], state
    assert abs(still[0] - led.states["u"][-1]) > 1e-5 * p["u_rated"]


def test_start_derivatives_are_differences_of_starts() -> None:
    model = stack("WYDS0808020").with_effect(psa.EFFECTS["slow_creep"], {"creep_gain": 0.05})
    inputs, rates, memory = [60.0, 20.0], [3e3, 0.0], {"f_H": -30.0, "z_c2": 2e-7}
    start = start_state(model, inputs, rates, memory)

    def compare(ends: list[FloatArray], slope: FloatArray, size: float) -> None:
        """Compare a derivative to the difference of starts 2e-5 of a size apart."""
        result, exact = (ends[0] - ends[1]) / 2e-5, size * slope
        assert np.all(np.abs(result - exact) <= 1e-7 * (np.abs(exact) + model.state_nominals()))

    for k, name in enumerate(model.parameter_names):
        size = model.parameter(name).typical(model.values)
        moved = [model.with_values({name: model.values[name] + h * size}) for h in (1e-5, -1e-5)]
        ends = [start_state(m, inputs, rates, memory).x for m in moved]
        compare(ends, start.by_parameter[:, k], size)
    names = ("f_H", "z_c1", "z_c2", "z_c3")
    assert start.by_start.shape == (len(start.x), len(names))
    for k, name in enumerate(names):
        size = model.state_nominals()[model.state_names.index(name)]
        at = [{**memory, name: memory.get(name, 0.0) + h * size} for h in (1e-5, -1e-5)]
        ends = [start_state(model, inputs, rates, m).x for m in at]
        compare(ends, start.by_start[:, k], size)


def test_sensitivity_to_a_start_is_the_difference_of_runs() -> None:
    model = stack("P-885.51")
    t = np.linspace(0.0, 1e-3, 2001)
    u = np.column_stack([sine(t, 700.0), 0.0 * t])
    start: FloatArray = 0.1 * model.state_nominals()
    unknowns = [model.state_names.index(n) for n in ("f_H", "f_out", "x")]
    exact = psa.run(model, t, u, start, rtol=1e-8, unknowns=unknowns).sensitivity[:, -1]
    for column, k in enumerate(unknowns):
        step: FloatArray = 1e-3 * np.eye(len(start))[k] * model.state_nominals()
        ends = [psa.run(model, t, u, start + sign * step, rtol=1e-8).y[:, -1] for sign in (1, -1)]
        result = (ends[0] - ends[1]) / (2 * step[k])
        size = np.abs(exact[:, column]).max()
        np.testing.assert_allclose(result, exact[:, column], rtol=0, atol=1e-4 * size)


def test_initial_slope_sees_motion_and_no_step() -> None:
    t = np.array([0.0, 0.1, 0.2, 0.3, 0.4])
    for slope, *values in ((2, 1.0, 1.3, 1.5, 1.9, 0.0), (-2, 1.0, 0.7, 0.5, 0.1, 9.0),
                           (0, 1.0, 5.0, 5.0, 5.0, 5.0), (0, 1.0, 1.1, 1.0, 1.1, 1.0)):  # fmt: skip
        assert initial_slope(t, np.array(values)) == pytest.approx(slope)


STACK = psa.stack_model("P-885.51")


def test_loops_before_leave_what_the_same_loops_played_leave() -> None:
    creeping = STACK.with_effect(psa.EFFECTS["slow_creep"], {"creep_gain": 0.02, "creep_time": 0.1})
    model = creeping.with_effect(psa.EFFECTS["hysteresis_memory"], {"memory_gain": 0.05})
    turns, sweep, rest = [0.0, 100.0, 20.0, 80.0, 50.0], 0.7, 2.0
    corners = np.append(sweep * np.arange(len(turns)), sweep * (len(turns) - 1) + rest)
    t = np.linspace(0.0, 1.0, 501)
    voltage = 50.0 + 30.0 * np.sin(2 * np.pi * t)
    before = np.linspace(0.0, corners[-1], 2401)
    played = np.interp(before, corners, [*turns, turns[-1]])
    whole = psa.simulate(
        model, np.append(before, corners[-1] + t[1:]), np.append(played, voltage[1:])
    ).displacement[2400:]
    memory = psa.memory_after(model, turns[1:-1], at=turns[-1], sweep=sweep, rest=rest)
    # the record starts in motion: the fast states start there, as `start_state` has it
    result = psa.simulate(model, t, voltage, memory=memory).displacement
    assert np.abs(result - whole)[50:].max() < 1e-4 * np.ptp(whole)


def test_starts_go_with_a_model_through_its_file_its_plant_and_its_effects() -> None:
    settled = psa.settled_at(STACK, 60.0, [120.0])
    assert settled.changed_starts()["voltage"] == 60.0
    extended = settled.with_effect(psa.EFFECTS["sensor_lag"], {"sensor_lag_time": 1e-4})
    assert loads(dumps(extended)).changed_starts() == extended.changed_starts()
    assert extended.plant().changed_starts() == settled.changed_starts()
    assert STACK.changed_starts() == settled.with_declared_starts().changed_starts() == {}
    assert "starts" not in dumps(STACK)
    with pytest.raises(psa.InputError, match="no state or input 'q'"):
        STACK.with_starts({"q": 1.0})
    with pytest.raises(psa.InputError, match="finite"):
        STACK.with_starts({"u": np.inf})
    broken = dumps(extended).replace('"voltage": 60.0', '"voltage": "high"')
    with pytest.raises(psa.InputError, match=r"'starts\.voltage' is 'high'; give a number"):
        loads(broken)


def test_a_modelica_package_states_the_same_starts(tmp_path: Path) -> None:
    path = tmp_path / "PiezoStack.mo"
    command = ("export", "modelica", "--stack", "P-885.51", "-o", path)
    done(*command, "--start-voltage", "60", "--history", "120")
    text = path.read_text()
    starts = psa.settled_at(STACK, 60.0, [120.0]).changed_starts()
    assert f'Real f_H(unit="N", start={starts["f_H"]!r}, fixed=true' in text
    assert 'input Real voltage(unit="V", start=60.0' in text
    for history, reason in (("120", "--start-voltage"), ("high", "--history is 'high'")):
        assert reason in refused(*command, "--history", history)


@pytest.mark.parametrize(
    ("turns", "options", "match"),
    [
        ([np.nan], {}, "not finite"),
        ([10.0], {"sweep": 0.0}, "above 0"),
        ([10.0], {"rest": -1.0}, "0 or more"),
    ],
)
def test_bad_numbers_are_named(turns: list[float], options: dict[str, float], match: str) -> None:
    with pytest.raises(psa.InputError, match=match):
        psa.memory_after(STACK, turns, at=5.0, **options)


OPTIONS = ["--start-voltage", "60", "--history", "120,0"]
TIME = np.linspace(0.0, 0.1, 1001)
VOLTAGE = 60.0 + 60.0 * np.sin(2 * np.pi * 10.0 * TIME)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sine about 60 V, the stack as a model file, with and without starts, and its FMU."""
    made = tmp_path_factory.mktemp("starts")
    psa.write_record(made / "v.csv", {"time [s]": TIME, "voltage [V]": VOLTAGE})
    psa.save_model(STACK, made / "plain.json")
    psa.save_model(psa.settled_at(STACK, 60.0, [120.0, 0.0]), made / "held.json")
    export = ("export", "fmu", "--model", made / "plain.json", "-o", made / "m.fmu")
    assert "start: the start values of the model at 60 V" in done(*export, *OPTIONS).words
    return made


def _simulated(folder: Path, model: str, *options: str) -> tuple[FloatArray, str]:
    out = folder / "out.csv"
    files = ("--model", folder / model, "--input", folder / "v.csv", "-o", out)
    printed = done("simulate", *files, *options).out
    result = psa.read_record(out).displacement
    assert result is not None
    return result, next(line for line in printed.splitlines() if line.startswith("start: "))


def test_the_same_start_gives_the_same_trajectory_in_the_command_and_in_the_fmu(
    folder: Path,
) -> None:
    """Also where the start is in the model file; without it the two differ, with a message."""
    inputs = Signals(("voltage",), TIME, VOLTAGE[:, None])
    with Fmu(folder / "m.fmu") as fmu:
        truth = co_simulate(fmu, TIME, inputs, ["displacement"], tolerance=1e-9)[:, 0]
    span = float(np.ptp(truth))
    for model, options in (("plain.json", OPTIONS), ("held.json", [])):
        result, line = _simulated(folder, model, *options)
        assert np.abs(result - truth).max() < 3e-6 * span, model
        assert "at 60 V, as an exported FMU has them" in line
        assert "step" not in line
    relaxed, line = _simulated(folder, "plain.json")
    assert np.abs(relaxed - truth).max() > 0.02 * span
    assert "settled at 60 V" in line
    assert "--start-voltage 60" in line
    _, line = _simulated(folder, "held.json", "--start-voltage", "0")
    assert "at 0 V" in line
    assert "step from there to 60 V" in line
    _, line = _simulated(folder, "held.json", "--history", "120,0")
    assert "where the history 120,0 V leaves them" in line


def test_a_history_is_played_from_relaxed_whatever_start_the_model_has() -> None:
    held = psa.settled_at(STACK, 60.0, [120.0])
    assert psa.memory_after(held, [100.0], at=30.0) == psa.memory_after(STACK, [100.0], at=30.0)
    t, v = TIME[:3], np.full(3, 60.0)
    one, other = (psa.simulate(m, t, v, as_exported=False).displacement for m in (held, STACK))
    assert np.array_equal(one, other)
    assert abs(psa.simulate(held, t, v).displacement[0] - other[0]) > 1e-7


def test_the_check_has_a_row_for_the_start(folder: Path) -> None:
    plain, settled = STACK.plant(), psa.settled_at(STACK, 60.0, [120.0, 0.0]).plant()
    with Fmu(folder / "m.fmu") as fmu:
        assert list(wrong_start(fmu, truth_of(settled, 2))) == []
        items = list(wrong_start(fmu, truth_of(plain, 2)))
        assert any("co-simulation 'voltage' starts at 60, the model at 0" in f for f in items)
        assert any("model exchange 'voltage' starts at 60" in f for f in items)
    with Archive(folder / "m.fmu") as archive:
        assert "'voltage' starts at 60" in "".join(wrong_start_values(archive, plain))
    with Fmu(exported("flexure", 3)) as fmu:
        assert list(wrong_start(fmu, truth_of(model_named("flexure"), 3))) == []


def test_the_page_states_the_start() -> None:
    page = html.unescape(documentation(STACK))
    assert "It starts relaxed at 0 V" in page
    assert "keep their start values it stays there" in page
    settled = psa.settled_at(STACK, 60.0, [120.0])
    page = html.unescape(documentation(settled))
    assert "It starts at 60 V with the start values of the tables" in page
    assert "it stays there" in page
    at_start = psa.simulate(settled, TIME[:2], [60.0, 60.0]).displacement[0]
    assert f"{1e6 * at_start:.6g} um" in page
    moving = settled.with_starts({"voltage": 0.0})
    assert "it moves from there" in html.unescape(documentation(moving))
    assert replace(moving, name="x").starts_itself


NAME = "P-885.51"
BOTH = pytest.mark.parametrize("fmi", [2, 3])


def settled(model: psa.Model, voltage: float) -> dict[str, float]:
    """Return the states of a model that is settled at a voltage."""
    return {q.name: q.start for q in psa.settled_at(model, voltage).structure.states}


def apart(fmu: Fmu, instance: Instance, expected: dict[str, float]) -> float:
    """Return the largest difference from values, in nominal ones."""
    size = np.array([fmu.nominals[n] for n in expected])
    return float(np.max(np.abs(instance.get(list(expected)) - list(expected.values())) / size))


def started_at(fmu: Fmu, voltage: float) -> Instance:
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
    """Until the initialization ends, as outputs depend on it in the description."""
    with Fmu(exported(NAME, fmi)) as fmu:
        entries = {e.variable.name: e for e in fmu.description.initialUnknowns}
        names = [n for n, e in entries.items() if START_VOLTAGE in [d.name for d in e.dependencies]]
        assert {"displacement", "der(u)"} <= set(names)
        ends = []
        for side in (0.05, -0.05):
            with started_at(fmu, voltage + side) as instance:
                ends.append(instance.get(names))
        change = (ends[0] - ends[1]) / 0.1
        with started_at(fmu, voltage) as instance:
            values = instance.directional(names, [START_VOLTAGE], [1.0])
            moved = np.array([n in ("charge", "displacement", "blocked_force") for n in names])
            assert np.allclose(values[moved], change[moved], rtol=1e-4, atol=0.0)
            jump = instance.directional(names, ["voltage"], [1.0])  # of one that does not settle
            rests = [names.index(n) for n in ("der(u)", "der(f_H)", "current")]
            assert np.all(np.abs(values[rests]) < 1e-9 * np.abs(jump[rests]))
            (twice,) = instance.directional(["displacement"], [START_VOLTAGE, "k_L"], [2.0, 0.0])
            assert twice == pytest.approx(2.0 * values[names.index("displacement")], rel=1e-12)
            if fmi == 3:
                for name, slope in zip(np.array(names)[moved], values[moved], strict=True):
                    both = instance.adjoint([name], ["time", START_VOLTAGE], [1.0])
                    assert both[1] == pytest.approx(slope, rel=1e-9)
            instance.require("ExitInitializationMode")
            assert instance.directional(["displacement"], [START_VOLTAGE], [1.0])[0] == 0.0


@BOTH
def test_what_is_set_by_itself_stays_whatever_the_order(fmi: int) -> None:
    """States and the voltage; parameters and other inputs have their final values."""
    softer = model_named(NAME).plant().with_values({"k_L": 6.3})
    table = {"f_H": -40.0, "v_x": 2e-4, "voltage": 55.0}
    values = {START_VOLTAGE: 60.0, **table, "k_L": 6.3, "load_force": -20.0}
    at_rest = start_state(softer, [60.0, -20.0], memory={"f_H": -40.0}).x
    expected = dict(zip(softer.state_names, at_rest.tolist(), strict=True)) | table
    assert softer.input_names == ("voltage", "load_force")
    with Fmu(exported(NAME, fmi)) as fmu:
        for names in (list(values), list(values)[::-1]):
            with fmu.start(CO_SIMULATION, values={n: values[n] for n in names}) as slave:
                assert apart(fmu, slave, table) == 0.0
                assert apart(fmu, slave, expected) < 1e-8
    assert abs(expected["x"] / settled(softer, 60.0)["x"] - 1.0) > 1e-2


def test_within_the_initialization_it_counts_at_once_and_can_be_taken_back() -> None:
    model = model_named(NAME).plant()
    with Fmu(exported(NAME)) as fmu, fmu.open(CO_SIMULATION) as slave:
        slave.require("SetupExperiment", 0, 0.0, 3.0, 0, 0.0)
        slave.require("EnterInitializationMode")
        for voltage in (60.0, 25.0):
            slave.set({START_VOLTAGE: voltage})
            assert apart(fmu, slave, settled(model, voltage) | {"voltage": voltage}) < 1e-8
            assert slave.get(["displacement"])[0] == slave.get(["x"])[0]
        data = saved(slave)
        slave.set({START_VOLTAGE: 0.0})
        assert apart(fmu, slave, dict.fromkeys((*model.state_names, "voltage"), 0.0)) == 0.0
        restore(slave, data)
        assert apart(fmu, slave, settled(model, 25.0)) < 1e-8
        slave.require("ExitInitializationMode")
        with pytest.raises(FmuError, match="'start_voltage' can be set only before"):
            slave.set({START_VOLTAGE: 10.0})
        slave.require("Reset")
        slave.setup()
        assert apart(fmu, slave, dict.fromkeys((*model.state_names, START_VOLTAGE), 0.0)) == 0.0


def test_the_exported_start_is_that_of_the_exported_value(tmp_path: Path) -> None:
    """With its history, to the last bit; another value starts without that history."""
    held = psa.settled_at(model_named(NAME), 60.0, [120.0, 0.0]).plant()
    starts = {q.name: q.start for q in held.structure.states} | {"voltage": 60.0}
    with Fmu(psa.export_fmu(held, tmp_path / "held.fmu")) as fmu:
        for values in ({}, {START_VOLTAGE: 60.0}):
            with fmu.start(CO_SIMULATION, values=values) as slave:
                assert slave.get(list(starts)).tolist() == list(starts.values())
        with fmu.start(CO_SIMULATION, values={START_VOLTAGE: 0.0}) as slave:
            assert apart(fmu, slave, dict.fromkeys(starts, 0.0)) < 1e-12
        assert abs(starts["f_H"] - settled(model_named(NAME), 60.0)["f_H"]) > 1.0


@pytest.mark.parametrize("voltage", [1e200, -1e300])
def test_a_voltage_without_a_settled_state_is_an_error_soon(voltage: float) -> None:
    with Fmu(exported(NAME)) as fmu, fmu.open(CO_SIMULATION) as slave:
        begin = time.perf_counter()
        with pytest.raises(FmuError, match="There is no settled state at the start_voltage"):
            slave.setup(values={START_VOLTAGE: voltage})
        assert time.perf_counter() - begin < 5.0


@slow
def test_memories_that_relax_and_bent_effects_settle_as_in_the_model(tmp_path: Path) -> None:
    model = model_named(NAME).plant()
    for effect in ("slow_creep", "charge_leakage", "saturation_of_strain"):
        model = model.with_effect(psa.EFFECTS[effect])
    model = model.with_values({"creep_gain": 0.1, "leak_gain": 0.1, "saturation_gain": 0.1})
    with Fmu(psa.export_fmu(model, tmp_path / "bent.fmu")) as fmu:
        for voltage in (60.0, 100.0):
            with fmu.start(CO_SIMULATION, values={START_VOLTAGE: voltage}) as slave:
                assert apart(fmu, slave, settled(model, voltage)) < 1e-6
