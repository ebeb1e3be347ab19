"""The evidence inside an FMU: page, meta data, run, parameter sets, and who lists them."""

import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from typer.testing import CliRunner

import psa_casadi as psa
from psa_casadi.cli.app import app
from psa_casadi.export.check.evidence import repeated
from psa_casadi.export.check.measured import Playback, played_again
from psa_casadi.export.fmu import evidence
from psa_casadi.export.fmu.reference_run import FOLDER
from psa_casadi.export.importer.fmu import Fmu
from tests.evidence_models import evident_fmu, evident_model, files_inside, noisy_record
from tests.fmu_models import assert_valid


def test_the_manifest_tells_the_role_of_every_file_of_evidence() -> None:
    found = files_inside(evident_fmu())
    root = ET.fromstring(found[f"{FOLDER}/fmi-ls-manifest.xml"])
    roles = {}
    for related in root:
        source = related.attrib["source"]
        place = source.removeprefix("../../") if source.startswith("..") else f"{FOLDER}/{source}"
        assert place in found
        roles[place] = related.attrib["role"]
    assert roles[evidence.PAGE] == "report"
    assert roles[evidence.META_DATA] == "meta-data"
    assert roles[evidence.VALIDATION] == "experiment/validation"
    assert roles[evidence.UNCERTAINTY] == "experiment/uncertainty-analysis"
    assert roles[evidence.START] == roles[f"{evidence.SETS}/mean.ssv"] == "parameter"
    assert {n for n in found if n.startswith("extra/")} - set(roles) == {
        f"{FOLDER}/fmi-ls-manifest.xml"
    }


def test_experiments_name_files_that_are_there() -> None:
    found = files_inside(evident_fmu())
    (whole,) = ET.fromstring(found[evidence.VALIDATION])
    spread = ET.fromstring(found[evidence.UNCERTAINTY])
    assert [e.tag for e in whole] == ["Parameters", "Stimuli", "References"]
    assert len(spread) == 1 + 2 * 3 + 2  # the mean, pairs of three parameters, two samples
    for experiment in (whole, *spread):
        assert all(f"{FOLDER}/{e.attrib['source']}" in found for e in experiment)


def test_meta_data_and_page_say_the_same() -> None:
    """Names and order as the schema of SSP Traceability 1.0 has them (SRMD.xsd, STC.xsd)."""
    found, model = files_inside(evident_fmu()), evident_model()
    root = ET.fromstring(found[evidence.META_DATA])
    space = "{http://ssp-standard.org/SSPTraceability1/%s}"
    assert root.tag == space % "SimulationResourceMetaData" + "SimulationResourceMetaData"
    assert set(root.attrib) == {"version", "name", "generationTool"}
    entries: dict[str, list[str]] = {}
    for part in root:
        assert part.tag == space % "SSPTraceabilityCommon" + "Classification"
        assert set(part.attrib) == {"type"}
        for entry in part:
            assert entry.tag == space % "SSPTraceabilityCommon" + "ClassificationEntry"
            entries.setdefault(entry.attrib["keyword"], []).append(entry.text or "")
    page = found[evidence.PAGE].decode()
    assert model.evidence is not None
    assert model.evidence.held_out is not None
    (record,) = entries["record"]
    assert noisy_record().sha256 in record
    assert f"{1e6 * model.evidence.held_out.rms_m:.4g} um rms" in entries["held-out error"][0]
    assert entries["temperature"] == ["not recorded"]
    row = [float(v) for v in entries["covariance.A"][0].split()]
    assert row == list(model.evidence.covariance.matrix[1])
    assert re.fullmatch(r"[\d.]+ N/V, standard error [\d.e-]+", entries["k_L"][0])
    for keyword in ("record", "held-out error", "voltage", "duration", "k_L"):
        assert entries[keyword][0] in page
    assert all(link in ("index.html",) for link in re.findall(r'href="([^"]*)"', page))
    assert "../documentation/evidence.html" in found["documentation/index.html"].decode()


def test_meta_data_say_who_publishes_the_model() -> None:
    by = psa.Publication(author="A. N. Other", version="2.1", license="CC BY 4.0")
    root = ET.fromstring(evidence.meta_data(replace(evident_model(), publication=by)))
    assert {n: root.attrib[n] for n in ("author", "fileversion", "license", "version")} == {
        "author": "A. N. Other", "fileversion": "2.1", "license": "CC BY 4.0", "version": "1.0.0",
    }  # fmt: skip


def test_parameter_sets_are_as_their_schema_has_them() -> None:
    found = files_inside(evident_fmu())
    sets = [n for n in found if n.endswith(".ssv")]
    assert len(sets) == 9 + 2
    for name in sets:
        assert_valid(found[name].decode(), "ssp", "schema", "SystemStructureParameterValues.xsd")
    names = re.findall(
        r'Parameter name="(\w+)"', found[f"{evidence.SETS}/sigma_02_minus.ssv"].decode()
    )
    assert names == ["k_L", "A", "tau"]


def test_a_model_without_evidence_has_no_such_files() -> None:
    assert evidence.evidence_files(psa.stack_model("demo"), 20).entries == {}
    none = evidence.evidence_files(evident_model().plant(), 0)
    assert not [n for n in none.entries if n.startswith(evidence.SETS)]
    assert evidence.UNCERTAINTY not in none.related


def test_what_a_person_says_of_a_record_stays_text() -> None:
    """A record's name may hold what means something in HTML and XML."""
    model = evident_model().plant()
    told = model.evidence
    assert told is not None
    assert told.reference is not None
    name = "<b>&\"'"
    odd = replace(
        told,
        runs=(replace(told.runs[0], record=name),),
        reference=replace(told.reference, record=name),
    )
    texts = evidence.evidence_texts(replace(model, evidence=odd), 0)
    assert "&lt;b&gt;&amp;" in texts[evidence.PAGE]
    assert "<b>" not in texts[evidence.PAGE]
    read = "".join(ET.fromstring(texts[evidence.META_DATA]).itertext())
    assert f"{name}, sha256" in read


def test_a_file_is_no_folder_for_sets(tmp_path: Path) -> None:
    place = tmp_path / "taken"
    place.write_text("")
    line = f"export fmu --stack demo -o {tmp_path / 'm.fmu'} --sets-to {place}"
    said = CliRunner().invoke(app, line.split())  # ends before anything is compiled
    assert said.exit_code != 0
    assert not (tmp_path / "m.fmu").exists()
    assert "name a folder for the parameter sets" in " ".join(said.output.split())


@pytest.mark.slow
def test_the_command_writes_sets_and_tells_what_is_files_inside(tmp_path: Path) -> None:
    psa.save_model(evident_model(), tmp_path / "m.json")
    path, sets = tmp_path / "m.fmu", tmp_path / "sets"
    line = f"export fmu --model {tmp_path / 'm.json'} -o {path} --include-sensor"
    said = CliRunner().invoke(app, f"{line} --parameter-sets 1 --sets-to {sets}".split())
    assert said.exit_code == 0, said.output
    assert "documentation/evidence.html (records: short), 8 parameter sets" in said.output
    found = files_inside(path)
    assert len(list(sets.iterdir())) == 8
    for file in sets.iterdir():
        assert found[f"{evidence.SETS}/{file.name}"] == file.read_bytes()
    with Fmu(path) as fmu:  # with the sensor, whose reading is compared then
        playback = repeated(fmu, evident_model(), [noisy_record()])[-1]
        assert isinstance(playback, Playback)
        assert playback.output == "measured_displacement"
        assert played_again(fmu, playback).figure < 1e-4
