"""Designs, many devices, diagnoses of users' models, posteriors: longer work and its files."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

import psa_casadi as psa
from tests.any_model import own_plants
from tests.any_model.own_models import motor
from tests.contract.helpers import done, off, on_reference, reference_run, rms, table, write
from tests.report.html_page import read_page
from tests.report.test_schemas import valid

pytestmark = pytest.mark.slow
STACK = "P-885.51"


def test_a_designed_experiment_keeps_its_limits_and_separates(tmp_path: Path) -> None:
    out, page = tmp_path / "v.csv", tmp_path / "page.html"
    text = done(
        "design", "experiment", "--stack", STACK, "--duration", "0.5", "--samples", "60",
        "--high", "60", "--rate", "2000", "--family", "triangles", "--starts", "1",
        "--separate", "sensor_nonlinearity", "slow_creep", "-o", out, "--report", page, "--still",
    ).words  # fmt: skip
    columns = table(out)
    time, voltage = columns["time [s]"], columns["voltage [V]"]
    assert len(time) == 60
    assert time[-1] - time[0] == pytest.approx(0.5, rel=0.05)
    assert voltage.min() >= 0.0
    assert voltage.max() <= 60.0
    assert np.max(np.abs(np.diff(voltage) / np.diff(time))) <= 2000.0 * 1.001
    assert np.ptp(voltage) > 30.0
    assert "sensor nonlinearity" in text
    assert "slow creep" in text
    read_page(page)


def test_a_designed_voltage_follows_its_path_on_the_independent_reference(tmp_path: Path) -> None:
    time = np.linspace(0.0, 0.04, 201)
    wanted = 4.0 - 4.0 * np.cos(2.0 * np.pi * time / 0.04)
    path = write(tmp_path / "path.csv", {"Zeit [s]": time, "Sollwert [um]": wanted})
    done(
        "design", "input", "--stack", STACK, "--target", path, "--max-voltage", "100",
        "-o", tmp_path / "v.csv", "--no-check-fmu",
    )  # fmt: skip
    columns = table(tmp_path / "v.csv")
    t, v = columns["time [s]"], columns["voltage [V]"]
    assert v.max() <= 100.0
    reached = on_reference(psa.stack_model(STACK).values, t, v).displacement
    assert off(1e6 * reached, np.interp(t, time, wanted)) < 2e-3
    plain = v.max() * wanted / wanted.max()
    assert np.max(np.abs(v - np.interp(t, time, plain))) > 0.03 * v.max()


def test_a_designed_mechanism_damps_the_stack_as_requested(tmp_path: Path) -> None:
    mount, port = tmp_path / "mount.json", tmp_path / "stack.json"
    done(
        "design", "mechanism", "--stack", "PTBS200", "--damping", "0.7", "--starts", "1",
        "-o", mount, "--port", port,
    )  # fmt: skip
    assert json.loads(mount.read_text("utf-8"))["components"] == ["prestress_mechanism"]
    m = psa.load_model(mount).values
    assert 0.0 < m["m_m"] <= 1.0
    assert "prestress_force" in psa.load_model(port).input_names
    p = psa.stack_model("PTBS200").values

    wafers, tip = [p["m_P"], p["c_P"], p["k_P"]], [p["m_B"], p["c_B"], p["k_B"]]
    passed = [p["c_P"] + p["c_B"], p["k_P"] + p["k_B"]]

    def least_damping(mechanism: list[float]) -> float:
        """Of the poles of (4) and (5) with the mechanism's force on the wafers (paper, eq. 45)."""
        closed = np.polyadd(np.polymul(wafers, tip), np.polymul(passed, mechanism))
        poles = np.roots(closed)
        return float(np.min(-poles.real / np.abs(poles)))

    assert least_damping([0.0, 0.0, 0.0]) < 0.1
    assert least_damping([m["m_m"], m["c_m"], m["k_m"]]) >= 0.7 * (1.0 - 1e-6)
    compliance = passed[-1] / (wafers[-1] * tip[-1])
    assert 1.0 - 1.0 / (1.0 + compliance * m["k_m"]) <= 0.1 * (1.0 + 1e-6)


@pytest.fixture
def devices(tmp_path: Path) -> Path:
    """Return a folder with four devices of unlike force, and a third that is no record."""
    folder = tmp_path / "records"
    (folder / "first").mkdir(parents=True)
    time = 1e-2 * np.arange(240, dtype=np.float64)
    voltage = (50.0 - 50.0 * np.cos(4 * np.pi * time)) * np.exp(-0.2 * time)
    for path, force, seed in (
        ("first/loops.csv", 1.0, 1), ("second.csv", 1.05, 2), ("fourth.csv", 1.01, 4),
        ("fifth.csv", 0.99, 5),
    ):  # fmt: skip
        values = dict(psa.stack_model(STACK).values)
        values["k_L"] *= force
        x = on_reference(values, time, voltage).displacement
        noise = 3e-3 * np.random.default_rng(seed).standard_normal(time.size)
        columns = {"time [s]": time, "voltage [V]": voltage, "displacement [um]": 1e6 * x + noise}
        write(folder / path, columns)
    (folder / "third.csv").write_text("time [s],voltage [V],displacement [um]\n0,a,1\n")
    return folder


def test_many_devices_are_worked_on_and_one_that_fails_stops_none(
    devices: Path, tmp_path: Path
) -> None:
    out, page = tmp_path / "results", tmp_path / "population.html"
    text = done("batch", devices, "-o", out, "--workers", "1", "--report", page).words
    assert "5 devices: 4 done, 1 refused." in text
    with (out / "summary.csv").open(encoding="utf-8") as stream:
        rows = {row["device"]: row for row in csv.DictReader(stream)}
    first = float(rows["first"]["k_L [N/V]"])
    for name, ratio in (("second", 1.05), ("fourth", 1.01), ("fifth", 0.99)):
        assert float(rows[name]["k_L [N/V]"]) / first == pytest.approx(ratio, abs=0.005)
    assert rows["third"]["k_L [N/V]"] == ""
    assert "line 2" in rows["third"]["problems"]
    for name in ("first", "second"):
        for kind in ("identification", "device", "model"):
            valid(kind, (out / name / f"{kind}.json").read_text("utf-8"))
    assert "third" in read_page(page)[1].text
    (devices / "second.csv").write_bytes((devices / "fourth.csv").read_bytes())
    again = psa.batch(devices, out, workers=1)
    assert again.kept == 4
    assert dict(again.counts) == {"done": 4, "refused": 1}
    findings = {f.device: f for f in psa.read_findings([out / "second", out / "fourth"])}
    assert list(findings) == ["second", "fourth"]
    assert len({psa.load_model(out / n / "model.json").values["k_L"] for n in findings}) == 1


def test_friction_of_a_motor_is_named_with_its_size(tmp_path: Path) -> None:
    """A user's model, and a plant with other equations and dry friction at its shaft."""
    d = psa.diagnose(motor(), own_plants.motor(1))
    assert isinstance(d, psa.Diagnosis)
    assert d.verdict == "cause_named"
    assert [c.effect for c in d.causes] == ["friction_in_speed"]
    assert d.causes[0].port == "the rate of speed"
    assert d.model.values["friction_in_speed_size"] == pytest.approx(0.012 / 3e-5, rel=0.02)
    for error, noise in zip(d.errors, (0.3, 0.005), strict=True):
        assert error.base > 5.0 * noise
        assert error.extended == pytest.approx(noise, rel=0.06)
    document = valid("own_model", d.to_json())
    assert document["causes"][0]["effect"] == "friction_in_speed"
    assert repr(d).startswith("cause_named")
    d.report(tmp_path / "motor.html")
    assert "friction" in read_page(tmp_path / "motor.html")[1].text
    frame = d.to_frame()
    held = frame["held_out"].to_numpy()
    misfit = (frame["w [rad/s]"] - frame["w_extended [rad/s]"]).to_numpy()
    assert rms(misfit[held]) == pytest.approx(d.errors[0].extended, rel=0.01)
    psa.export_fmu(d.model, tmp_path / "motor.fmu")


def test_a_posterior_holds_the_truth(tmp_path: Path) -> None:
    pytest.importorskip("nutpie")
    arviz = pytest.importorskip("arviz")
    time, voltage, clean = reference_run(STACK, 0.3, 301)
    x = clean.displacement
    y = x + 1e-3 * np.ptp(x) * np.random.default_rng(5).standard_normal(len(x))
    record = psa.Record(name="loops", time=time, voltage=voltage, displacement=y)
    result = psa.sample(
        psa.stack_model(STACK), [record], free=["k_L", "tau"], draws=150, tune=150, chains=1, seed=1
    )
    frame, truth = result.to_frame(), psa.stack_model(STACK).values
    rows = {row.name: row for row in frame.itertuples(index=False)}
    for name in ("k_L", "tau"):
        assert abs(rows[name].mean - truth[name]) < 5.0 * rows[name].sd
        assert rows[name].low < rows[name].mean < rows[name].high
        assert rows[name].sd < 0.05 * truth[name]
    result.save(tmp_path / "p.nc")
    tree = arviz.from_netcdf(tmp_path / "p.nc")
    assert {"posterior", "prior_predictive", "posterior_predictive"} < set(tree.groups())
    draws = tree.posterior["k_L"].to_numpy()
    assert draws.shape == (1, 150)
    assert np.mean(draws) == pytest.approx(rows["k_L"].mean, rel=1e-6)
    with pytest.raises(psa.InputError, match="'nothing' is no parameter"):
        psa.sample(psa.stack_model(STACK), [record], free=["nothing"])
