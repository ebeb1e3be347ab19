"""The reference run and the parameter set inside an FMU."""

import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import numpy.typing as npt
import pytest

import psa_casadi as psa
from psa_casadi.export.check.agreement import expected_outputs
from psa_casadi.export.common.parameter_sets import parameter_set
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
from psa_casadi.simulation.stepper import SimulationError
from tests.export.fmu_models import assert_valid, entries, model_named
from tests.tiers import slow_but

STACK = "P-885.51"
Table = Mapping[str, npt.NDArray[np.float64]]

flexure = psa.compose([psa.COMPONENTS["flexure"]], name="flexure")
every_effect = psa.compose((*psa.BASE, *psa.EFFECTS.values()), name="every_effect")


def table(content: bytes) -> Table:
    names, *rows = content.decode().splitlines()
    columns = np.array([[float(v) for v in row.split(",")] for row in rows]).T
    return dict(zip(names.split(","), columns, strict=True))


# Parameter sets


@pytest.mark.parametrize("model", [psa.stack_model(STACK), flexure, every_effect])
def test_parameter_sets_hold_every_value_exactly(model: psa.Model) -> None:
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


@pytest.mark.parametrize(
    "name", slow_but([STACK, "single_mass"], ["PTBS200", STACK, "manipulator", "single_mass"])
)
def test_reference_outputs_agree_with_the_independent_reference(name: str) -> None:
    model = model_named(name).plant()
    inside = reference_entries(model, {})
    inputs, outputs = (table(inside[f"{FOLDER}/{n}"]) for n in (INPUTS, OUTPUTS))
    kinks = {name: column[::100] for name, column in inputs.items()}
    times = kinks.pop("time")
    signals = Signals(tuple(kinks), times, np.column_stack(list(kinks.values())))
    truth = expected_outputs(model, outputs["time"], signals)
    for column, (output, found) in zip(truth.T, list(outputs.items())[1:], strict=True):
        assert np.max(np.abs(column - found)) < 1e-6 * np.ptp(found), output


@pytest.mark.usefixtures("without_binary")
def test_a_model_that_cannot_be_simulated_is_exported_without_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise SimulationError("no")

    monkeypatch.setattr("psa_casadi.export.fmu.reference_run.run", fails)
    with zipfile.ZipFile(psa.export_fmu(flexure, tmp_path / "m.fmu", fmi=3)) as archive:
        names = set(archive.namelist())
        page = archive.read("documentation/index.html").decode()
    assert not any(n.startswith("extra/") for n in names)
    assert NOTES not in names
    assert all(link.removeprefix("../") in names for link in re.findall(r'href="([^"]*)"', page))
