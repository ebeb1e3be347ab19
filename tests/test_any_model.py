"""Diagnosis of models that are no stacks: causes that independent plants hide, and clean ones."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from fmpy import simulate_fmu

import psa_casadi as psa
from psa_casadi.any_model.effects.attached import extended
from psa_casadi.any_model.effects.table import effects_of
from psa_casadi.any_model.runs import runs_of
from psa_casadi.any_model.sizes import sizes_of
from psa_casadi.export.modelica.package import modelica_text
from psa_casadi.model.from_casadi.ports import ports_of, with_ports
from psa_casadi.records.signals import Signals
from tests import own_plants as plants
from tests.fmu_models import model_named
from tests.modelica_runs import load


def _parameter(name: str, value: float, unit: str) -> psa.Parameter:
    return psa.Parameter(name, value, unit, (0.03 * value, 30.0 * value), name, log=True)


def oscillator() -> psa.Model:
    x, v, force, m, c, k = (ca.SX.sym(n) for n in ("x", "v", "force", "m", "c", "k"))
    return psa.ode_model(
        {"x": [x, v], "u": force, "p": [m, c, k], "ode": [v, (force - c * v - k * x) / m], "y": x},
        name="oscillator",
        states=[psa.State("x", "m", "position", 1.0), psa.State("v", "m/s", "velocity", 1.0)],
        inputs=[psa.Input("force", "N", "force")],
        outputs=[psa.Output("position", "m", "position")],
        parameters=[
            _parameter("m", 1.0, "kg"),
            _parameter("c", 30.0, "N.s/m"),
            _parameter("k", 6e4, "N/m"),
        ],
    )


def motor() -> psa.Model:
    i, w, u, R, k, J, b = (ca.SX.sym(n) for n in ("current", "speed", "voltage", *"RkJb"))
    return psa.ode_model(
        {
            "x": [i, w], "u": u, "p": [R, k, J, b], "y": [w, i],
            "ode": [(u - R * i - k * w) / 2e-3, (k * i - b * w) / J],
        },
        name="motor",
        outputs=[psa.Output("w", "rad/s", "speed"), psa.Output("i", "A", "current")],
        parameters=[
            _parameter("R", 1.5, "Ohm"),
            _parameter("k", 0.04, "N.m/A"),
            _parameter("J", 2e-5, "kg.m2"),
            _parameter("b", 1e-5, "N.m.s"),
        ],
    )  # fmt: skip


def tanks() -> psa.Model:
    upper, lower, pump, a, c, d = (ca.SX.sym(n) for n in ("h1", "h2", "pump", "a", "c", "d"))
    through, out = (f * ca.sqrt(ca.fmax(h, 1e-4)) for f, h in ((a, upper), (c, lower)))
    return psa.ode_model(
        {
            "x": [upper, lower], "u": pump, "p": [a, c, d], "y": lower,
            "ode": [d * pump - through, through - out],
        },
        name="tanks",
        states=[psa.State(n, "m", n, 1.0, 0.1) for n in ("h1", "h2")],
        outputs=[psa.Output("level", "m", "level of the lower tank")],
        parameters=[_parameter(n, v, "1") for n, v in (("a", 0.02), ("c", 0.02), ("d", 0.003))],
    )  # fmt: skip


def pair() -> psa.Model:
    x, v, z, w, f1, f2 = (ca.SX.sym(n) for n in ("x1", "v1", "x2", "v2", "f1", "f2"))
    k, kc, c = (ca.SX.sym(n) for n in ("k", "kc", "c"))
    rates = [v, f1 - k * x - kc * (x - z) - c * v, w, f2 - k * z - kc * (z - x) - c * w]
    return psa.ode_model(
        {"x": [x, v, z, w], "u": [f1, f2], "p": [k, kc, c], "ode": rates, "y": [x, z]},
        name="pair",
        outputs=["y1", "y2"],
        parameters=[_parameter(n, v, "1") for n, v in (("k", 80.0), ("kc", 30.0), ("c", 0.5))],
    )


@cache
def _hysteresis() -> psa.OdeDiagnosis:
    return psa.diagnose(oscillator(), plants.bouc_wen(1))


def _only(d: psa.OdeDiagnosis, effect: str) -> bool:
    return d.verdict == "cause_named" and [c.effect for c in d.causes] == [effect]


def test_a_clean_model_of_two_outputs_is_identified_with_its_errors() -> None:
    found = psa.identify(motor(), plants.motor(2, friction=0.0), starts=3)
    true = {"R": 1.2, "k": 0.05, "J": 3e-5, "b": 2e-5}
    for name, value in true.items():
        assert abs(found.model.values[name] - value) < 4.0 * found.errors[name]
        assert found.errors[name] < 0.05 * value
    assert found.rms["w"] == pytest.approx(0.3, rel=0.05)
    assert found.rms["i"] == pytest.approx(0.005, rel=0.05)
    assert not found.warnings
    assert found.model.provenance.identified_from[0][0] == "drive"


@pytest.mark.slow
def test_the_hysteresis_of_the_benchmark_is_found_in_the_restoring_force() -> None:
    d = _hysteresis()
    assert _only(d, "hysteresis_of_x_in_v")
    assert d.causes[0].port == "the rate of v"
    assert d.causes[0].confidence > 0.95
    assert d.errors[0].base > 15.0 * d.errors[0].extended
    assert d.errors[0].extended == pytest.approx(8e-6, rel=0.06)  # the noise
    # the plant's own numbers, through an effect of other coordinates
    assert d.model.values["m"] == pytest.approx(2.0, rel=0.01)
    assert d.model.values["k"] == pytest.approx(5e4, rel=0.01)
    per_m = d.model.values["hysteresis_of_x_in_v_size"]
    per_m /= d.model.values["hysteresis_of_x_in_v_range"]
    assert per_m * d.model.values["m"] == pytest.approx(5e4, rel=0.02)  # alpha
    assert d.model.values["hysteresis_of_x_in_v_n"] == pytest.approx(1.0, abs=0.02)  # nu


@pytest.mark.slow
def test_the_extended_model_is_exported_like_any_other(tmp_path: Path) -> None:
    d, record = _hysteresis(), plants.bouc_wen(1)
    fmu = psa.export_fmu(d.model, tmp_path / "extended.fmu")
    inputs = np.zeros(record.n, dtype=[("time", float), ("force", float)])
    inputs["time"], inputs["force"] = record.time, record.columns["force"]
    found = simulate_fmu(
        str(fmu), fmi_type="CoSimulation", stop_time=record.duration,
        output_interval=1.0 / 15000.0, input=inputs,  # fmpy holds an input over a step
        relative_tolerance=1e-8, output=["position"],
    )  # fmt: skip
    shown = np.interp(record.time, found["time"], found["position"])
    rest = record.columns["position"] - shown  # from the declared start; the plant begins there too
    assert np.std(rest[300:]) < 1.1e-5
    text = modelica_text(d.model, name="Oscillator")
    assert "rate_v" in text
    assert load(text, "Oscillator.Signal") is not None


@pytest.mark.slow
def test_dry_friction_of_a_motor_is_found_at_its_shaft() -> None:
    d = psa.diagnose(motor(), plants.motor(1))
    assert _only(d, "friction_in_speed")
    assert d.model.values["friction_in_speed_size"] == pytest.approx(0.012 / 3e-5, rel=0.02)
    for error, noise in zip(d.errors, (0.3, 0.005), strict=True):
        assert error.base > 5.0 * noise
        assert error.extended == pytest.approx(noise, rel=0.06)


@pytest.mark.slow
def test_a_bent_sensor_and_an_overflow_of_tanks_are_told_apart() -> None:
    bent = psa.diagnose(tanks(), plants.tanks(3, "sensor"))
    assert _only(bent, "bend_of_level")
    assert bent.causes[0].belongs_to == "sensor"
    over = psa.diagnose(tanks(), plants.tanks(3, "overflow"))
    assert over.verdict in ("cause_named", "partly_explained")
    assert [c.effect for c in over.causes] == ["stop_of_h1_in_h1"]
    assert over.causes[0].explained_share > 0.95


@pytest.mark.slow
def test_clean_records_of_two_inputs_and_outputs_are_adequate() -> None:
    for model, record in ((pair(), plants.pair(4)), (motor(), plants.motor(2, friction=0.0))):
        d = psa.diagnose(model, record)
        assert d.verdict == "adequate"
        assert not d.causes
        assert d.base_fit is d.extended_fit


@pytest.mark.slow
def test_a_cause_that_no_effect_has_is_unexplained() -> None:
    d = psa.diagnose(oscillator(), plants.breathing(4))
    assert d.verdict == "unexplained"
    assert not d.causes
    assert d.extended_fit is d.base_fit


@pytest.mark.slow
@pytest.mark.parametrize("make", [oscillator, tanks, pair])
def test_ports_and_effects_of_gain_0_leave_a_model_as_it_is(make: Callable[[], psa.Model]) -> None:
    model = make()
    runs = runs_of(model, [_quiet(model)], judged=False)
    table = effects_of(model, sizes_of(model, runs))
    assert len({e.name for e in table}) == len(table)
    opened, every = with_ports(model), extended(model, table)
    t, u = runs[0].time, runs[0].inputs
    x0 = np.array([s.start for s in model.structure.states])
    plain = psa.run(model, t, u, x0, rtol=1e-8)
    beside = np.array([s.start for s in every.structure.states])
    assert psa.run(opened, t, u, x0, rtol=1e-8).y == pytest.approx(plain.y, abs=1e-12)
    shown = psa.run(every, t, u, beside, rtol=1e-8).y
    size = np.ptp(plain.y) + np.max(np.abs(plain.y))
    assert np.max(np.abs(shown - plain.y)) < 1e-4 * size  # steps of other lengths


def _quiet(model: psa.Model) -> Signals:
    t = np.linspace(0.0, 4.0, 200)
    columns = {n: 1.0 + 0.5 * np.sin(2.0 * t + k) for k, n in enumerate(model.input_names)}
    return Signals(
        name="quiet", time=t, columns={**columns, **dict.fromkeys(model.output_names, t)}
    )


def test_a_rate_that_is_another_state_is_no_port() -> None:
    places = {(p.kind, p.variable) for p in ports_of(oscillator())}
    assert places == {("input", "force"), ("rate", "v"), ("output", "position")}


def test_the_stiffness_of_an_own_model_is_not_that_of_a_stack() -> None:
    assert "of the stack" not in modelica_text(oscillator(), name="Oscillator")
    assert "static stiffness of the stack" in modelica_text(
        model_named("single_mass"), name="Stack"
    )


def test_records_that_do_not_fit_are_refused_in_sentences(tmp_path: Path) -> None:
    t = np.linspace(0.0, 1.0, 50)
    with pytest.raises(psa.InputError, match=r"lack the input 'force'.*Name the column so"):
        psa.identify(oscillator(), {"time": t, "position": t})
    with pytest.raises(psa.InputError, match=r"no output of the model 'oscillator'"):
        psa.diagnose(oscillator(), {"time": t, "force": t})
    with pytest.raises(psa.InputError, match=r"none named 'time'"):
        psa.identify(oscillator(), {"t": t, "force": t, "position": t})
    with pytest.raises(psa.InputError, match=r"does not strictly increase"):
        psa.identify(oscillator(), {"time": t[::-1], "force": t, "position": t})
    path = tmp_path / "run.csv"
    path.write_text("time,force,position\n" + "0,1,x\n" * 9)
    with pytest.raises(psa.InputError, match=r"'x' is no number"):
        psa.identify(oscillator(), path)
    with pytest.raises(psa.InputError, match=r"'zero_off', which begins no effect"):
        psa.diagnose(
            oscillator(),
            {"time": t, "force": t, "position": t**2},
            leave_out=["zero_off"],
            starts=1,
        )


def test_a_csv_file_and_a_table_are_the_same_record(tmp_path: Path) -> None:
    record = plants.motor(2, friction=0.0)
    table = {"time": record.time[:400], **{n: v[:400] for n, v in record.columns.items()}}
    path = tmp_path / "drive.csv"
    rows = np.column_stack(list(table.values()))
    np.savetxt(path, rows, delimiter=",", header=",".join(table), comments="", fmt="%.17g")
    one, other = (psa.identify(motor(), given, starts=1).model.values for given in (table, path))
    assert one == other
