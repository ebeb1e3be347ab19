"""The reference run and the parameter set inside an FMU."""

import io
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import fmpy
import numpy as np
import numpy.typing as npt
import pytest

from psa_casadi.components import BASE, COMPONENTS
from psa_casadi.effects import EFFECTS
from psa_casadi.export.check.agreement import expected_outputs
from psa_casadi.export.common.parameter_sets import parameter_set
from psa_casadi.export.fmu.archive import export_fmu
from psa_casadi.export.fmu.reference_run import (
    EXPERIMENTS,
    FOLDER,
    INPUTS,
    NOTES,
    OUTPUTS,
    PARAMETERS,
    reference_entries,
)
from psa_casadi.export.importer.masters import Signals
from psa_casadi.model.compose import Model, compose
from psa_casadi.model.stacks import stack_model
from psa_casadi.simulation.stepper import SimulationError
from tests.export.fmu_models import assert_valid, entries, exported, model_named
from tests.tiers import slow_but

STACK = "P-885.51"
Table = Mapping[str, npt.NDArray[np.float64]]

flexure = compose([COMPONENTS["flexure"]], name="flexure")
every_effect = compose((*BASE, *EFFECTS.values()), name="every_effect")


def table(content: bytes) -> Table:
    names, *rows = content.decode().splitlines()
    columns = np.array([[float(v) for v in row.split(",")] for row in rows]).T
    return dict(zip(names.split(","), columns, strict=True))


# Parameter sets


@pytest.mark.parametrize("model", [stack_model(STACK), flexure, every_effect])
def test_parameter_sets_hold_every_value_exactly(model: Model) -> None:
    text = parameter_set(model)
    assert_valid(text, "ssp", "schema", "SystemStructureParameterValues.xsd")
    root = ET.fromstring(text)
    spaces = {"v": root.tag[1:].partition("}")[0]}
    spaces["c"] = spaces["v"].replace("ParameterValues", "Common")
    found = {p.attrib["name"]: p for p in root.iterfind("v:Parameters/v:Parameter", spaces)}
    units = {u.attrib["name"] for u in root.iterfind("v:Units/c:Unit", spaces)}
    assert list(found) == list(model.parameter_names)
    for p in model.structure.parameters:
        real = found[p.name].find("v:Real", spaces)
        assert real is not None
        assert float(real.attrib["value"]) == model.values[p.name]
        assert real.attrib["unit"] == p.unit
        assert p.unit in units


# The reference run


@pytest.mark.parametrize("fmi", [2, 3])
def test_manifest_lists_every_file_as_the_schema_of_the_standard_has_it(fmi: int) -> None:
    """Names, attributes and roles as FMI-LS-REF 1.0.0-beta.1 and the Experiments Format have them.

    Its schema knows no other attribute of a file than these four.
    """
    inside = entries(STACK, fmi)
    root = ET.fromstring(inside[f"{FOLDER}/fmi-ls-manifest.xml"])
    space = "{http://fmi-standard.org/fmi-ls-manifest}"
    assert root.tag == "fmiReferences"
    assert root.attrib[f"{space}fmi-ls-name"] == "org.fmi-standard.fmi-ls-ref"
    assert root.attrib[f"{space}fmi-ls-version"] == "1.0.0-beta.1"
    assert len(root.attrib) == 3
    roles = {}
    for related in root:
        path = f"{FOLDER}/{related.attrib['source']}".replace(f"{FOLDER}/../../", "")
        assert related.tag == "Related"
        assert set(related.attrib) == {"type", "source", "role", "description"}
        assert path in inside
        roles[path] = related.attrib["role"]
    own = {n for n in inside if n.startswith(FOLDER)} - {f"{FOLDER}/fmi-ls-manifest.xml"}
    assert set(roles) == {*own, NOTES}
    assert roles[f"{FOLDER}/{EXPERIMENTS}"] == "experiment/smoke-test"
    assert roles[f"{FOLDER}/{PARAMETERS}"] == "parameter"
    assert roles[f"{FOLDER}/{OUTPUTS}"] == "result"
    (experiment,) = ET.fromstring(inside[f"{FOLDER}/{EXPERIMENTS}"])
    assert {e.tag: e.attrib["source"] for e in experiment} == {
        "Parameters": PARAMETERS, "Stimuli": INPUTS, "References": OUTPUTS,
    }  # fmt: skip
    times = table(inside[f"{FOLDER}/{OUTPUTS}"])["time"]
    assert float(experiment.attrib["startTime"]) == times[0] == 0.0
    assert float(experiment.attrib["stopTime"]) == times[-1]
    assert float(experiment.attrib["stepSize"]) == pytest.approx(np.diff(times), rel=1e-6)
    assert set(table(inside[f"{FOLDER}/{INPUTS}"])["time"]) == set(times)


def _signals(inputs: Table) -> Signals:
    names = tuple(n for n in inputs if n != "time")
    return Signals(names, inputs["time"], np.array([inputs[n] for n in names]).T)


def _kinks(signals: Signals) -> Signals:
    """Return the signals between their kinks only, every hundredth row."""
    return Signals(signals.names, signals.times[::100], signals.values[::100])


def _errors(found: npt.NDArray[np.float64], expected: Table) -> dict[str, float]:
    """Return the largest difference of each output as a share of its range."""
    names = [n for n in expected if n != "time"]
    return {
        n: float(np.max(np.abs(column - expected[n])) / np.ptp(expected[n]))
        for n, column in zip(names, found.T, strict=True)
    }


@pytest.mark.parametrize(
    "name", slow_but([STACK, "single_mass"], ["PTBS200", STACK, "manipulator", "single_mass"])
)
def test_reference_outputs_agree_with_the_independent_reference(name: str) -> None:
    model = model_named(name).plant()
    inside = reference_entries(model, {})
    inputs, outputs = (table(inside[f"{FOLDER}/{n}"]) for n in (INPUTS, OUTPUTS))
    truth = expected_outputs(model, outputs["time"], _kinks(_signals(inputs)))
    assert max(_errors(truth, outputs).values()) < 1e-6


@pytest.mark.parametrize("fmi", [2, 3])
def test_fmpy_meets_the_reference_outputs_as_the_notes_say(fmi: int) -> None:
    """It holds the inputs over a communication step in FMI 2 and 3: late by half a step."""
    inside = entries(STACK, fmi)
    names = ("charge", "displacement", "blocked_force")
    inputs, outputs = (
        np.genfromtxt(io.BytesIO(inside[f"{FOLDER}/{n}"]), delimiter=",", names=True)
        for n in (INPUTS, OUTPUTS)
    )
    step, end = float(inputs["time"][1]), float(inputs["time"][-1])
    found: Any = fmpy.simulate_fmu(
        str(exported(STACK, fmi)), fmi_type="CoSimulation", input=inputs, stop_time=end,
        output_interval=step, relative_tolerance=1e-6, output=list(names),
    )  # fmt: skip
    assert found["time"] == pytest.approx(outputs["time"], abs=1e-3 * step)
    for name in names:
        error = np.max(np.abs(found[name] - outputs[name])) / np.ptp(outputs[name])
        assert 1e-3 < error < 1e-2, name


@pytest.mark.usefixtures("without_binary")
def test_a_model_that_cannot_be_simulated_is_exported_without_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise SimulationError("no")

    monkeypatch.setattr("psa_casadi.export.fmu.reference_run.run", fails)
    with zipfile.ZipFile(export_fmu(flexure, tmp_path / "m.fmu", fmi=3)) as archive:
        names = set(archive.namelist())
        page = archive.read("documentation/index.html").decode()
    assert not any(n.startswith("extra/") for n in names)
    assert NOTES not in names
    assert all(link.removeprefix("../") in names for link in re.findall(r'href="([^"]*)"', page))
