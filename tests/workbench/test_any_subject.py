"""The page on an FMU, whose records have other columns than a stack."""

import base64
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np

import psa_casadi as psa
from psa_casadi.cli.inputs import Fitting, Inputs, own_model
from psa_casadi.cli.web import _subject
from psa_casadi.cli.workbench.desk import Desk
from psa_casadi.cli.workbench.server import served
from tests.export.supplied import INFLOW, TIMES, lagged, level, supplied
from tests.tiers import posix, slow
from tests.workbench.test_workbench import Tab

FREE = ["area=0.1:4", "outlet=0.001:0.01"]


def _desk(folder: Path, fitting: Fitting, module: str) -> Desk:
    model = own_model(Inputs(), None, fitting)
    (folder / "desk").mkdir()
    return Desk(folder / "desk", [], subject=_subject(model, None, fitting), module=module)


def _measured(folder: Path) -> bytes:
    """Return a record of the supplier's tank whose sensor has a lag of 2 s."""
    noise = 1e-3 * np.random.default_rng(5).standard_normal(len(TIMES))
    y = lagged(level(0.8, 0.004), 2.0) + noise
    columns = {"time [s]": TIMES, "inflow [1]": INFLOW, "h [%]": 100.0 * y}
    psa.write_record(folder / "run.csv", columns)
    return (folder / "run.csv").read_bytes()


def test_the_columns_are_those_of_the_fmu(tmp_path: Path) -> None:
    fitting = Fitting(fmu=supplied("tank"), free=FREE, value=["valve=1"])
    desk = _desk(tmp_path, fitting, "tests.workbench.small_job")
    with served(0, desk) as server:
        tab = Tab(server).enter()
        page = tab.ask("GET", "/")[2].decode()
        assert "level" in page
        assert "charge" not in page.partition('id="page-data">')[2]
        assert tab.give("model.json", b"{}") == 400
        assert tab.give("run.csv", _measured(tmp_path)) == 200
        observed = tab.state()["items"][0]["seen"]
        assert observed["head"]["guess"] == {"time": [0, "s"], "inflow": [1, "1"]}
        assert tab.post("/settings", {"columns": "level=h:%"}) == 200
        observed = tab.state()["items"][0]["seen"]
        assert observed["problems"] == []
        assert observed["record"]["reached"]["level"][2] == "%"
        assert base64.b64decode(observed["record"]["picture"]).startswith(b"\x89PNG")
        assert tab.post("/start") == 200
        (desk.folder / "let_go").touch()
        tab.until("done")
    words = (desk.folder / "words.txt").read_text().splitlines()
    named = {f"--fmu={supplied('tank').name}", "--value=valve=1", *(f"--free={f}" for f in FREE)}
    assert named < {*words}


@slow
def test_a_lag_is_named_and_the_extended_fmu_written(tmp_path: Path) -> None:
    fitting = Fitting(fmu=supplied("tank"), free=FREE, value=["valve=1"])
    desk = _desk(tmp_path, fitting, "psa_casadi.cli.child")
    with served(0, desk) as server:
        tab = Tab(server).enter()
        tab.give("run.csv", _measured(tmp_path))
        tab.post("/settings", {"columns": "level=h:%"})
        assert tab.post("/start") == 200
        state = tab.until("done", 240.0)
        assert state["result"]["verdict"] == "cause_named"
        assert [c["effect"] for c in state["result"]["causes"]] == ["lag_of_level"]
        assert state["run"]["events"][-1]["state"] == "best"
        assert tab.post("/export") == 200
        state = tab.wait(lambda s: s["export"]["status"] != "running", 240.0)
        assert state["export"]["status"] == "done", state["export"]
    assert desk.result("extended.fmu") is not None


@posix
def test_the_page_ends_whenever_it_is_interrupted(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "psa_casadi.cli", "web", "--diagnose", "--no-browser"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline().startswith("Open http://127.0.0.1:")
    process.send_signal(signal.SIGINT)  # while the next line may not be there yet
    assert "Ended" in process.communicate(timeout=20)[1]
    assert process.returncode == 0
