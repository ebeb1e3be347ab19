"""The JSON schemas that the package ships, against their records and against what is written."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

import psa_casadi as psa
from build_scripts.schemas import FILES, schema_texts
from psa_casadi.common.strict_json import json_text
from psa_casadi.diagnosis.corrections import Patch
from psa_casadi.diagnosis.result import Alternative
from psa_casadi.documents.files import check_file, identification_file
from psa_casadi.export.check.rows import CheckRow, stopped
from psa_casadi.identification.profile import Profile
from psa_casadi.model.model_file import dumps
from psa_casadi.model.ports import with_ports
from tests.any_model.own_models import cylinder, motor, oscillator, oven, pair, tanks
from tests.contract.helpers import DATA
from tests.model.evidence_models import evident_model
from tests.report.report_cases import diagnosis, identification, with_periodic


def valid(schema: str, text: str) -> dict[str, Any]:
    """Return what a JSON text holds, which must match a schema that is shipped."""
    content: dict[str, Any] = json.loads(text)
    rules = json.loads((DATA / "schemas" / f"{schema}.schema.json").read_text("utf-8"))
    jsonschema.Draft202012Validator(rules).validate(content)
    return content


def test_what_is_shipped_is_what_the_records_declare() -> None:
    kept = {path.name: path.read_text("utf-8") for path in (DATA / "schemas").iterdir()}
    assert kept == schema_texts(), "accept with: python -m build_scripts.schemas"
    assert len(kept) == len(FILES)
    for text in kept.values():
        jsonschema.Draft202012Validator.check_schema(json.loads(text))


@pytest.mark.parametrize("name", psa.STACKS)
def test_model_files_match_their_schema(name: str) -> None:
    model = psa.stack_model(name).with_effect(psa.EFFECTS["slow_creep"])
    valid("model", dumps(model))
    published = replace(model, publication=psa.Publication(author="A", version="1"))
    valid("model", dumps(published.with_starts({"z_c1": 1e-7})))


@pytest.mark.parametrize("make", [oscillator, motor, tanks, pair, cylinder, oven])
def test_files_of_users_models_match_their_schema(make: Any) -> None:
    content = valid("model", dumps(with_ports(make())))
    (item,) = content["own"].values()
    assert item["ports"]


def test_the_evidence_of_a_model_matches_its_schema() -> None:
    assert "evidence" in valid("model", dumps(evident_model()))


@pytest.mark.parametrize("verdict", ["adequate", "cause_named", "ambiguous", "unexplained"])
def test_diagnoses_match_their_schema(verdict: Any) -> None:
    d = with_periodic(diagnosis(verdict))
    content = valid("diagnosis", d.to_json())
    assert content["misfit"][0]["views"]
    none = np.zeros(1)
    patch = Patch(
        kind="curve", port="reading", evidence=9.0, open_to=("lag at the drive",), held=(),
        predicted=(), added=(), weights=none, moved=none,
    )  # fmt: skip
    other = Alternative("slow_creep", "offset_drift", d.model, 1.01, 1e-9, 0.1)
    assert valid("diagnosis", replace(d, patch=patch, alternatives=(other,)).to_json())["patch"]


def test_identifications_match_their_schema() -> None:
    fitted = identification()
    k = fitted.determinacy.names[0]
    profile = Profile(k, "N/m", "N/um", True, (0, 1), 1.0, 0.1, np.ones(2), np.ones(2), 0.9, None)
    content = valid("identification", json_text(identification_file(fitted, [profile])))
    interval = fitted.model.provenance.intervals[k]
    assert content["parameters"][k]["interval"] == [interval.low, interval.high]
    assert content["profiles"][k] == {"unit": "N/m", "estimate": 1.0, "low": 0.9, "high": None}
    (e, *_) = fitted.experiments
    assert content["records"][0]["sha256"] == e.record.sha256
    assert content["records"][0]["rms_m"] == pytest.approx(content["rms_m"], rel=0.5)
    assert valid("identification", json_text(identification_file(fitted)))["profiles"] == {}


def test_checks_match_their_schema() -> None:
    rows = (CheckRow("trajectory", 1e-8, 1e-6, True, ""), stopped("calls", "it hung"))
    content = valid(
        "check", json_text(check_file(psa.CheckReport(Path("a.fmu"), rows, compared=False)))
    )
    assert [r["found"] for r in content["rows"]] == [1e-8, None]
    assert (content["passed"], content["fmu"]) == (False, "a.fmu")


def test_what_is_otherwise_is_refused() -> None:
    content = check_file(psa.CheckReport(Path("a.fmu"), (), compared=True))
    for spoil in ({"passed": "yes"}, {"more": 1}, {"rows": [{"name": "a"}]}):
        with pytest.raises(jsonschema.ValidationError):
            valid("check", json_text({**content, **spoil}))
