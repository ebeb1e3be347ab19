"""The evidence inside an FMU: page, meta data, run, parameter sets, and who lists them.

The output of an FMU outside of the range of its model's records, and `psa check
--evidence`, which plays run and records again.
"""

import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.export.check.agreement import Playback, played_again
from psa_casadi.export.check.evidence import repeated, wrong_evidence
from psa_casadi.export.check.rows import CheckRow
from psa_casadi.export.fmu import evidence
from psa_casadi.export.fmu.evidence import seen_inputs, with_validity
from psa_casadi.export.fmu.reference_run import FOLDER
from psa_casadi.export.importer.archive import Archive
from psa_casadi.export.importer.fmu import CO_SIMULATION, Fmu
from psa_casadi.export.importer.masters import Signals, communicate
from psa_casadi.identification.determinacy import determinacy
from psa_casadi.identification.fitting.fit import fit
from psa_casadi.identification.prepare import prepared
from psa_casadi.identification.result import evidence_of
from psa_casadi.model.components.outputs import OUTPUT
from psa_casadi.model.evidence import Evidence
from psa_casadi.model.model_file import loads
from psa_casadi.model.variables import Interval
from psa_casadi.records.split import whole
from tests.contract.helpers import done
from tests.export.fmu_models import assert_valid, exported, files_inside, rewritten
from tests.model.evidence_models import evident_fmu, evident_model, noisy_record
from tests.tiers import slow, slow_but


def stated() -> Evidence:
    """Return the evidence of the model."""
    result = evident_model().evidence
    assert result is not None
    return result


def test_experiments_name_files_that_are_there() -> None:
    table = files_inside(evident_fmu())
    (whole,) = ET.fromstring(table[evidence.VALIDATION])
    spread = ET.fromstring(table[evidence.UNCERTAINTY])
    assert [e.tag for e in whole] == ["Parameters", "Stimuli", "References"]
    assert len(spread) == 1 + 2 * 3 + 2  # the mean, pairs of three parameters, two samples
    for experiment in (whole, *spread):
        assert all(f"{FOLDER}/{e.attrib['source']}" in table for e in experiment)
    for name in (n for n in table if n.endswith(".ssv")):
        assert_valid(table[name].decode(), "ssp", "schema", "SystemStructureParameterValues.xsd")
        root = ET.fromstring(table[name])
        listed = root.iterfind("{*}Parameters/{*}Parameter")
        output = {p.get("name"): p[0].get("unit") for p in listed}
        assert {*output.values()} <= {u.get("name") for u in root.iterfind("{*}Units/{*}Unit")}
        units = {p.name: p.unit for p in evident_model().structure.parameters if p.name in output}
        assert units.items() <= output.items()
        assert units
    one = table[f"{evidence.SETS}/sigma_02_minus.ssv"].decode()
    assert re.findall(r'Parameter name="(\w+)"', one) == ["k_L", "A", "tau"]


def test_meta_data_and_page_state_the_same() -> None:
    """Names and order as the schema of SSP Traceability 1.0 has them (SRMD.xsd, STC.xsd)."""
    table = files_inside(evident_fmu())
    root = ET.fromstring(table[evidence.META_DATA])
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
    page, held = table[evidence.PAGE].decode(), stated().held_out
    assert held is not None
    (record,) = entries["record"]
    assert noisy_record().sha256 in record
    assert f"{1e6 * held.rms_m:.4g} um rms" in entries["held-out error"][0]
    assert entries["temperature"] == ["not recorded"]
    row = [float(v) for v in entries["covariance.A"][0].split()]
    assert row == list(stated().covariance.matrix[1])
    assert re.fullmatch(r"[\d.]+ N/V, standard error [\d.e-]+", entries["k_L"][0])
    for keyword in ("record", "held-out error", "voltage", "duration", "k_L"):
        assert entries[keyword][0] in page
    assert all(link in ("index.html",) for link in re.findall(r'href="([^"]*)"', page))
    assert "../documentation/evidence.html" in table["documentation/index.html"].decode()


def test_a_model_without_evidence_has_no_such_files() -> None:
    assert evidence.evidence_files(psa.stack_model("demo"), 20) == {}
    none = evidence.evidence_files(evident_model().plant(), 0)
    assert not [n for n in none if n.startswith(evidence.SETS)]
    assert evidence.UNCERTAINTY not in none


def test_names_of_records_stay_text() -> None:
    """A record's name may hold what means something in HTML and XML."""
    model, output = evident_model().plant(), stated()
    assert output.reference is not None
    name = "<b>&\"'"
    odd = replace(
        output,
        runs=(replace(output.runs[0], record=name),),
        reference=replace(output.reference, record=name),
    )
    texts = evidence.evidence_texts(replace(model, evidence=odd), 0)
    assert "&lt;b&gt;&amp;" in texts[evidence.PAGE]
    assert "<b>" not in texts[evidence.PAGE]
    read = "".join(ET.fromstring(texts[evidence.META_DATA]).itertext())
    assert f"{name}, sha256" in read


@pytest.mark.slow
def test_the_command_writes_sets_and_lists_the_files_inside(tmp_path: Path) -> None:
    psa.save_model(evident_model(), tmp_path / "m.json")
    path, sets = tmp_path / "m.fmu", tmp_path / "sets"
    line = f"export fmu --model {tmp_path / 'm.json'} -o {path} --include-sensor"
    words = done(*f"{line} --parameter-sets 1 --sets-to {sets}".split()).words
    assert "documentation/evidence.html (records: short), 8 parameter sets" in words
    table = files_inside(path)
    assert len(list(sets.iterdir())) == 8
    for file in sets.iterdir():
        assert table[f"{evidence.SETS}/{file.name}"] == file.read_bytes()
    with Fmu(path) as fmu:  # with the sensor, whose reading is compared then
        playback = repeated(fmu, evident_model(), [noisy_record()])[-1]
        assert isinstance(playback, Playback)
        assert playback.output == "measured_displacement"
        assert played_again(fmu, playback).figure < 1e-4


def messages(
    fmi: int, peak: float, duration: float, *, start: float = 0.0, steps: int = 100
) -> tuple[list[str], np.ndarray]:
    """Return a triangle and the output of an FMU on it, in co-simulation."""
    times = start + np.linspace(0.0, duration, steps + 1)
    volts = peak * (1.0 - np.abs(np.linspace(-1.0, 1.0, steps + 1)))
    inputs = Signals(("voltage",), times, volts[:, None])
    with Fmu(evident_fmu(fmi)) as fmu, fmu.start(CO_SIMULATION, start_time=start) as instance:
        values = communicate(instance, times, inputs, [OUTPUT])
        extrapolated = "From here on the results are extrapolated."
        return [m for m in instance.messages if extrapolated in m], values[:, 0]


@pytest.mark.parametrize("fmi", slow_but([2], [2, 3]))
def test_inside_nothing_is_logged(fmi: int) -> None:
    logged, outside = messages(fmi, 75.0, 0.5, start=1e3)
    assert logged == []
    assert np.all(outside == 0.0)


@pytest.mark.parametrize("fmi", [2, 3])
def test_leaving_the_voltage_is_logged_once(fmi: int) -> None:
    (line,), outside = messages(fmi, 120.0, 0.6)
    assert line.startswith("voltage is 7")
    low, high = stated().seen.voltage.low, stated().seen.voltage.high
    assert f"from {low:.6g} to {high:.6g}." in line
    beyond = (120.0 - high) / (high - low) - 0.01
    assert np.max(outside) == pytest.approx(beyond, abs=2e-3)
    assert outside[0] == outside[-1] == 0.0


@slow
@pytest.mark.parametrize("fmi", slow_but([3], [2, 3]))
def test_a_rate_and_a_time_that_no_record_has_are_logged(fmi: int) -> None:
    (line,), outside = messages(fmi, 75.0, 0.01)
    assert line.startswith("The rate per second of voltage is 1")
    assert np.max(outside) > 1.0
    (line,), outside = messages(fmi, 75.0, 0.8)
    assert line.startswith("The time since the start is 0.64")
    assert np.all(outside == 0.0)


def test_a_temperature_beyond_the_records_counts_where_the_model_has_one() -> None:
    model = evident_model()
    ranges = replace(stated().seen, temperature=Interval(290.0, 300.0))
    output = replace(stated(), seen=ranges)
    assert "seen_temperature_low" not in with_validity(replace(model, evidence=output)).values
    warm = replace(model.with_effect(psa.EFFECTS["temperature"]), evidence=output)
    watched = with_validity(warm)
    column = watched.output_names.index(OUTPUT)
    x = [q.start for q in watched.structure.states]
    for kelvins, outside in ((295.0, 0.0), (300.05, 0.0), (310.0, 0.99), (285.0, 0.49)):
        u = [kelvins if n == "temperature" else 0.0 for n in watched.input_names]
        y = watched.structure.f(0.0, x, u, watched.parameter_vector())[1]
        assert float(y[column]) == pytest.approx(outside, abs=1e-12)
    assert seen_inputs(watched)[watched.input_names.index("temperature")] == (290.0, 300.0, np.inf)


def carried(path: Path) -> psa.Model:
    return loads(files_inside(path)["resources/model.json"].decode())


def play(path: Path, *records: psa.Record) -> list[CheckRow]:
    with Fmu(path) as fmu:
        again = repeated(fmu, carried(path), records)
        return [r if isinstance(r, CheckRow) else played_again(fmu, r) for r in again]


@pytest.mark.parametrize("fmi", slow_but([2], [2, 3]))
def test_the_run_and_the_held_out_error_hold(fmi: int) -> None:
    rows = {r.name: r for r in play(evident_fmu(fmi), noisy_record())}
    assert list(rows) == ["records as stated", "reference run", "held-out error of short"]
    assert all(r.passed for r in rows.values()), rows
    assert rows["reference run"].figure < (2e-6 if fmi == 2 else 2e-4)
    assert rows["held-out error of short"].figure < (1e-4 if fmi == 2 else 2e-3)


@pytest.mark.slow
def test_a_record_that_was_averaged_is_averaged_again() -> None:
    time = np.asarray(np.arange(8000) * 1e-4, dtype=np.float64)
    voltage = 50.0 - 50.0 * np.cos(8.0 * time)
    noise = 1e-7 * np.random.default_rng(1).standard_normal(len(time))
    clean = psa.simulate(psa.stack_model("demo"), time, voltage).displacement
    record = psa.Record(name="fast", time=time, voltage=voltage, displacement=clean + noise)
    shorter, _ = prepared(record)
    assert shorter.n < record.n
    result = fit(psa.stack_model("demo"), (whole(shorter),), ["k_L"], sigma=[1e-7])
    output = evidence_of(
        result, determinacy(result), result.predicted(), by="test", sampled=[record]
    )
    model = replace(result.model.plant(), evidence=replace(output, reference=None))
    with Archive(evident_fmu()) as archive:
        again = repeated(archive, model, [record])
        gone = repeated(archive, model, [record.slice(0, 7000)])
    (playback,) = (run for run in again if isinstance(run, Playback))
    assert len(playback.inputs.times) == shorter.n
    x0 = np.array([playback.start[n] for n in model.state_names])
    inputs = np.column_stack([playback.inputs.values[:, 0], np.zeros(shorter.n)])
    y = psa.run(model, playback.inputs.times, inputs, x0, rtol=1e-9).y
    error = playback.expected - y[:, model.output_names.index("displacement")]
    assert np.sqrt(np.mean(error**2)) == pytest.approx(playback.stated, rel=1e-4)
    refused = gone[-1]
    assert isinstance(refused, CheckRow)
    assert not refused.passed
    assert f"{shorter.n} are stated" in refused.remark


def test_another_record_is_not_one_of_those() -> None:
    other = noisy_record().slice(0, 100)
    rows = play(evident_fmu(), replace(other, name="other", sha256="f" * 64))
    strange = next(r for r in rows if r.name == "records as stated")
    assert not strange.passed
    assert "other has sha256 ffffffffffff..." in strange.remark
    assert not any("error of" in r.name for r in rows)


def test_an_error_that_is_stated_too_small_is_detected(tmp_path: Path) -> None:
    def smaller(content: bytes) -> bytes:
        return re.sub(rb'("held_out_m": )[\d.e+-]+', rb"\g<1>1.5e-08", content)

    path = rewritten(evident_fmu(), tmp_path / "m.fmu", {"resources/model.json": smaller})
    failed = [r for r in play(path, noisy_record()) if not r.passed]
    assert [r.name for r in failed] == ["held-out error of short"]
    assert "stated 0.015 um" in failed[0].remark


@slow
def test_another_run_and_other_files_are_detected(tmp_path: Path) -> None:
    def moved(content: bytes) -> bytes:
        lines = content.decode().splitlines()
        column = lines[0].split(",").index("displacement")
        values = lines[100].split(",")
        values[column] = repr(1.01 * float(values[column]))
        return "\n".join([*lines[:100], ",".join(values), *lines[101:], ""]).encode()

    changes = {
        evidence.OUTPUTS: moved,
        evidence.PAGE: lambda c: c.replace(b"held-out", b"hold-out"),
    }
    path = rewritten(evident_fmu(), tmp_path / "m.fmu", changes)
    wrong = [f"{evidence.PAGE} differs from the model"]
    for fmu, problems in ((path, wrong), (evident_fmu(), [])):
        with Archive(fmu) as archive:
            assert list(wrong_evidence(archive, carried(path))) == problems
    (row,) = play(path)
    assert row.name == "reference run"
    assert not row.passed
    assert row.figure > 1e-3


def test_errors_that_count_with_a_sensor_are_not_those_of_the_plant() -> None:
    output = replace(stated(), outside=("offset_drift",))
    plant = replace(evident_model().plant(), evidence=output)
    with Archive(evident_fmu()) as archive:
        row = repeated(archive, plant, [noisy_record()])[-1]
    assert isinstance(row, CheckRow)
    assert row.passed
    assert "not compared: the FMU leaves out offset_drift" in row.remark


@pytest.mark.slow
def test_an_fmu_without_evidence_does_not_pass_when_it_is_requested() -> None:
    """Without `evidence` it passes: tests/export/test_fmu.py."""
    report = psa.check_fmu(exported("P-885.51"), evidence=True)
    assert [r.name for r in report.failures] == ["evidence"]
