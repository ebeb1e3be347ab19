"""Exports: FMUs in fmpy against the independent reference, Modelica, C, SSP, FMUs that are read."""

import ctypes
import json
import shutil
import subprocess
import zipfile
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import fmpy
import numpy as np
import pytest
import rumoca
from fmpy.fmi2 import FMU2Slave
from fmpy.ssp.simulation import simulate_ssp
from fmpy.ssp.ssd import read_ssd
from fmpy.validation import validate_fmu

import psa_casadi as psa
from psa_casadi import reference
from tests.contract.helpers import Floats, done, off, reference_run, refused, samples
from tests.contract.test_models import van_der_pol
from tests.tiers import slow

STACK = "P-885.51"


@cache
def fmu_of(fmi: int) -> Path:
    """Return the FMU of a stack, written by the command once for all tests."""
    path = Path(mkdtemp()) / f"stack{fmi}.fmu"
    done("export", "fmu", "--stack", STACK, "--fmi", str(fmi), "-o", path, "--quiet")
    return path


def played(path: Path, time: Floats, inputs: Mapping[str, Floats], **more: Any) -> Any:
    """Return what fmpy makes of an FMU whose inputs are lines between samples."""
    return fmpy.simulate_fmu(
        str(path), fmi_type="CoSimulation", input=samples(time=time, **inputs),
        stop_time=float(time[-1]), relative_tolerance=1e-8, output_interval=float(time[1]), **more,
    )  # fmt: skip


def displacement(time: Floats, result: Any) -> Floats:
    return np.asarray(np.interp(time, result["time"], result["displacement"]))


@pytest.mark.parametrize("fmi", [2, 3])
def test_an_fmu_is_valid_and_describes_its_ports(fmi: int) -> None:
    assert validate_fmu(str(fmu_of(fmi))) == []
    description = fmpy.read_model_description(str(fmu_of(fmi)))
    assert description.fmiVersion == ("2.0" if fmi == 2 else "3.0")
    for interface in (description.coSimulation, description.modelExchange):
        assert interface.modelIdentifier == "P_885_51"
    variables = {v.name: v for v in description.modelVariables}
    inputs = [v.name for v in description.modelVariables if v.causality == "input"]
    outputs = {v.name: v.unit for v in description.modelVariables if v.causality == "output"}
    assert inputs == ["voltage", "load_force"]
    assert outputs == {
        "current": "A", "charge": "C", "displacement": "m", "velocity": "m/s", "blocked_force": "N",
    }  # fmt: skip
    for name, value in psa.stack_model(STACK).plant().values.items():
        assert float(variables[name].start) == value
        assert variables[name].causality == "parameter"
    assert "measured_displacement" not in variables


def test_an_fmu_with_input_derivatives_agrees_with_the_independent_reference(
    tmp_path: Path,
) -> None:
    time, voltage, expected = reference_run()
    description = fmpy.read_model_description(str(fmu_of(2)))
    numbers = {v.name: v.valueReference for v in description.modelVariables}
    unpacked = fmpy.extract(str(fmu_of(2)), str(tmp_path))
    slave = FMU2Slave(
        guid=description.guid, unzipDirectory=unpacked, instanceName="one",
        modelIdentifier=description.coSimulation.modelIdentifier,
    )  # fmt: skip
    slave.instantiate()
    slave.setupExperiment(startTime=0.0, tolerance=1e-9)
    slave.enterInitializationMode()
    slave.exitInitializationMode()
    result, steps = [], np.diff(time)
    for k, step in enumerate(steps):
        slave.setReal([numbers["voltage"]], [voltage[k]])
        slope = (voltage[k + 1] - voltage[k]) / step
        slave.setRealInputDerivatives([numbers["voltage"]], [1], [slope])
        slave.doStep(currentCommunicationPoint=time[k], communicationStepSize=step)
        result.append(slave.getReal([numbers["displacement"], numbers["blocked_force"]]))
    slave.terminate()
    slave.freeInstance()
    x, force = np.array(result).T
    assert off(x, expected.displacement[1:]) < 1e-6
    assert off(force, expected.blocked_force[1:]) < 1e-6


@pytest.mark.parametrize("fmi", [2, 3])
def test_an_fmu_whose_inputs_are_held_comes_to_the_reference(fmi: int) -> None:
    time, voltage, expected = reference_run()
    errors = []
    for parts in (4, 16):
        fine = np.linspace(0.0, time[-1], parts * (time.size - 1) + 1)
        result = played(fmu_of(fmi), fine, {"voltage": np.interp(fine, time, voltage)})
        errors.append(off(displacement(time, result), expected.displacement))
    assert errors[1] == pytest.approx(errors[0] / 4.0, rel=0.1)
    assert errors[1] < 1e-3


@pytest.mark.parametrize("fmi", [2, 3])
def test_parameters_and_loads_of_an_fmu_act_as_in_the_model(fmi: int) -> None:
    time = np.linspace(0.0, 5e-3, 501)
    inputs = {"voltage": np.full(501, 60.0), "load_force": np.full(501, -32.0)}
    values = {"k_L": 6.0, "m_B": 0.2}
    result = played(fmu_of(fmi), time, inputs, start_values=values)
    model = psa.stack_model(STACK).with_values(values).plant()
    u, x0 = np.column_stack([*inputs.values()]), np.zeros(len(model.state_names))
    y = psa.run(model, time, u, x0, rtol=1e-8).y[:, model.output_names.index("displacement")]
    assert off(displacement(time, result), y) < 1e-5


def test_options_name_an_fmu_and_keep_the_sensor(tmp_path: Path) -> None:
    model = psa.stack_model(STACK).with_effect(psa.EFFECTS["sensor_nonlinearity"])
    psa.save_model(model, tmp_path / "m.json")
    base = ("export", "fmu", "--model", tmp_path / "m.json", "-o", tmp_path / "x.fmu")
    assert "sensor_nonlinearity" in done(*base, "--name", "my_stack").out
    description = fmpy.read_model_description(str(tmp_path / "x.fmu"))
    assert description.coSimulation.modelIdentifier == "my_stack"
    assert not [v.name for v in description.modelVariables if v.name.startswith("nonlinearity")]
    done(*base, "--include-sensor", "--author", "A. N. Other", "--version", "4.2")
    description = fmpy.read_model_description(str(tmp_path / "x.fmu"))
    names = [v.name for v in description.modelVariables]
    assert "measured_displacement" in names
    assert "nonlinearity_angle" in names
    assert (description.author, description.version) == ("A. N. Other", "4.2")


def test_the_same_model_gives_the_same_bytes_and_carries_itself(tmp_path: Path) -> None:
    one, two = (psa.export_fmu(van_der_pol(), tmp_path / f"{k}.fmu") for k in (1, 2))
    assert one.read_bytes() == two.read_bytes()
    with zipfile.ZipFile(fmu_of(2)) as archive:
        inside = json.loads(archive.read("resources/model.json"))
        names = archive.namelist()
    assert inside["format"] == "psa_casadi.model/1"
    assert inside["parameters"]["k_L"]["value"] == psa.stack_model(STACK).values["k_L"]
    for part in ("modelDescription.xml", "model.png", "documentation/index.html"):
        assert part in names
    assert any(n.startswith("sources/") and n.endswith(".c") for n in names)


@slow
@pytest.mark.parametrize("fmi", [2, 3])
def test_a_check_passes_and_writes_its_rows(fmi: int, tmp_path: Path) -> None:
    passed = done("check", fmu_of(fmi), "--stack", STACK, "--json", tmp_path / "c.json",
                  "--junit", tmp_path / "c.xml")  # fmt: skip
    assert "FAIL" not in passed.out
    assert '"psa_casadi.check/1"' in (tmp_path / "c.json").read_text("utf-8")
    assert 'failures="0"' in (tmp_path / "c.xml").read_text("utf-8")


def test_a_step_of_fixed_length_is_exported_for_co_simulation(tmp_path: Path) -> None:
    path = tmp_path / "fixed.fmu"
    done("export", "fmu", "--stack", STACK, "--solver", "fixed", "--step", "100us", "-o", path)
    description = fmpy.read_model_description(str(path))
    assert description.modelExchange is None
    assert float(description.defaultExperiment.stepSize) == 1e-4
    time, voltage, expected = reference_run()
    result = played(path, time, {"voltage": voltage}, step_size=2e-4)
    assert off(displacement(time, result), expected.displacement) < 0.02
    assert "--step" in refused("export", "fmu", "--stack", STACK, "--solver", "fixed", "-o", path)


@pytest.mark.parametrize("precision", ["double", "single"])
def test_c_for_a_controller_errs_as_little_as_stated(precision: str, tmp_path: Path) -> None:
    compiler = shutil.which("cc") or pytest.skip("no C compiler")
    text = done("export", "c", "--stack", STACK, "--step", "200us", "--name", "stack",
                "--precision", precision, "-o", tmp_path / "code").out  # fmt: skip
    assert "substeps" in text or "%" in text
    time, voltage, expected = reference_run()
    (tmp_path / "code" / "play.c").write_text(
        '#include "stack.h"\n'
        "void play(int n, const double *v, double *x) {\n"
        "    stack_state state; stack_input input = {0}; stack_output output;\n"
        "    stack_init(&state);\n"
        "    for (int k = 0; k < n; ++k) {\n"
        "        input.voltage = v[k];\n"
        "        stack_step(&state, &input, &output);\n"
        "        x[k] = output.displacement;\n"
        "    }\n"
        "}\n"
    )
    library = tmp_path / "play.so"
    subprocess.run(
        [compiler, "-std=c99", "-Wall", "-Werror", "-O1", "-shared", "-fPIC", "-o", library,
         "play.c", "stack.c", "-lm"],
        cwd=tmp_path / "code", check=True,
    )  # fmt: skip
    result = np.zeros(time.size - 1)
    inputs = np.ascontiguousarray(voltage[1:])
    double = ctypes.POINTER(ctypes.c_double)
    ctypes.CDLL(str(library)).play(
        len(inputs), inputs.ctypes.data_as(double), result.ctypes.data_as(double)
    )
    assert off(result, expected.displacement[1:]) < 1e-3


def test_modelica_has_the_equations_for_another_compiler(tmp_path: Path) -> None:
    """Rumoca, an independent compiler, runs it to the reference's displacement."""
    model = psa.stack_model(STACK)
    path = psa.export_modelica(model, tmp_path / "PiezoStack.mo")
    text = path.read_text("utf-8")
    stop = 0.02
    harness = (
        f"{text}\nmodel Harness PiezoStack.Signal psa(voltage=2500.0*time, load_force=0.0);"
        " end Harness;"
    )
    config = rumoca.SimConfig(solver="bdf", rtol=1e-10, atol=1e-16, dt=stop / 100)
    run = rumoca.Session().loads(harness, model="Harness").simulate(t=(0.0, stop), config=config)
    time = np.asarray(run.time)
    expected = reference.simulate(model.values, lambda t: 2500.0 * t, time)
    assert off(np.asarray(run["psa.displacement"]), expected.displacement) < 1e-5


@slow
def test_a_closed_loop_runs_as_ssp_as_it_does_as_one_model(tmp_path: Path) -> None:
    archive, picture = tmp_path / "stage.ssp", tmp_path / "wiring.svg"
    text = done("export", "ssp", "-o", archive, "--picture", picture).out
    assert "give one of its FMUs ('amplifier.fmu', " in refused("check", archive)
    parts = [c.name for c in read_ssd(str(archive)).system.elements]
    assert parts == ["controller", "compensator", "amplifier", "stack", "flexure"]
    assert "reference" in text
    assert "controller" in picture.read_text("utf-8")
    result = simulate_ssp(
        str(archive), stop_time=2e-3, step_size=2.5e-6,
        input={"reference": lambda t: 4e-6 * (1 - np.cos(500 * np.pi * t))},
    )  # fmt: skip
    model = psa.nanopositioner(STACK).model()
    time = np.linspace(0.0, 2e-3, 801)
    wanted = 4e-6 * (1 - np.cos(500 * np.pi * time))
    inputs = np.array([[w if n == "reference" else 0.0 for n in model.input_names] for w in wanted])
    starts = np.array([s.start for s in model.structure.states])
    whole = psa.run(model, time, inputs, starts, hold="linear")
    expected = whole.y[:, model.output_names.index("stage_position")]
    position = np.interp(time, result["time"], result["stage_position"])
    assert off(position, expected) < 0.005


def test_an_fmu_of_a_users_model_is_read_back_and_runs_equally(tmp_path: Path) -> None:
    path = psa.export_fmu(van_der_pol(), tmp_path / "v.fmu", fmi=3)
    assert "has no input of the model" in refused("check", path, "--stack", STACK)
    read = psa.fmu_model(path, free={"mu": (0.1, 10.0)}, values={"mu": 2.3})
    time = np.linspace(0.0, 10.0, 501)
    nothing, start = np.empty((501, 0)), np.array([2.0, 0.0])
    one = psa.run(van_der_pol().with_values({"mu": 2.3}), time, nothing, start, rtol=1e-8)
    result = psa.run(read, time, nothing, start, rtol=1e-8)
    np.testing.assert_allclose(result.y, one.y, atol=1e-5)
    assert read.output_names == ("position",)
    with pytest.raises(psa.InputError, match="FMU"):
        psa.export_fmu(read, tmp_path / "again.fmu")


def test_a_part_is_tuned_to_a_stack(tmp_path: Path) -> None:
    stack = ("--stack", "P-885.51")
    done("export", "fmu", "--part", "hysteresis_observer", *stack, "-o", tmp_path / "x.fmu")
    tuned = psa.part_for("hysteresis_observer", psa.stack_model("P-885.51")).values
    assert tuned != psa.part_model("hysteresis_observer").values
    description = fmpy.read_model_description(str(tmp_path / "x.fmu"))
    starts = {v.name: v.start for v in description.modelVariables if v.causality == "parameter"}
    assert {n: float(starts[n] or 0) for n in tuned} == pytest.approx(tuned)
    plain = ("export", "modelica", "--part", "flexure_stage", "-o", tmp_path / "x.mo")
    assert "not tuned to a stack" in refused(*plain, *stack)


@pytest.mark.parametrize("part", ["flexure_stage", "position_controller", "charge_amplifier"])
def test_parts_are_exported(part: str, tmp_path: Path) -> None:
    done("export", "fmu", "--part", part, "-o", tmp_path / "x.fmu")
    assert validate_fmu(str(tmp_path / "x.fmu")) == []
    done("export", "modelica", "--part", part, "-o", tmp_path / "x.mo", "--name", "Part")
    values = psa.part_model(part).values
    description = fmpy.read_model_description(str(tmp_path / "x.fmu"))
    starts = {v.name: v.start for v in description.modelVariables if v.causality == "parameter"}
    assert {n: float(starts[n]) for n in values} == dict(values)


@slow
def test_an_fmu_holds_binaries_of_other_platforms(tmp_path: Path) -> None:
    pytest.importorskip("ziglang")
    path = tmp_path / "x.fmu"
    done("export", "fmu", "--stack", STACK, "--platforms", "x86_64-linux,x86_64-windows",
         "-o", path)  # fmt: skip
    with zipfile.ZipFile(path) as archive:
        binaries = {n: archive.read(n)[:4] for n in archive.namelist() if "binaries/" in n}
    assert binaries["binaries/linux64/P_885_51.so"] == b"\x7fELF"
    assert binaries["binaries/win64/P_885_51.dll"][:2] == b"MZ"
    done("check", path, "--portable")
