"""Identify and diagnose: the demonstration from record to checked FMU, verdicts, expectations."""

import hashlib
import json
import pickle
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import fmpy
import numpy as np
import pytest

import psa_casadi as psa
from tests.contract import helpers
from tests.contract.conftest import Demo
from tests.contract.helpers import DATA, Floats, command, done, refused, rms, table, write
from tests.report.html_page import figures, read_page
from tests.report.test_schemas import valid
from tests.studies.plants.make import make_demo

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("contract")]
VERDICTS = (
    "adequate", "cause_named", "partly_explained", "ambiguous", "unexplained", "not_driven",
)  # fmt: skip


def read(path: Path, schema: str) -> dict[str, Any]:
    """Return a JSON file that fits its schema, which is shipped with the package."""
    content = valid(schema, path.read_text("utf-8"))
    assert content["format"] == f"psa_casadi.{schema}/1"
    return content


# --- the demonstration ---


def test_the_demo_leaves_the_files_that_it_names(demo: Demo) -> None:
    names = {p.name for p in demo.folder.iterdir()}
    assert names == {
        "synthetic_record.csv", "model.json", "diagnosis.json", "diagnosis.png", "extended.json",
        "extended.fmu", "report.html",
    }  # fmt: skip
    for name in names:
        assert name in demo.ended.out.split("left in ")[1]
    assert "slow creep" in demo.ended.out
    assert "FAIL" not in demo.ended.out
    assert "synthetic" in demo.ended.out


def test_the_demos_record_is_that_of_an_independent_plant(demo: Demo, tmp_path: Path) -> None:
    make_demo(tmp_path / "r.csv")
    made = (tmp_path / "r.csv").read_bytes()
    assert (demo.folder / "synthetic_record.csv").read_bytes() == made
    assert (DATA / "demo.csv").read_bytes() == made


def test_the_demos_diagnosis_names_the_hidden_cause(demo: Demo) -> None:
    d = read(demo.folder / "diagnosis.json", "diagnosis")
    assert d["verdict"] == "cause_named"
    (cause,) = d["causes"]
    assert (cause["effect"], cause["belongs_to"]) == ("slow_creep", "plant")
    assert cause["confidence"] > 0.93
    assert cause["cannot_be_told_from"] == []
    for name, unit in (("creep_gain", "1"), ("creep_time", "s")):
        estimate = cause["parameters"][name]
        assert estimate["unit"] == unit
        assert 0.0 < estimate["interval"][0] < estimate["value"] < estimate["interval"][1]
    first, second, *_ = d["candidates"]
    assert first["effect"] == "slow_creep"
    assert first["evidence"] > second["evidence"] + 100.0
    assert first["explained_share"] > 0.95
    assert {c["effect"] for c in d["candidates"]} <= set(psa.EFFECTS)
    assert d["gain"]["interval"][0] < d["gain"]["holdout_rms_reduction_percent"] < 100.0
    assert d["gain"]["holdout_rms_reduction_percent"] > 50.0
    before, after = d["errors"]["base"], d["errors"]["extended"]
    keys = {"train_rms_m", "holdout_rms_m", "holdout_max_m", "holdout_nrmse_percent"}
    assert set(before) == set(after) == keys
    assert after["holdout_rms_m"] == pytest.approx(d["errors"]["noise_floor_rms_m"], rel=0.05)
    assert d["remaining"]["white"] is True
    assert d["remaining"]["p_value"] > 0.05
    assert d["next_experiment"]["voltage_csv"] is None
    for blind in d["blind_to"]:
        assert blind["smallest_detectable_gain"] > 0.0
        assert blind["effect"] in blind["why"]
    share = d["budget"]["together"]
    assert 0.9 < share["interval"][0] < share["share"] < share["interval"][1] < 1.1
    sha256 = hashlib.sha256((demo.folder / "synthetic_record.csv").read_bytes()).hexdigest()
    assert d["records"] == [{"name": "synthetic_record", "sha256": sha256}]


def test_the_demos_models_say_where_they_come_from(demo: Demo) -> None:
    base = read(demo.folder / "model.json", "model")
    extended = read(demo.folder / "extended.json", "model")
    assert (base["effects"], extended["effects"]) == ([], ["slow_creep"])
    assert base["package_version"] == extended["package_version"] == psa.__version__
    sha256 = hashlib.sha256((demo.folder / "synthetic_record.csv").read_bytes()).hexdigest()
    for content in (base, extended):
        assert content["identified_from"] == [{"record": "synthetic_record", "sha256": sha256}]
        for name, p in content["parameters"].items():
            if p["interval"] is not None:
                assert p["free"], name
                assert p["interval"][0] <= p["value"] <= p["interval"][1], name
    creep = read(demo.folder / "diagnosis.json", "diagnosis")["causes"][0]["parameters"]
    assert extended["parameters"]["creep_gain"]["value"] == creep["creep_gain"]["value"]
    loaded = psa.load_model(demo.folder / "extended.json").values
    assert loaded["creep_time"] == extended["parameters"]["creep_time"]["value"]


def test_the_extended_model_is_nearer_to_the_plant_than_the_noise(
    result: psa.StackDiagnosis, tmp_path: Path
) -> None:
    truth = make_demo(tmp_path / "r.csv")
    clean = truth.displacement
    base, extended = (np.std(x - clean) for x in (result.base[0], result.extended[0]))
    assert extended < 0.4 * truth.sigma < base


def test_held_out_errors_are_those_of_samples_that_no_fit_saw(result: psa.StackDiagnosis) -> None:
    frame = result.to_frame()
    held = frame["held_out"].to_numpy()
    assert 0.2 < held.mean() < 0.3
    for name, errors in (("base", result.base_errors), ("extended", result.extended_errors)):
        misfit = (frame["measured [m]"] - frame[f"{name} [m]"]).to_numpy()
        assert rms(misfit[held]) == pytest.approx(errors.holdout_rms_m, rel=1e-6)
        assert rms(misfit[~held]) == pytest.approx(errors.train_rms_m, rel=1e-3)
        assert np.nanmax(np.abs(misfit[held])) == pytest.approx(errors.holdout_max_m, rel=1e-6)
        span = np.ptp(frame["measured [m]"])
        share = 100.0 * errors.holdout_rms_m / span
        assert errors.holdout_nrmse_percent == pytest.approx(share, rel=0.02)


def test_a_diagnosis_is_loaded_back_and_pickled(demo: Demo, result: psa.StackDiagnosis) -> None:
    path = demo.folder / "diagnosis.json"
    loaded = psa.load_diagnosis(path)
    assert loaded.to_json() == path.read_text("utf-8")
    assert loaded.verdict == result.verdict
    assert loaded.causes[0].parameters["creep_gain"].value == pytest.approx(
        result.causes[0].parameters["creep_gain"].value, rel=1e-6
    )
    for kept, candidate in zip(loaded.to_dict()["candidates"], result.candidates, strict=True):
        assert kept["evidence"] == pytest.approx(candidate.evidence, rel=1e-6, abs=1e-6)
    again = pickle.loads(pickle.dumps(result))
    assert again.to_json() == result.to_json()
    np.testing.assert_array_equal(again.extended[0], result.extended[0])
    time, voltage, _ = helpers.reference_run()
    np.testing.assert_array_equal(
        psa.simulate(again.model, time, voltage).displacement,
        psa.simulate(result.model, time, voltage).displacement,
    )


def test_the_demos_page_is_one_file_with_the_figures(demo: Demo) -> None:
    text, page = read_page(demo.folder / "report.html")
    assert page.targets <= page.names
    assert "default-src 'none'" in text
    assert len(text) < 3e6
    assert len(figures(text)) >= 4
    d = json.loads((demo.folder / "diagnosis.json").read_text("utf-8"))
    removed = 100.0 * d["budget"]["together"]["share"]
    creep = d["causes"][0]["parameters"]["creep_time"]["value"]
    parts = ("slow creep", "cause named", f"removes {removed:.3g} %", f"{creep:.3f}", "synthetic")
    assert [part for part in parts if part not in page.text] == []
    head = (demo.folder / "diagnosis.png").read_bytes()[:24]
    assert [int.from_bytes(head[k : k + 4], "big") for k in (16, 20)] == [1600, 1000]


def test_results_show_themselves(result: psa.StackDiagnosis, tmp_path: Path) -> None:
    assert repr(result).startswith("<Diagnosis cause_named: ")
    assert len(repr(result)) < 300
    cell = result._repr_html_()
    assert "data:image/png;base64," in cell
    assert "slow creep" in cell
    assert len(result.plot().axes) >= 4
    story = psa.story(result, origin="synthetic")
    error = result.extended_errors.holdout_rms_m
    assert story.startswith("verdict")
    assert "slow creep" in story
    assert f"extended   held-out error {1e9 * error:.1f} nm rms (0.19 % of range)" in story
    assert psa.story(result).count("measured: 5248 samples") == 1
    result.report(tmp_path / "page.html", still=True)
    psa.write_report(result, tmp_path / "same.html", still=True)
    read_page(tmp_path / "page.html")
    psa.save_figure(result, tmp_path / "f.png")
    assert (tmp_path / "f.png").read_bytes().startswith(b"\x89PNG")


def test_the_demos_fmu_repeats_the_run_that_it_carries(demo: Demo, tmp_path: Path) -> None:
    fmu = demo.folder / "extended.fmu"
    text = done(
        "check", fmu, "--evidence", "--record", demo.folder / "synthetic_record.csv",
        "--json", tmp_path / "c.json",
    ).out  # fmt: skip
    for row in ("evidence inside", "records as stated", "reference run", "held-out error"):
        assert row in text
    assert "FAIL" not in text
    read(tmp_path / "c.json", "check")
    other = command("check", fmu, "--model", demo.folder / "model.json")
    assert (other.code, "FAIL" in other.out) == (1, True)
    description = fmpy.read_model_description(str(fmu))
    extended = psa.load_model(demo.folder / "extended.json")
    starts = {v.name: v.start for v in description.modelVariables if v.causality == "parameter"}
    assert float(starts["creep_gain"]) == extended.values["creep_gain"]


def test_two_devices_are_side_by_side_on_a_page(demo: Demo, tmp_path: Path) -> None:
    d = json.loads((demo.folder / "diagnosis.json").read_text("utf-8"))
    sure = f"{100.0 * d['causes'][0]['confidence']:.0f} %"
    d |= {"verdict": "adequate", "causes": [], "records": [{"name": "o", "sha256": "0" * 64}]}
    (tmp_path / "other.json").write_text(json.dumps(d), encoding="utf-8")
    page = tmp_path / "compare.html"
    text = done("compare", demo.folder / "diagnosis.json", tmp_path / "other.json", "-o", page).out
    assert "cause named" in text
    assert "adequate" in text
    _, compared = read_page(page)
    for part in ("slow creep", sure, "cause named", "adequate", "other"):
        assert part in compared.text
    assert "nothing to compare" in refused("compare", demo.folder / "diagnosis.json", "-o", page)


# --- what a script asks ---

FEW = {"charge_leakage", "hysteresis_memory", "offset_drift", "slow_creep"}
LEFT_OUT = [w for name in psa.EFFECTS if name not in FEW for w in ("--leave-out", name)]


def junit(path: Path) -> dict[str, bool]:
    """Return of every test of a JUnit file whether it failed."""
    root = ElementTree.parse(path).getroot()
    cases = {c.attrib["name"]: c.find("failure") is not None for c in root.iter("testcase")}
    assert int(root.attrib["failures"]) == sum(cases.values())
    assert int(root.attrib["tests"]) == len(cases)
    return cases


def test_what_is_expected_decides_the_exit_code(tmp_path: Path) -> None:
    arguments: list[str | Path] = ["diagnose", DATA / "demo.csv", *LEFT_OUT, "--quiet"]
    arguments += ["--junit", tmp_path / "d.xml"]
    right = command(*arguments, "--expect", "adequate,cause_named", "--max-error", "0.5%")
    assert (right.code, right.out, right.err) == (0, "", "")
    assert junit(tmp_path / "d.xml") == {"verdict": False, "held-out error": False}
    wrong = command(*arguments, "--expect", "adequate", "--max-error", "0.1%")
    assert wrong.code == 1
    assert "cause_named; expected adequate" in wrong.words
    assert re.search(r"0\.19\d* % of the range; expected 0\.1 %", wrong.words)
    assert junit(tmp_path / "d.xml") == {"verdict": True, "held-out error": True}


def test_an_unusable_record_fails_a_test_and_leaves_other_files(tmp_path: Path) -> None:
    record, results = tmp_path / "a.csv", tmp_path / "d.xml"
    write(record, dict.fromkeys(("time [s]", "voltage [V]", "displacement [m]"), np.arange(2.0)))
    before = record.read_bytes()
    ended = command("diagnose", record, "--junit", results)
    assert ended.code == 2
    assert junit(results) == {"run": True}
    assert "found 2 samples" in results.read_text(encoding="utf-8")
    for other in ("diagnose", tmp_path / "b.csv"), ("check", tmp_path / "b.fmu"):
        assert command(*other, "--junit", record).code == 2
        assert record.read_bytes() == before
        assert command(*other, "--junit", results).code == 2
        assert "there is no such file" in results.read_text(encoding="utf-8")


def test_what_too_few_samples_judge_is_not_adequate(tmp_path: Path) -> None:
    columns = {name: values[:40] for name, values in table(DATA / "demo.csv").items()}
    write(tmp_path / "a.csv", columns)
    files = tmp_path / "a.csv", "--json", tmp_path / "d.json"
    ended = command("diagnose", *files, "--expect", "adequate")
    assert (ended.code, read(tmp_path / "d.json", "diagnosis")["verdict"]) == (1, "adequate")
    assert "The verdict is adequate, but not confirmed: only" in ended.words


def test_a_model_with_a_value_on_its_bound_hides_no_cause(demo: Demo, tmp_path: Path) -> None:
    """The base fit imitates creep by a damping at its bound; the diagnosis starts elsewhere."""
    model = demo.folder / "model.json"
    values = read(model, "model")["parameters"]
    assert values["c_P"]["value"] == psa.load_model(model).parameter("c_P").bounds[1]
    done(
        "diagnose", demo.folder / "synthetic_record.csv", "--model", model, "--quiet", *LEFT_OUT,
        "--json", tmp_path / "d.json",
    )  # fmt: skip
    d = read(tmp_path / "d.json", "diagnosis")
    assert [c["effect"] for c in d["causes"]] == ["slow_creep"]
    assert any("c_P" in n and "on a bound" in n for n in d["notes"])


def test_held_out_records_only_judge_and_nothing_else_is_written(tmp_path: Path) -> None:
    columns = table(DATA / "demo.csv")
    for name, part in (("a", slice(0, 1200)), ("b", slice(1200, 2000))):
        write(tmp_path / f"{name}.csv", {k: v[part] for k, v in columns.items()})
    ended = done(
        "diagnose", tmp_path / "a.csv", "--holdout", tmp_path / "b.csv", "--quiet", *LEFT_OUT,
        "--json", tmp_path / "d.json", "--events", tmp_path / "e.jsonl",
    )  # fmt: skip
    assert (ended.out, ended.err) == ("", "")
    assert {p.name for p in tmp_path.iterdir()} == {"a.csv", "b.csv", "d.json", "e.jsonl"}
    d = read(tmp_path / "d.json", "diagnosis")
    assert d["verdict"] in VERDICTS
    assert [r["name"] for r in d["records"]] == ["a", "b"]
    assert "slow_creep" not in d["notes"][-1]
    assert "sensor_lag" in d["notes"][-1]
    assert {c["effect"] for c in d["candidates"]} <= FEW
    tried = [json.loads(line) for line in (tmp_path / "e.jsonl").read_text("utf-8").splitlines()]
    assert tried[0]["causes"] == []
    assert [t["state"] for t in tried].count("best") == 1
    assert {c for t in tried for c in t["causes"]} <= FEW


# --- other records ---


def noisy(seed: int) -> dict[str, Floats]:
    """Return a record of the independent reference, which has nothing that the model lacks."""
    time, voltage, clean = helpers.reference_run("P-885.51", 3.0, 1501)
    x = 1e6 * clean.displacement
    noise = 1e-3 * np.ptp(x) * np.random.default_rng(seed).standard_normal(x.size)
    current = 1e3 * clean.current
    current = current + 2e-3 * np.ptp(current) * np.random.default_rng(9).standard_normal(x.size)
    columns = {"time [s]": time, "voltage [V]": voltage, "displacement [um]": x + noise}
    return columns | {"current [mA]": current}


def without_current(seed: int) -> dict[str, Floats]:
    return {name: values for name, values in noisy(seed).items() if "current" not in name}


def error_share(model: Path) -> float:
    """Return the rms error of a model against the independent reference, over the range."""
    time, voltage, clean = helpers.reference_run("P-885.51", 3.0, 1501)
    run = psa.simulate(psa.load_model(model), time, voltage, from_rest_at_zero=True)
    return float(np.std(run.displacement - clean.displacement) / np.ptp(clean.displacement))


def test_parameters_are_identified_within_their_intervals(tmp_path: Path) -> None:
    path, model = write(tmp_path / "r.csv", noisy(1)), tmp_path / "m.json"
    truth = psa.stack_model("P-885.51").values
    text = done(
        "identify", path, "--stiffness", f"{truth['k_B']}", "-o", model, "--json",
        tmp_path / "i.json", "--report", tmp_path / "fit.html", "--still",
    ).out  # fmt: skip
    content = read(tmp_path / "i.json", "identification")
    result = psa.load_model(model).values
    assert result == {n: p["value"] for n, p in content["parameters"].items()}
    assert result["k_B"] == truth["k_B"]
    free = {n: p for n, p in content["parameters"].items() if p["interval"]}
    low, high = free["C_p"]["interval"]
    assert low <= truth["C_p"] <= high
    assert high - low < 0.05 * truth["C_p"]
    assert error_share(model) < 5e-4
    assert "k_L" in text
    assert "95 % interval" in text
    assert "N/V" in read_page(tmp_path / "fit.html")[1].text


def test_a_record_without_a_cause_is_adequate() -> None:
    columns = without_current(2)
    d = psa.diagnose(columns, holdout=psa.record_from(without_current(5), name="kept"))
    assert d.verdict == "adequate"
    frame = d.to_frame()
    second = frame["held_out"][frame["record"] == "kept"]
    assert len(second) == 1501
    assert not frame["held_out"][frame["record"] != "kept"].any()
    assert second.mean() > 0.85  # its first part determines the initial state
    assert d.causes == ()
    assert d.extended_errors == d.base_errors
    noise = 1e-3 * np.ptp(columns["displacement [um]"]) * 1e-6
    assert d.noise_floor_rms_m == pytest.approx(noise, rel=0.1)
    assert d.base_errors.holdout_rms_m == pytest.approx(noise, rel=0.1)


def test_a_displacement_that_does_not_follow_is_not_driven() -> None:
    columns = without_current(3)
    t = columns["time [s]"]
    columns["displacement [um]"] = np.sin(37.0 * t) + 0.01 * np.cos(901.0 * t)
    d = psa.diagnose(columns)
    assert d.verdict == "not_driven"
    assert d.causes == ()


def test_the_papers_method_identifies_what_it_can_and_names_the_rest(tmp_path: Path) -> None:
    path = write(tmp_path / "r.csv", without_current(4))
    ended = command("identify", path, "--method", "paper", "-o", tmp_path / "m.json")
    assert ended.code == 0, ended.words
    assert error_share(tmp_path / "m.json") < 0.1
    assert "step" in ended.words  # which its conditions lack
