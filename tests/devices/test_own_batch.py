"""Many devices that are no stacks: another model, fitted to the records of each."""

import json
from pathlib import Path

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.devices.jobs import key_of
from psa_casadi.population.population import population
from tests.any_model import own_plants as plants
from tests.any_model.own_models import motor
from tests.report.html_page import Page


def write_motor(path: Path, seed: int, inertia: float = 3e-5, friction: float = 0.0) -> None:
    record = plants.motor(seed, friction, inertia=inertia)
    table = np.column_stack([record.time, *record.columns.values()])[:800]
    names = ["time [s]", "voltage [V]", "w [rad/s]", "i [A]"]
    np.savetxt(path, table, delimiter=",", header=",".join(names), comments="")


def test_a_heavy_motor_stands_out_of_a_population(tmp_path: Path) -> None:
    folder = tmp_path / "records"
    folder.mkdir()
    for k in range(6):
        write_motor(folder / f"m{k}.csv", seed=k + 1, inertia=3.3e-5 if k == 4 else 3e-5)
    (folder / "none.csv").write_text("time,voltage\n" + "\n".join(f"{k},1" for k in range(40)))
    options = psa.Options(model=motor(), words={"starts": 1, "known_start": True})
    done = psa.batch(folder, tmp_path / "results", options=options, workers=2)
    assert done.counts == {"done": 6, "refused": 1}
    assert "no output of the model 'motor'" in " ".join(done.devices[-1].problems)
    content = json.loads((tmp_path / "results" / "m1" / "identification.json").read_text("utf-8"))
    alone = psa.identify(motor(), folder / "m1.csv", starts=1, known_start=True)
    for name, parameter in content["parameters"].items():
        assert parameter["value"] == pytest.approx(alone.model.values[name], rel=1e-6)
    saved = psa.load_model(tmp_path / "results" / "m1" / "model.json")
    assert saved.values == pytest.approx(alone.model.values, rel=1e-6)
    summary = (tmp_path / "results" / "summary.csv").read_text("utf-8").splitlines()
    assert "J [kg.m2]" in summary[0]
    assert not [n for n in summary[0].split(",") if "[m]" in n or "[times" in n]  # nothing in them
    result = population(done.findings)
    assert {(o.device, o.parameter) for o in result.outliers} == {("m4", "J")}
    psa.write_population(result, tmp_path / "page.html")
    assert "1 of 6 devices stands out: m4." in Page((tmp_path / "page.html").read_text()).text
    again = psa.batch(folder, tmp_path / "results", options=options, workers=1)
    assert again.kept == 7
    jobs = [psa.Job("m1", (str(folder / "m1.csv"),))]
    other = psa.Options(model=motor().with_values({"b": 2e-5}), words=options.words)
    assert key_of(jobs[0], other) != key_of(jobs[0], options)


@pytest.mark.slow
def test_devices_that_are_no_stacks_are_diagnosed(tmp_path: Path) -> None:
    jobs = []
    for name, friction in (("dry", 0.012), ("oiled", 0.0)):
        write_motor(tmp_path / f"{name}.csv", 2, friction=friction)
        jobs.append(psa.Job(name, (str(tmp_path / f"{name}.csv"),)))
    fewer = ["hysteresis", "stop", "curve", "delay", "bend", "lag", "saturation"]
    options = psa.Options(work="diagnose", model=motor(), words={"leave_out": fewer})
    done = psa.batch(jobs, tmp_path / "results", options=options, workers=1)
    assert [f.verdict for f in done.findings] == ["cause_named", "adequate"]
    assert [c.effect for c in done.findings[0].causes] == ["friction_in_speed"]
