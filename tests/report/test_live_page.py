"""A page whose model is alive: moved as people move it, and still what Python simulates."""

import json
import math
import re
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.design.tracking.targets import respond
from psa_casadi.model.model_file import loads
from psa_casadi.model.variables import Interval, Provenance
from psa_casadi.report.page import live
from psa_casadi.report.page.designs import write_design_page
from psa_casadi.report.page.live import LiveModel, live_data, live_design, thinned
from tests.any_model import own_models
from tests.any_model import own_plants as plants
from tests.report.browser import DARK, Browser, driven, script
from tests.report.html_page import Page
from tests.report.report_cases import diagnosis
from tests.tiers import slow

pytestmark = pytest.mark.xdist_group("browser")

NASTY = "<img src=x onerror=alert(1)>"


@pytest.fixture(scope="module")
def case() -> psa.StackDiagnosis:
    """A diagnosis of two records, of a name that is no HTML; an unnamed correction adds 20 nm."""
    d = diagnosis("cause_named", ("rig_a", "rig_b"))
    first = d.experiments[0]
    named = replace(first, record=replace(first.record, name=NASTY))
    return replace(d, experiments=(named, *d.experiments[1:]))


@pytest.fixture(scope="module")
def page(case: psa.StackDiagnosis, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("live") / "page.html"
    psa.write_report(case, path)
    return path


def rms_of(d: psa.StackDiagnosis, values: dict[str, float]) -> float:
    """Return the held-out rms [nm] of the first record at other values, with a new offset."""
    e, fit = d.experiments[0], d.extended_fit
    model = d.model.with_values(values)
    trajectory = psa.simulate_record(
        model, e.record, fit.unknowns.start(fit.theta, 0), as_exported=False
    )
    residual = e.record.measured - trajectory.displacement
    observed, center = np.isfinite(residual), (e.record.measured - d.extended[0])
    use = observed & ~e.held_out
    residual += np.mean(center[use]) - np.mean(residual[use])
    return 1e9 * float(np.sqrt(np.mean(residual[observed & e.held_out] ** 2)))


@pytest.fixture(scope="module")
def moved(browser: Browser, page: Path) -> dict[str, Any]:
    table: dict[str, Any] = driven(browser, page, script("live"), DARK)
    return table


def rms_in(text: str, before: str = "held-out samples: ") -> float:
    """Return an error [nm] that a text states after some words."""
    result = re.search(before + r"([\d.e+-]+) (nm|µm)", text)
    assert result is not None, text
    return float(result[1]) * (1e3 if result[2] == "µm" else 1.0)


def texts_around(browser: Browser, page: Path, name: str, value: float) -> list[str]:
    """Return what a page states before and after a parameter is set."""
    texts: list[str] = driven(browser, page, f"""
      var box = document.querySelector('.live'), first = box.querySelector('output').textContent;
      box.psa.set('{name}', {value});
      tell([first, box.querySelector('output').textContent]);""")  # fmt: skip
    return texts


@slow
def test_a_moved_slider_shows_what_python_simulates(
    moved: dict[str, Any], case: psa.StackDiagnosis
) -> None:
    names = case.model.parameter_names
    at = dict(zip(names, moved["values"], strict=True))
    changed = {n: v for n, v in at.items() if v != case.model.values[n]}
    assert list(changed) == ["k_L"]
    assert changed["k_L"] == pytest.approx(100.0**0.62, rel=1e-9)  # from 1 to 100
    assert rms_in(moved["moved"]) == pytest.approx(rms_of(case, changed), rel=6e-3)
    assert rms_in(moved["first"]) == pytest.approx(rms_of(case, {}), rel=6e-3)
    assert moved["changed"]
    assert "% is removed" in moved["first"]
    assert "more than the base model leaves" in moved["moved"]


@slow
def test_the_error_budget_follows(moved: dict[str, Any], case: psa.StackDiagnosis) -> None:
    assert moved["fitted"] == []  # no effect is on
    at = dict(zip(case.model.parameter_names, moved["then"], strict=True))
    values = {n: at[n] for n in ("k_L", "tau", "creep_gain")}
    noise = 1e9 * case.noise_floor_rms_m  # the levels of both records are the same
    now, without = (
        rms_of(case, {**values, **off}) ** 2 - noise**2 for off in ({}, {"creep_gain": 0.0})
    )
    name, size, share = moved["budget"]
    assert name == "slow creep"
    assert rms_in(size, "") == pytest.approx(without**0.5, rel=6e-3)
    removes = max(0.0, 100 * (1 - now / without))  # cut: at these values it adds error
    assert float(share.split("\u00a0")[0]) == pytest.approx(removes, abs=0.6)
    assert moved["cut"] == ["0\u00a0%", "75\u00a0%"]  # an effect that adds error removes nothing


@slow
def test_switches_numbers_and_reset_work(moved: dict[str, Any], case: psa.StackDiagnosis) -> None:
    at = dict(zip(case.model.parameter_names, moved["then"], strict=True))
    assert at["tau"] == pytest.approx(2.5e-4, rel=1e-12)
    assert at["creep_gain"] > 0.0
    values = {n: at[n] for n in ("k_L", "tau", "creep_gain")}
    assert rms_in(moved["switched"]) == pytest.approx(rms_of(case, values), rel=6e-3)
    assert moved["reset"] == moved["first"]
    assert moved["again"]
    low, high = moved["reach"]
    assert high - low == pytest.approx(0.5 * 1.499, rel=1e-3)


@slow
def test_an_effect_that_is_switched_off_is_explained_at_the_error(
    browser: Browser, case: psa.StackDiagnosis, tmp_path: Path
) -> None:
    model = case.model.with_values({"creep_gain": 0.02})
    psa.write_report(replace(case, model=model), tmp_path / "on.html")
    statement = texts_around(browser, tmp_path / "on.html", "creep_gain", 0)
    assert "nothing is fitted again" not in statement[0]
    assert "With slow creep off nothing is fitted again: all other values were" in statement[1]
    e = case.experiments[0]
    miss = (e.record.measured - case.base[0])[e.held_out & np.isfinite(e.record.measured)]
    base = 1e9 * float(np.sqrt(np.mean(miss**2)))
    assert f"The base model, fitted without any effect, leaves {base:.3g} nm." in statement[1]


@slow
def test_the_model_file_of_a_page_is_read(moved: dict[str, Any], case: psa.StackDiagnosis) -> None:
    model = loads(moved["file"])
    assert model.parameter_vector().tolist() == moved["values"]
    assert "k_L" not in model.provenance.intervals
    assert model.provenance.intervals["tau"] == case.model.provenance.intervals["tau"]
    assert "by hand" in model.provenance.notes[-1]


@slow
def test_names_are_text_and_no_foreign_script_runs(
    moved: dict[str, Any], page: Path, browser: Browser, tmp_path: Path
) -> None:
    assert moved["images"] == 0
    assert NASTY in moved["options"]
    text = page.read_text(encoding="utf-8")
    assert len(text) < 3e6
    assert re.findall(r"(?:src|href)=\"(?!data:image/png|#)", text) == []
    foreign = tmp_path / "foreign.html"
    script = "<script>document.title = 'taken'</script></body>"
    foreign.write_text(script.join(text.rsplit("</body>", 1)), encoding="utf-8")
    document, console = browser.document(foreign)
    assert "<title>taken" not in document
    assert len(console) == 1
    assert "Content Security Policy" in console[0]
    assert 'class="knob' in document  # the page's scripts did


@slow
def test_a_designed_voltage_runs_in_its_page(browser: Browser, tmp_path: Path) -> None:
    model = psa.stack_model("P-885.51").plant()
    t = np.linspace(0.0, 0.02, 400)
    played = respond(model, t, 60.0 - 50.0 * np.cos(2.0 * np.pi * 100.0 * t))
    record = (t, played.voltage, played.displacement)
    path = played.displacement + 50e-9
    played_again = live_design(model, record, path, rest=True)
    write_design_page(
        tmp_path / "d.html", title="A design", summary=["It moves."], live=played_again
    )
    statement = texts_around(browser, tmp_path / "d.html", "k_L", 8)
    assert statement[0].startswith("Off the path by 50 nm rms")
    changed = respond(model.with_values({"k_L": 8.0}), t, played.voltage).displacement
    off = 1e9 * float(np.sqrt(np.mean((path - changed) ** 2)))
    assert rms_in(statement[1], "by ") == pytest.approx(off, rel=6e-3)


@slow
def test_without_compiler_a_page_states_it(
    case: psa.StackDiagnosis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("psa_casadi.export.web.has_zig", lambda: False)
    monkeypatch.setattr(live, "has_zig", lambda: False)
    psa.write_report(case, tmp_path / "page.html")
    text = Page((tmp_path / "page.html").read_text(encoding="utf-8")).text
    assert "the model does not run. It takes a compiler" in text


def test_what_json_cannot_hold_stays_out_of_a_page() -> None:
    free = psa.Component(
        name="free_gain", description="a test", source="none", gain="g",
        equations=lambda _: psa.Equations(),
        parameters=(psa.Parameter("g", 0.0, "1", (-math.inf, math.inf), "any", scale=2.0),),
    )  # fmt: skip
    sure = Provenance(intervals={"k_L": Interval(1.0, math.inf), "tau": Interval(1e-5, 1e-3)})
    model = psa.stack_model("P-885.51").with_effect(free).with_values({}, provenance=sure)
    table = {p["name"]: p for p in live_data(model, b"")["parameters"]}
    json.dumps(table, allow_nan=False)
    assert table["k_L"]["interval"] is None
    assert table["tau"]["interval"] == [1e-5, 1e-3]
    assert table["g"]["ends"] == [-8.0, 8.0]
    low, high = table["k_L"]["ends"]
    assert low < model.values["k_L"] < high


def test_a_long_record_is_thinned_only_where_the_voltage_stays_the_same() -> None:
    t = np.linspace(0.0, 1.0, 10_001)
    slow_voltage, quick_voltage = np.sin(2 * np.pi * t), np.sin(2 * np.pi * 900 * t)
    part, note = thinned(t, [slow_voltage], 1000)
    assert len(part) <= 1000
    assert part[1] == 11
    assert "each 11th" in note
    part, note = thinned(t, [quick_voltage], 1000)
    assert part.tolist() == list(range(1000))
    assert "the first 1000" in note
    assert thinned(t, [quick_voltage], 20_000)[1] == ""


@slow
def test_a_users_model_runs_in_its_page(
    browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every output of a record and the model, at other values, as Python has them."""
    record = plants.motor(1, friction=0.0)
    result = psa.identify(own_models.motor(), record, starts=1)
    psa.write_fit_report(result, tmp_path / "page.html")
    R = 1.1 * result.model.values["R"]
    rows = driven(browser, tmp_path / "page.html", f"""
      var box = document.querySelector('.live'), list = box.querySelector('select');
      tell(Array.prototype.map.call(list.options, function (o) {{
        list.value = o.value; list.dispatchEvent(new Event('change'));
        box.psa.set('R', {R!r});
        return ['output', 'figcaption'].map(n => box.querySelector(n).textContent);
      }}));""")  # fmt: skip
    model = result.model.with_values({"R": R})
    time, u = record.time - record.time[0], record.columns["voltage"][:, None]
    x0 = np.array([result.fit.start(0).get(s.name, 0.0) for s in model.structure.states])
    y = dict(zip(model.output_names, psa.run(model, time, u, x0).y.T, strict=True))
    assert {row[1] for row in rows} == {"w over time", "i over time"}
    for text, caption in rows:
        name = caption.split()[0]
        output = re.search(r"^Error: ([\d.e+-]+) (m?)", text)
        assert output is not None, text
        misfit = float(np.sqrt(np.mean((record.columns[name] - y[name]) ** 2)))
        assert float(output[1]) * (1e-3 if output[2] else 1.0) == pytest.approx(misfit, rel=6e-3)
    psa.write_fit_report(result, tmp_path / "still.html", still=True)
    assert "Change the model and see" not in (tmp_path / "still.html").read_text("utf-8")
    monkeypatch.setattr(psa.Model, "sampled_names", ("held",))
    assert "sampled states" in LiveModel(result.model, Future(), []).cure()
