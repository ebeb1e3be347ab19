"""FMUs that are run as a whole: co-simulation only, events, arrays; effects around them."""

import re
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree as ET

import casadi as ca
import fmpy
import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.common.children import end_children
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.generic import effects_of, extended
from psa_casadi.export.importer.fmu import Fmu
from psa_casadi.export.importer.fmu_model import FmuInterface
from psa_casadi.export.importer.masters import Run, Signals, communication_points, stepped
from psa_casadi.export.importer.played import RUNS
from psa_casadi.simulation.sizes import Sizes
from psa_casadi.simulation.start import start_for
from psa_casadi.simulation.stepper import SimulationError
from tests.contract.helpers import done, refused, samples, write
from tests.export.fmu_models import files_inside, rewritten
from tests.export.ssp_master import SspArchive, couple
from tests.export.supplied import INFLOW, TIMES, bounces, lagged, level, pendulum, supplied

T = np.linspace(0.0, 20.0, 401)
U = np.column_stack([np.sin(T) + 0.4 * np.sin(3.1 * T)])
ALL = Sizes({"u": 1.4, "y": 1.0, "x": 1.0}, {"x": 2.0}, 0.05, 20.0)
AREA = {"area": (0.05, 4.0)}


@pytest.fixture(autouse=True, scope="module")
def _processes() -> Iterator[None]:
    """End the processes of FMUs: other tests count those of this one."""
    yield
    RUNS.end()


def _first_order(rate: float = 1.3) -> psa.Model:
    x, u, k = (ca.SX.sym(n) for n in ("x", "u", "k"))
    k_ = psa.Parameter("k", rate, "1/s", (0.1, 400.0), "rate", log=True)
    ode = {"x": x, "u": u, "p": k, "ode": k * (u - x), "y": x}
    return psa.ode_model(ode, name="first_order", parameters=[k_], outputs=["y"])


def _record(area: float, outlet: float, y: FloatArray | None = None) -> dict[str, FloatArray]:
    """Return what is measured of a tank; nothing of its equations is the FMU's."""
    y = level(area, outlet) if y is None else y
    noise = 1e-3 * np.random.default_rng(5).standard_normal(len(TIMES))
    return {"time": TIMES, "inflow": INFLOW, "level": y + noise}


def test_effects_around_a_whole_fmu_are_those_of_the_equations(tmp_path: Path) -> None:
    names = ("lag_of_u", "bend_of_u", "lag_of_y", "gain_of_y", "delay_of_y")
    values = {
        "k": 1.7, "lag_of_u_time": 0.3, "bend_of_u_size": 0.2, "lag_of_y_time": 0.4,
        "gain_of_y_size": 0.1, "delay_of_y_time": 0.2,
    }  # fmt: skip
    symbolic = _first_order()
    whole = psa.fmu_model(
        psa.export_fmu(symbolic, tmp_path / "model.fmu"), free=["k"], interface="co-simulation"
    )
    table = {e.name: e for e in effects_of(whole, ALL)}
    items = []
    for base in (symbolic, whole):
        model = extended(base, [table[n] for n in names]).with_values(values)
        free = ["k", *(n for n in values if n != "k")]
        start = start_for(model, T, U, {})
        s0 = start.by_parameter[:, [model.parameter_names.index(n) for n in free]]
        steps = psa.run(model, T, U, start.x, rtol=1e-8, unknowns=free, s0=s0, outputs=["y"])
        items.append((steps.y[:, 0], steps.sensitivity[:, 0]))
    (y, slopes), (y_whole, slopes_whole) = items
    assert np.max(np.abs(y_whole - y)) < 1e-3 * np.ptp(y)
    for n, one, other in zip(free, slopes.T, slopes_whole.T, strict=True):
        assert np.max(np.abs(one - other)) < 0.01 * np.max(np.abs(one)), n


def test_a_run_is_nearer_to_the_truth_than_an_importer_s() -> None:
    model = psa.fmu_model(supplied("tank"), free=AREA, values={"valve": 1.0})
    y = psa.run(model, TIMES, INFLOW[:, None], np.zeros(0)).y[:, 0]
    peer = fmpy.simulate_fmu(
        str(supplied("tank")), stop_time=100.0, output_interval=0.2, start_values={"valve": True},
        input=samples(time=TIMES, inflow=INFLOW), output=["level"],
        validate=False,
    )["level"]  # fmt: skip
    truth = level(0.5, 0.01)
    errors = [np.max(np.abs(y - truth)) for y in (y, peer)]
    assert errors[0] < 1e-4 * np.ptp(truth)
    assert errors[1] > 30 * errors[0]  # it holds the input at its value before the step


def test_a_step_is_divided_where_the_fmu_is_fast(tmp_path: Path) -> None:
    fast = _first_order(40.0)
    path = psa.export_fmu(fast, tmp_path / "fast.fmu", fmi=3)  # without input derivatives
    unstated = {"modelDescription.xml": lambda xml: re.sub(rb' stepSize="[^"]*"', b"", xml)}
    rewritten(path, path, unstated)
    exact = psa.run(fast, T[::4], U[::4], np.zeros(1), rtol=1e-9).y
    there = psa.fmu_model(path, free=["k"], interface="co-simulation")
    played = psa.run(there, T[::4], U[::4], np.zeros(0)).y
    assert np.std(played - exact) < 1e-3 * np.std(exact)
    table = {"k": 40.0}
    run = Run(str(path), "", 1, ("y",), table, Signals(("u",), T[::4], U[::4]))
    with Fmu(path) as fmu:
        assert np.std(stepped(fmu, run) - exact) > 3e-3 * np.std(exact)


def test_a_supplier_s_parameters_are_identified_in_few_runs() -> None:
    RUNS.forget()
    before = RUNS.count
    model = psa.fmu_model(
        supplied("tank"), free={**AREA, "outlet": (1e-3, 0.1)}, values={"valve": 1.0}
    )
    result = psa.identify(model, _record(0.7, 0.012))
    for name, true in (("area", 0.7), ("outlet", 0.012)):
        assert abs(result.model.values[name] - true) < 4 * result.errors[name]
    assert RUNS.count - before < 80


def test_a_ball_is_followed_from_its_first_bounce_on() -> None:
    times = np.linspace(0.0, 3.0, 301)
    h = bounces(9.0, 0.8, times) + 2e-3 * np.random.default_rng(1).standard_normal(301)
    model = psa.fmu_model(supplied("ball"), free={"g": (5.0, 20.0), "e": (0.4, 0.95)})
    result = psa.identify(model, {"time": times, "h": h})
    assert result.rms["h"] == pytest.approx(2e-3, rel=0.15)
    for name, true in (("g", 9.0), ("e", 0.8)):
        assert abs(result.model.values[name] - true) < 4 * result.errors[name]


@pytest.mark.slow
@pytest.mark.parametrize("hidden", ["lag", "gain", "nothing"])
def test_what_hides_around_a_supplier_s_fmu_is_named(hidden: str) -> None:
    flow = INFLOW * (0.88 if hidden == "gain" else 1.0)
    values = level(0.5, 0.012, flow)
    record = _record(0.5, 0.012, lagged(values, 3.0) if hidden == "lag" else values)
    model = psa.fmu_model(supplied("tank"), free={"outlet": (1e-3, 0.1)}, values={"valve": 1.0})
    d = psa.diagnose(model, record)
    expected = {"lag": ["lag_of_level"], "gain": ["gain_of_inflow"], "nothing": []}[hidden]
    assert [c.effect for c in d.causes] == expected
    assert d.verdict == ("cause_named" if expected else "adequate")


def test_events_of_model_exchange_are_those_of_its_solver(tmp_path: Path) -> None:
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    k = ca.SX.sym("k")
    ode = {"x": x, "u": u, "p": k, "ode": ca.if_else(u > 0.3, k, -0.2 * k), "zero": u - 0.3, "y": x}
    k_ = psa.Parameter("k", 1.0, "1/s", (0.1, 9.0), "rate")
    model = psa.ode_model(ode, name="switched", parameters=[k_], outputs=["y"])
    path = psa.export_fmu(model, tmp_path / "switched.fmu", fmi=3)
    # a step of co-simulation has one value of the input, and so starts or ends at the event
    ways: list[tuple[FmuInterface, float]] = [("model exchange", 1e-4), ("co-simulation", 0.02)]
    for interface, most in ways:
        there = psa.fmu_model(path, free=["k"], interface=interface)
        assert not there.state_names
        result = psa.run(there, T, U, np.zeros(0), unknowns=["k"], outputs=["y"])
        exact = psa.run(model, T, U, np.zeros(1), rtol=1e-9, unknowns=["k"], outputs=["y"])
        assert result.y == pytest.approx(exact.y, abs=most)
        assert result.sensitivity == pytest.approx(exact.sensitivity, abs=most)


def test_inputs_move_while_the_solver_takes_a_step(tmp_path: Path) -> None:
    """One with event indicators is not taken for one whose importer holds the inputs."""
    stack, time = psa.stack_model("P-885.51"), np.linspace(0.0, 0.1, 101)
    voltage = 50.0 - 50.0 * np.cos(40.0 * np.pi * time)
    there = psa.fmu_model(psa.export_fmu(stack, tmp_path / "stack.fmu"), interface="model exchange")
    u = np.array([voltage if n == "voltage" else 0.0 * voltage for n in there.input_names]).T
    y = psa.run(there, time, u, np.zeros(0)).y[:, there.output_names.index("displacement")]
    exact = psa.simulate(stack, time, voltage).displacement
    assert y == pytest.approx(exact, abs=1e-3 * np.ptp(exact))


def test_an_fmu_of_which_one_instance_lives_is_run_as_a_whole() -> None:
    with pytest.raises(psa.InputError, match=r"has no co-simulation, only 'model exchange'"):
        psa.fmu_model(pendulum(once="true"), interface="co-simulation")
    model = psa.fmu_model(pendulum(once="true"), free={"length": (0.1, 5.0)})
    torque = np.zeros((50, 1))
    y = psa.run(model, T[:50], torque, np.zeros(0)).y
    smooth = psa.fmu_model(pendulum(), free={"length": (0.1, 5.0)})
    assert y == pytest.approx(psa.run(smooth, T[:50], torque, np.array([0.1, 0.0])).y, abs=5e-5)


def test_communication_points_are_what_the_fmu_takes(tmp_path: Path) -> None:
    path = psa.export_fmu(_first_order(), tmp_path / "model.fmu")
    uneven = np.array([0.0, 0.1, 0.25, 0.3])
    with Fmu(path) as fmu:
        co = fmu.description.coSimulation
        fmu.description.defaultExperiment.stepSize = "0.05"
        points = communication_points(fmu, uneven)
        assert points == pytest.approx([0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3])
        assert set(uneven) <= set(points)
        co.canHandleVariableCommunicationStepSize = False
        assert np.ptp(np.diff(communication_points(fmu, uneven))) < 1e-12
        co.fixedInternalStepSize = "0.04"
        points = communication_points(fmu, uneven)
        assert points[-1] >= 0.3
        assert np.diff(points) == pytest.approx(0.08)


def test_a_model_names_what_it_lacks() -> None:
    tank = supplied("tank")
    with pytest.raises(psa.InputError, match=r"area \(0\.5\), outlet \(0\.01\)\. .*area=0\.05:5\."):
        psa.fmu_model(tank)
    model = psa.fmu_model(tank, free=AREA)
    assert (model.input_names, model.output_names) == (("inflow", "valve"), ("level",))
    whole = model.with_components(model.components)
    assert whole.structure.played == model.structure.played
    with pytest.raises(SimulationError, match=r"ended \(exit code 3\)"):
        psa.run(
            psa.fmu_model(tank, free={"area": (0.05, 9.0)}).with_values({"area": 6.0}), TIMES[:9],
            np.ones((9, 2)), np.zeros(0),
        )  # fmt: skip


def test_the_commands_take_it_and_write_start_values(tmp_path: Path) -> None:
    record = write(tmp_path / "tank.csv", _record(0.7, 0.01))

    of = ("--fmu", supplied("tank"), "--value", "valve=1")
    out = tmp_path / "out.csv"
    done("simulate", *of, "--value", "area=0.7", "--input", record, "-o", out)
    simulated = np.loadtxt(out, delimiter=",", skiprows=1)[:, 2]
    assert simulated == pytest.approx(level(0.7, 0.01), abs=1e-3)
    for name in ("fit.fmu", "fit.ssv", "fit.json"):
        ended = done("identify", *of, record, "--free", "area=0.05:4", "-o", tmp_path / name)
        assert ("an importer must set the start values" in ended.words) == (name == "fit.fmu")
    root = ET.fromstring(files_inside(tmp_path / "fit.fmu")["modelDescription.xml"])
    starts = {v.get("name"): v[0].get("start") for v in root.iterfind("ModelVariables/*")}
    value = psa.load_model(tmp_path / "fit.json", fmu=supplied("tank")).values["area"]
    assert float(str(starts["area"])) == pytest.approx(value)
    assert value == pytest.approx(0.7, rel=0.01)
    rows = ET.parse(tmp_path / "fit.ssv").getroot().findall(".//{*}Parameter")
    assert [(r.get("name"), r[0].get("unit")) for r in rows] == [("area", None), ("valve", None)]
    assert "add --fmu FILE.fmu" in refused("identify", "--free", "area=1:2", record)


def with_effects() -> psa.Model:
    """Return the supplier's tank with an input gain of 0.88 and a sensor lag of 3 s."""
    model = psa.fmu_model(supplied("tank"), free=AREA, values={"valve": 1.0})
    sizes = Sizes({"inflow": 0.05, "level": 0.6}, {}, 0.2, 100.0)
    table = {e.name: e for e in effects_of(model, sizes)}
    result = extended(model, [table["gain_of_inflow"], table["lag_of_level"]])
    values = {"area": 0.7, "gain_of_inflow_size": -0.12, "lag_of_level_time": 3.0}
    return result.with_values(values)


def test_effects_around_an_fmu_are_exported_around_it(tmp_path: Path) -> None:
    model = with_effects()
    path = psa.export_extended(model, tmp_path / "tank.ssp", step=0.05)
    fine = np.linspace(0.0, 100.0, 2001)
    flow = np.interp(fine, TIMES, INFLOW)[:, None]
    with SspArchive(path) as archive:
        assert archive.parameters["original"] == {"area": 0.7, "valve": 1.0}
        coupled = couple(
            archive, fine, Signals(("inflow",), fine, flow), ["level"], rates=False
        )[:, 0]  # fmt: skip
    truth = lagged(level(0.7, 0.01, 0.88 * INFLOW), 3.0)
    assert np.interp(TIMES, fine, coupled) == pytest.approx(truth, abs=0.01 * float(np.ptp(truth)))
    inside = files_inside(path)
    assert inside["resources/original.fmu"] == supplied("tank").read_bytes()
    root = ET.fromstring(inside["resources/original.ssv"])
    kinds = {p.get("name"): p[0].tag.rpartition("}")[2] for p in root.iterfind(".//{*}Parameter")}
    assert kinds == {"area": "Real", "valve": "Boolean"}
    one = psa.export_extended(model, tmp_path / "tank.fmu")
    inputs = samples(time=fine, inflow=flow[:, 0])
    played = fmpy.simulate_fmu(
        str(one), stop_time=100.0, output_interval=0.05, input=inputs, output=["level"]
    )
    alone = np.interp(TIMES, played["time"], played["level"])
    assert alone == pytest.approx(truth, abs=0.01 * float(np.ptp(truth)))
    ball = psa.fmu_model(supplied("ball"), free={"g": (5.0, 20.0)})
    smooth = psa.fmu_model(pendulum(), free={"length": (0.1, 5.0)})
    for wrong, name, match in (
        (ball, "ball.fmu", r"is of FMI 3\.0, which no FMU holds here"),
        (_first_order(), "none.ssp", "is of no FMU"),
        (smooth, "none.ssp", "has no co-simulation, which can stand between"),
    ):
        with pytest.raises(psa.InputError, match=match):
            psa.export_extended(wrong, tmp_path / name)


@pytest.mark.slow
def test_an_fmu_that_holds_another_one_keeps_to_the_standard(tmp_path: Path) -> None:
    path = psa.export_extended(with_effects(), tmp_path / "tank.fmu")
    assert {r.name for r in psa.check_fmu(path).failures} <= {"memory"}  # PythonFMU's


def test_a_process_that_was_ended_by_others_is_replaced() -> None:
    model = psa.fmu_model(supplied("tank"), free=AREA, values={"valve": 1.0})
    runs = []
    for _ in range(2):
        RUNS.forget()
        runs.append(psa.run(model, TIMES[:9], INFLOW[:9, None], np.zeros(0)).y)
        end_children()
    assert np.array_equal(runs[0], runs[1])
