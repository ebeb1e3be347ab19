"""Devices that are no stacks: identifications and diagnoses of any model side by side."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

import psa_casadi as psa
from psa_casadi.common.strict_json import json_text
from psa_casadi.documents.files import identification_file
from psa_casadi.documents.findings import finding_content
from tests.any_model import own_plants as plants
from tests.any_model.own_models import motor
from tests.contract.helpers import done
from tests.report.html_page import Page
from tests.report.test_schemas import valid


def device(name: str, seed: int, inertia: float = 3e-5, friction: float = 0.0) -> psa.Signals:
    record = plants.motor(seed, friction, inertia=inertia)
    return replace(record, name=name)


def test_identifications_of_an_own_model_are_compared(tmp_path: Path) -> None:
    """The third of three motors is heavier by a hundredth; all else is the same."""
    items = [device("first", 1), device("second", 2), device("third", 3, inertia=3.03e-5)]
    results = [psa.identify(motor(), record, starts=1) for record in items]
    assert len(results[0].plot().axes) == 4  # both outputs, and what is left of each
    path = tmp_path / "second.json"
    path.write_text(json_text(identification_file(results[1])), encoding="utf-8")
    content = valid("identification", path.read_text("utf-8"))
    rows = content["records"]
    assert [(r["output"], r["unit"], r["samples"]) for r in rows] == [
        ("w", "rad/s", 3000), ("i", "A", 3000)
    ]  # fmt: skip
    assert rows[0]["rms_m"] == pytest.approx(0.3, rel=0.05)
    assert rows[1]["noise_m"] == pytest.approx(0.005, rel=0.05)
    findings = psa.read_findings([results[0], path, results[2]])
    assert [f.device for f in findings] == ["first", "second", "third"]
    assert [f.rms_m for f in findings] == [None] * 3  # rad/s is no length
    psa.write_comparison(findings, tmp_path / "page.html")
    page = Page((tmp_path / "page.html").read_text("utf-8"))
    assert "Beyond noise, J differs (4 parameters compared)." in page.text
    assert page.loaded == []
    compared = psa.compare(*results)
    assert "Beyond noise, J differs (4 parameters compared)." in repr(compared)
    rows = compared.to_frame().set_index(["parameter", "device"])
    assert len(rows) == 12
    assert rows.loc[("J", "third"), "value"] == results[2].model.values["J"]
    assert set(rows.index[rows["differs"]].get_level_values(0)) == {"J"}
    with pytest.raises(psa.InputError, match="One device is nothing to compare"):
        psa.compare(results[0])


def test_a_fit_that_misses_its_record_is_told(tmp_path: Path) -> None:
    """The second of two motors has dry friction, which the model lacks."""
    items = [device("oiled", 2), device("dry", 1, friction=0.012)]
    results = [psa.identify(motor(), record, starts=1) for record in items]
    compared = psa.compare(*results)
    oiled, dry = compared.findings
    worst = max(rms / results[1].noise[name] for name, rms in results[1].rms.items())
    assert (oiled.noise_ratio, oiled.warnings) == (None, ())
    assert dry.noise_ratio == pytest.approx(worst, rel=0.05)
    assert "The fit of dry (" in compared.sentence
    assert "misses its records" in repr(compared)
    compared.report(tmp_path / "page.html")
    page = Page((tmp_path / "page.html").read_text("utf-8"))
    assert "misses its records" in page.text
    assert "dry: 'w' is missed by" in page.text
    assert "dry: 'i' is missed by" in page.text
    rows = [finding_content(f) for f in compared.findings]
    assert [r["missed [times the noise]"] for r in rows] == [None, dry.noise_ratio]


@pytest.mark.slow
def test_diagnoses_of_an_own_model_are_compared(tmp_path: Path) -> None:
    fewer = ["hysteresis", "stop", "curve", "delay"]
    items = [device("dry", 1, friction=0.012), device("oiled", 2)]
    dry, oiled = (psa.diagnose(motor(), r, leave_out=fewer) for r in items)
    path = tmp_path / "dry.json"
    path.write_text(dry.to_json(), encoding="utf-8")
    findings = psa.read_findings([path, oiled])
    assert [f.verdict for f in findings] == ["cause_named", "adequate"]
    size = findings[0].parameters["friction_in_speed_size"]
    assert size.value == json.loads(dry.to_json())["causes"][0]["parameters"][
        "friction_in_speed_size"
    ]["value"]  # fmt: skip
    psa.write_comparison(findings, tmp_path / "page.html")
    page = Page((tmp_path / "page.html").read_text("utf-8"))
    assert "Verdicts differ (dry: cause named and oiled: adequate)" in page.text
    assert "friction in speed" in page.text
    errors = {e.output: e for e in findings[0].errors}
    assert errors["w"].unit == "rad/s"
    assert errors["w"].extended == pytest.approx(0.3, rel=0.1)
    assert errors["i"].base > 2.0 * errors["i"].extended
    assert "w, base, held out [rad/s]" in page.text
    # a result at hand has all parameters of its model, a file those of its causes
    assert set(findings[1].parameters) == {"R", "k", "J", "b"}
    loaded = psa.compare(psa.load_diagnosis(path), oiled)
    assert [f.verdict for f in loaded.findings] == ["cause_named", "adequate"]
    assert loaded.findings[0].parameters == findings[0].parameters
    plain = tmp_path / "oiled.json"
    plain.write_text(oiled.to_json(), encoding="utf-8")
    words = done("compare", path, plain, "-o", tmp_path / "two.html").words
    assert "cause named" in words
    assert "held out" in words
