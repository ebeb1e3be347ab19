"""`psa check --evidence`: the run and the records behind a model, played again through its FMU."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.effects import EFFECTS
from psa_casadi.export.check.check import check_fmu
from psa_casadi.export.check.evidence import repeated, wrong_evidence
from psa_casadi.export.check.measured import Playback, played_again
from psa_casadi.export.check.rows import CheckRow
from psa_casadi.export.fmu import evidence
from psa_casadi.export.importer.archive import Archive
from psa_casadi.export.importer.fmu import Fmu
from psa_casadi.identification.determinacy import determinacy
from psa_casadi.identification.evidence import evidence_of
from psa_casadi.identification.fitting.fit import fit
from psa_casadi.identification.prepare import prepared
from psa_casadi.model.compose import Model
from psa_casadi.model.model_file import loads
from psa_casadi.records.record import Record
from psa_casadi.records.split import whole
from tests.export.fmu_models import exported, rewritten
from tests.model.evidence_models import evident_fmu, evident_model, files_inside, noisy_record
from tests.tiers import slow, slow_but


def carried(path: Path) -> Model:
    return loads(files_inside(path)["resources/model.json"].decode())


def play(path: Path, *records: Record) -> list[CheckRow]:
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
    record = Record(name="fast", time=time, voltage=voltage, displacement=clean + noise)
    shorter, _ = prepared(record)
    assert shorter.n < record.n
    found = fit(psa.stack_model("demo"), (whole(shorter),), ["k_L"], sigma=[1e-7])
    told = evidence_of(
        found, determinacy(found, (whole(shorter),)), (whole(shorter),),
        found.predicted((whole(shorter),)), by="test", sampled=[record],
    )  # fmt: skip
    model = replace(found.model.plant(), evidence=replace(told, reference=None))
    with Archive(evident_fmu()) as archive:
        again = repeated(archive, model, [record])
        gone = repeated(archive, model, [record.slice(0, 7000)])
    (playback,) = (run for run in again if isinstance(run, Playback))
    assert len(playback.times) == shorter.n
    x0 = np.array([playback.start[n] for n in model.state_names])
    inputs = np.column_stack([playback.inputs.values[:, 0], np.zeros(shorter.n)])
    y = psa.run(model, playback.times, inputs, x0, rtol=1e-9).y
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


def test_an_error_that_is_stated_too_small_is_found(tmp_path: Path) -> None:
    def smaller(content: bytes) -> bytes:
        return re.sub(rb'("held_out_m": )[\d.e+-]+', rb"\g<1>1.5e-08", content)

    path = rewritten(evident_fmu(), tmp_path / "m.fmu", {"resources/model.json": smaller})
    failed = [r for r in play(path, noisy_record()) if not r.passed]
    assert [r.name for r in failed] == ["held-out error of short"]
    assert "stated 0.015 um" in failed[0].remark


@slow
def test_another_run_and_other_files_are_found(tmp_path: Path) -> None:
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
    with Archive(path) as archive:
        assert list(wrong_evidence(archive, carried(path))) == [
            f"{evidence.PAGE} is not what the model says"
        ]
    with Archive(evident_fmu()) as archive:
        assert list(wrong_evidence(archive, carried(path))) == []
    (row,) = play(path)
    assert row.name == "reference run"
    assert not row.passed
    assert row.figure > 1e-3


def test_errors_that_count_with_a_sensor_are_not_those_of_the_plant() -> None:
    drift = EFFECTS["offset_drift"]
    model = evident_model()
    assert model.evidence is not None
    told = replace(model.evidence, outside=(drift.name,))
    with Archive(evident_fmu()) as archive:
        row = repeated(archive, replace(model.plant(), evidence=told), [noisy_record()])[-1]
    assert isinstance(row, CheckRow)
    assert row.passed
    assert "not compared: the FMU leaves out offset_drift" in row.remark


@pytest.mark.slow
def test_the_whole_check_with_evidence() -> None:
    report = check_fmu(evident_fmu(), evidence=True, records=[noisy_record()])
    assert report.passed, report.failures
    names = [r.name for r in report.rows]
    assert {"evidence inside", "reproducible", "reference run"} < set(names)
    assert names[-1] == "held-out error of short"


@pytest.mark.slow
def test_an_fmu_without_evidence_does_not_pass_when_it_is_asked_for() -> None:
    """Where none is asked for, it passes: tests/export/test_fmu.py."""
    report = check_fmu(exported("P-885.51"), evidence=True)
    assert [r.name for r in report.failures] == ["evidence"]
