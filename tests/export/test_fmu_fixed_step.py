"""FMUs with a fixed step: results, communication steps, states, parameters, description."""

import json
import zipfile
from functools import cache
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from fmpy.validation import validate_fmu

import psa_casadi as psa
from psa_casadi.export.fixed_step.probe import VOLTAGES
from psa_casadi.export.fmu.archive import write_archive
from psa_casadi.export.fmu.documentation import ENTRY as DOCUMENTATION_ENTRY
from psa_casadi.export.fmu.sources import FIXED_ENTRY, STRICT
from psa_casadi.export.importer.fmu import CO_SIMULATION, Fmu, FmuError
from psa_casadi.export.importer.masters import Signals, co_simulate
from psa_casadi.files import temporary_folder
from psa_casadi.report.words.text import check_sentence
from psa_casadi.simulation.compiler import compiler_command, run_compiler
from tests.export.c_host.build import HEADERS
from tests.export.fmu_models import rewritten
from tests.model.stack_models import stack
from tests.simulation.exact_cases import error
from tests.tiers import slow

STEP, SAMPLES = 1e-5, 401
VERSIONS = (2, pytest.param(3, marks=slow))


@cache
def archived(fmi: int) -> bytes:
    """Return the file of an FMU of a stack with a fixed step."""
    with temporary_folder() as folder:
        path = psa.export_fmu(stack("P-885.51"), folder / "fixed.fmu", fmi=fmi, step=STEP)
        return path.read_bytes()


def written(fmi: int, folder: Path) -> Path:
    """Return the path of a copy of `archived`."""
    (folder / "fixed.fmu").write_bytes(archived(fmi))
    return folder / "fixed.fmu"


@cache
def exported(fmi: int) -> Fmu:
    """Return a loaded one; its file is gone."""
    with temporary_folder() as folder:
        return Fmu(written(fmi, folder))


@pytest.mark.parametrize("every", [pytest.param(1, marks=slow), 5])
def test_communication_steps_are_one_step_or_several(every: int) -> None:
    """FMI 2 passes on the slope of the inputs."""
    times = STEP * np.arange(SAMPLES, dtype=np.float64)[::every]
    voltage = 100.0 * VOLTAGES["tones"][1](np.linspace(0.0, 1.0, SAMPLES))[::every]
    inputs = Signals(("voltage",), times, voltage[:, None])
    found = co_simulate(exported(2), times, inputs, ("displacement",))[:, 0]
    model = stack("P-885.51").plant()
    true = psa.simulate(model, times, voltage, as_exported=True, rtol=1e-8, hold="linear")
    assert error(found, true.outputs["displacement"]) <= 5e-5


@pytest.mark.parametrize("fmi", VERSIONS)
def test_other_communication_steps_are_refused(fmi: int) -> None:
    with exported(fmi).start(CO_SIMULATION) as slave:
        slave.step(0.0, 3 * STEP)
        for size in (0.5 * STEP, 1.5 * STEP, 1.01 * STEP):
            with pytest.raises(FmuError, match="no multiple of 1e-05 s, the fixed step"):
                slave.step(3 * STEP, size)
        slave.step(3 * STEP, 0.3)
        assert slave.get(["time"])[0] == pytest.approx(0.3 + 3 * STEP, abs=1e-12)


@pytest.mark.parametrize("fmi", VERSIONS)
def test_parameters_cannot_be_set(fmi: int) -> None:
    with exported(fmi).start(CO_SIMULATION) as slave:
        with pytest.raises(FmuError, match="'k_L' is constant"):
            slave.set({"k_L": 5.0})
        assert slave.get(["k_L"])[0] == stack("P-885.51").values["k_L"]


@pytest.mark.parametrize("fmi", VERSIONS)
def test_the_description_says_what_it_is(fmi: int, tmp_path: Path) -> None:
    path = written(fmi, tmp_path)
    again = psa.export_fmu(stack("P-885.51"), tmp_path / "again.fmu", fmi=fmi, step=STEP)
    assert path.read_bytes() == again.read_bytes()
    assert list(validate_fmu(str(path))) == []
    with zipfile.ZipFile(path) as archive:
        root = ET.fromstring(archive.read("modelDescription.xml"))
        page = archive.read(DOCUMENTATION_ENTRY)
        archive.extractall(tmp_path / "unpacked")
    assert b"A communication step is a multiple of it" in page
    assert b"Parameters are tunable" not in page
    assert root.find("ModelExchange") is None
    assert "fixed step of 1e-05 s" in root.attrib["description"]
    stepping, variables = root.find("CoSimulation"), root.find("ModelVariables")
    assert stepping is not None
    assert stepping.get("fixedInternalStepSize") == ("1e-05" if fmi == 3 else None)
    claimed = stepping.get("canHandleVariableCommunicationStepSize")
    assert claimed == (None if fmi == 2 else "true")
    assert variables is not None
    constants = {v.get("name") for v in variables if v.get("variability") == "constant"}
    assert constants == set(stack("P-885.51").plant().values)
    sources = sorted((tmp_path / "unpacked" / "sources").glob("*.c"))
    options = ["-std=c99", *STRICT, f"-I{HEADERS}", f"-I{sources[0].parent}", "-c"]
    for source in (s for s in sources if s.name in ("instance.c", "fmi_data.c", "values.c")):
        run_compiler([*compiler_command(), *options, str(source), "-o", "object.o"], tmp_path)
    with pytest.raises(psa.InputError, match="takes fixed steps of 1e-05 s and carries no evid"):
        psa.check_fmu(path, evidence=True)


@slow
def test_the_check_finds_the_errors_that_it_states(tmp_path: Path) -> None:
    """On the voltages behind them; what means nothing there is left out, and said."""
    fmi = 3
    path = written(fmi, tmp_path)
    report = psa.check_fmu(path)
    assert report.passed, report.failures
    assert report.compared
    figures = {row.name: row.figure for row in report.rows}
    with zipfile.ZipFile(path) as archive:
        errors: dict[str, float] = json.loads(archive.read(FIXED_ENTRY))["errors"]
    for voltage, stated in errors.items():
        assert figures[f"fixed step, {voltage}"] == pytest.approx(stated, rel=0.06, abs=1e-8)
    names = {"life cycle", "snapshots", "line of the input", "start of a run", "settled start"}
    assert names < figures.keys()
    assert {"equations", "model exchange", "parameter changes"} < set(report.left_out)
    assert ("adjoint derivatives" in report.left_out) == (fmi == 3)
    assert figures.keys().isdisjoint(report.left_out)
    assert "Left out, as its step is fixed: model exchange inst" in check_sentence(report)


@slow
def test_the_check_notices_smaller_errors_than_there_are(tmp_path: Path) -> None:
    def boast(content: bytes) -> bytes:
        stated = json.loads(content)
        stated["errors"] = {name: 0.8 * error for name, error in stated["errors"].items()}
        return json.dumps(stated).encode()

    changed = rewritten(written(2, tmp_path), tmp_path / "b.fmu", {FIXED_ENTRY: boast})
    failed = {row.name for row in psa.check_fmu(changed).failures}
    assert {"reproducible", "fixed step, tones", "fixed step, jumps"} <= failed
    assert "fixed step, ramps and holds, 10 at once" not in failed
    for nothing in (b"{}", b'{"errors": {"sine": "x"}}', b"no JSON"):
        with zipfile.ZipFile(changed) as archive:
            entries = {n: archive.read(n) for n in archive.namelist()}
        write_archive(tmp_path / "c.fmu", {**entries, FIXED_ENTRY: nothing})
        with pytest.raises(psa.InputError, match=r"fixed_step\.json.*xport the FMU again"):
            psa.check_fmu(tmp_path / "c.fmu")
