"""The playground: every effect on one page, any voltage, with the figures of Python."""

import base64
import csv
import shutil
import zipfile
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy.validation import validate_fmu

import psa_casadi as psa
from psa_casadi.export.common.variable_table import variable_table
from psa_casadi.model.model_file import loads
from psa_casadi.report.page.playground import playground
from psa_casadi.simulation.compiler import run_compiler
from tests.contract.helpers import done
from tests.model.sampled_models import controller
from tests.report.browser import Browser, driven, phone_view, script
from tests.tiers import slow

pytestmark = pytest.mark.xdist_group("browser")


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("playground") / "page.html"
    path.write_text(playground(), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def played(browser: Browser, page: Path) -> dict[str, Any]:
    table: dict[str, Any] = driven(browser, page, script("playground"), "--window-size=1200,2000")
    return table


@slow
def test_it_has_every_stack_and_effect(played: dict[str, Any], page: Path) -> None:
    assert set(played["stacks"]) == set(psa.STACKS)
    assert played["switches"] == [n.replace("_", " ") for n in psa.EFFECTS]
    assert page.stat().st_size < 3e6


@slow
def test_what_it_downloads_is_what_python_simulates(played: dict[str, Any]) -> None:
    head, *rows = csv.reader(played["csv"].splitlines())
    table = np.array(rows, dtype=float)
    assert len(table) == 300
    t, v = table[:, 0], table[:, head.index("voltage [V]")]
    assert np.ptp(v) == pytest.approx(120.0, rel=1e-3)
    model = psa.stack_model("P-885.51").with_effect(psa.EFFECTS["slow_creep"])
    gain = model.parameter("creep_gain").typical(model.values)
    model = model.with_values({"creep_gain": gain})
    wanted = psa.simulate(model, t, v).displacement
    displayed = table[:, head.index("measured_displacement [m]")]
    assert np.max(np.abs(displayed - wanted)) < 2e-6 * np.ptp(wanted)


@slow
def test_the_fmu_that_it_downloads_is_the_model_with_these_values(
    played: dict[str, Any], tmp_path: Path
) -> None:
    path, folder = tmp_path / "page.fmu", tmp_path / "fmu"
    path.write_bytes(base64.b64decode(played["fmu"]))
    assert validate_fmu(str(path)) == []
    with zipfile.ZipFile(path) as archive:
        archive.extractall(folder)
    equations = (folder / "documentation" / "index.html").read_text(encoding="utf-8")
    assert "<h1>PTBS200</h1>" in equations
    assert "creep_gain" in equations
    model, stack = loads(played["chosen"]), psa.stack_model("PTBS200")
    assert model.name == "PTBS200"
    assert {n for n, v in stack.values.items() if model.values[n] != v} == {"tau"}
    assert model.values["creep_gain"] > 0.0
    described = {v.name: v for v in fmpy.read_model_description(folder).modelVariables}
    assert {n: float(described[n].start) for n in model.values} == model.values
    table = {v.name: v.nominal for v in variable_table(model)}
    assert [float(described[n].nominal) for n in model.state_names] == [
        table[n] for n in model.state_names
    ]
    others = {c.gain for c in psa.EFFECTS.values()} - {"creep_gain"}
    assert {float(described[gain].start) for gain in others if gain} == {0.0}

    if not shutil.which("gcc"):
        pytest.skip("gcc is not installed")
    lines = (folder / "sources" / "README.txt").read_text(encoding="utf-8").splitlines()
    line = next(t for t in lines if " cc " in t).replace("-O2", "-O0").split()
    run_compiler(["gcc", *line[1:]], folder / "sources")
    binaries = folder / "binaries" / fmpy.platform_tuple
    binaries.mkdir(parents=True)
    shutil.move(folder / "sources" / line[-1], binaries)
    t = np.linspace(0.0, 4e-3, 401)
    v = 100.0 * np.where((t > 2e-4) & (t < 3.5e-3), 1.0 - np.cos(2.0 * np.pi * t / 2e-3), 0.0)
    result = fmpy.simulate_fmu(
        folder, fmi_type="CoSimulation", stop_time=t[-1], output_interval=t[1],
        relative_tolerance=1e-8,
        input=np.array(list(zip(t, v, strict=True)), [("time", float), ("voltage", float)]),
    )  # fmt: skip
    wanted = psa.simulate(model, t, v, rtol=1e-9, hold="zero").displacement
    assert np.max(np.abs(result["measured_displacement"] - wanted)) < 1e-7 * np.ptp(wanted)


@slow
def test_its_model_file_has_what_is_switched_on(played: dict[str, Any]) -> None:
    model = loads(played["file"])
    base = psa.stack_model("P-885.51")
    assert [c.name for c in model.effects] == ["slow_creep"]
    assert {n: model.values[n] for n in base.values} == base.values
    assert (model.name, model.description) == (base.name, base.description)


@slow
def test_voltage_effect_and_stack_change_the_text(played: dict[str, Any]) -> None:
    assert "add up to 0 nm" in played["plain"]
    items = [played[k] for k in ("plain", "effect", "other", "drawn")]
    assert len(set(items)) == 4
    assert all(s.startswith("Stroke ") for s in items)
    assert played["knobs"] == len(psa.EFFECTS["slow_creep"].parameters)
    assert list(played["corners"].values()) == [0.0, 50.0, 100.0, 75.0, 50.0]
    assert list(played["read"]["t"].values()) == pytest.approx([0.0, 1e-3, 2e-3, 3.5e-3])
    assert list(played["read"]["v"].values()) == pytest.approx([100.0, 200.0, 300.0, 100.0])
    assert played["none"] == [None, None]


@slow
def test_a_voltage_beyond_the_rated_one_and_uneven_times_are_stated(played: dict[str, Any]) -> None:
    text = "The voltage reaches 900 V; P-885.51 is rated for 120 V."
    assert played["beyond"].startswith(text)
    assert played["within"]
    even = {k: list(played["even"][k].values()) for k in ("t", "v")}
    assert even["t"] == pytest.approx(np.linspace(0.0, 19.19, 20))
    assert even["v"] == pytest.approx(2.0 * np.array(even["t"]))
    assert "even grid" in played["even"]["note"]


@slow
def test_it_fits_a_phone_and_keeps_nobody_out(browser: Browser, page: Path) -> None:
    table = phone_view(browser, page)
    assert table["outside"] == []
    assert table["needed"] == table["width"]
    assert table["smallest"] >= 9
    assert browser.serious_faults(page) == []


@slow
def test_the_command_plays_a_users_model(tmp_path: Path) -> None:
    model = psa.stack_model("PTBS200").with_effect(psa.EFFECTS["slow_creep"], {"creep_gain": 0.02})
    psa.save_model(model, tmp_path / "m.json")
    done("web", tmp_path / "m.json", "-o", tmp_path / "p.html", "--quiet")
    text = (tmp_path / "p.html").read_text(encoding="utf-8")
    assert "Play with PTBS200" in text
    assert "0.02" in text


def test_what_is_no_stack_is_refused() -> None:
    with pytest.raises(psa.InputError, match="no stack"):
        playground(controller())
