"""Diagnosis of models that are no stacks: causes that independent plants hide, and clean ones."""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import iv

import psa_casadi as psa
from build_scripts import effects_page
from build_scripts.page_commands import Block, block_in_tests, blocks_in_tests
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.generic import effects_of, extended
from psa_casadi.diagnosis.result import DiagnosisInterrupted
from psa_casadi.examples import motor_pack, several_motors
from psa_casadi.identification.experiments import experiments_of
from psa_casadi.model.ports import ports_of, with_ports
from psa_casadi.records.signals import Signals
from psa_casadi.report.words.verdict_words import verdict_sentence
from psa_casadi.simulation.simulate import record_inputs
from psa_casadi.simulation.sizes import Sizes, sizes_of
from tests.any_model import own_plants as plants
from tests.any_model.own_models import motor, oscillator, pair, tanks
from tests.report.browser import DARK, find_browser
from tests.report.html_page import Page, figures, numbers
from tests.report.test_schemas import valid


@cache
def _hysteresis() -> psa.Diagnosis:
    return psa.diagnose(oscillator(), plants.bouc_wen(1))


def _only(d: psa.Diagnosis, effect: str) -> bool:
    return d.verdict == "cause_named" and [c.effect for c in d.causes] == [effect]


def test_a_clean_model_of_two_outputs_is_identified_with_its_errors(tmp_path: Path) -> None:
    result = psa.identify(motor(), plants.motor(2, friction=0.0), starts=3)
    true = {"R": 1.2, "k": 0.05, "J": 3e-5, "b": 2e-5}
    for name, value in true.items():
        assert abs(result.model.values[name] - value) < 4.0 * result.errors[name]
        assert result.errors[name] < 0.05 * value
    assert result.rms["w"] == pytest.approx(0.3, rel=0.05)
    assert result.rms["i"] == pytest.approx(0.005, rel=0.05)
    assert not result.warnings
    assert result.model.provenance.identified_from[0][0] == "drive"
    result.report(tmp_path / "fit.html")
    page = Page((tmp_path / "fit.html").read_text("utf-8"))
    assert "w by 0.301 rad/s (1.0 times its noise) and i by 4.95 mA" in page.text
    assert "R 1.200 1.199 to 1.200 Ohm fit" in page.text
    assert page.loaded == []


def test_pages_hold_every_output_of_every_record(tmp_path: Path) -> None:
    whole = plants.motor(2, friction=0.0)
    parts = [
        replace(
            whole, name=name, time=whole.time[part],
            columns={n: v[part] for n, v in whole.columns.items()},
        )
        for name, part in (("first", slice(None, 1500)), ("second", slice(1500, None)))
    ]  # fmt: skip
    result = psa.identify(motor(), parts, starts=1)
    result.report(tmp_path / "fit.html")
    page = Page((tmp_path / "fit.html").read_text("utf-8"))
    for name in ("w of first", "w of second", "i of first", "i of second"):
        assert name in page.text


def test_a_model_of_one_state_is_diagnosed(tmp_path: Path) -> None:
    """A heater whose loss grows with the square of the temperature, as in a draught."""
    t, u, c = np.arange(400) * 0.05, ca.SX.sym("power"), ca.SX.sym("T")
    power = 1.0 + np.sin(t) + 0.5 * np.sin(3.1 * t)
    loss = ca.SX.sym("loss")
    heater = psa.ode_model(
        {"x": c, "u": u, "p": loss, "ode": u - loss * c, "y": c}, name="heater",
        inputs=["power"], outputs=["temperature"], values={"loss": 1.0},
    )  # fmt: skip
    true = solve_ivp(
        lambda s, y: np.interp(s, t, power) - 1.3 * y - 0.3 * y * np.abs(y), (0.0, t[-1]), [0.0],
        t_eval=t, max_step=0.05,
    ).y[0]  # fmt: skip
    noise = 0.002 * np.random.default_rng(1).standard_normal(len(t))
    record = {"time": t, "power": power, "temperature": true + noise}
    d = psa.diagnose(heater, record, leave_out=["hysteresis", "stop"])
    assert d.causes[0].effect == "drag_in_T"
    assert d.explained_share > 0.99
    d.report(tmp_path / "heater.html", still=True)
    assert "Drag in T:" in Page((tmp_path / "heater.html").read_text("utf-8")).text


@pytest.mark.slow
def test_causes_that_cancel_each_other_are_reported() -> None:
    """A heater whose capacity grows with its temperature: no effect of the table does that."""
    rng, t = np.random.default_rng(3), 2.0 * np.arange(700)
    power = np.repeat(rng.uniform(0.0, 120.0, 14), 50)

    def rates(time: float, x: FloatArray) -> list[float]:
        flow, heat = 4.0 * (x[0] - x[1]), power[min(int(time / 2.0), 699)]
        return [(heat - flow) / (280.0 + 1.12 * x[0]), (flow - 1.2 * x[1]) / 150.0]

    both = solve_ivp(rates, (0.0, t[-1]), [0.0, 0.0], t_eval=t, max_step=1.0, rtol=1e-8).y
    core, shell = both + 0.05 * rng.standard_normal(both.shape)
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    p = ca.SX.sym("p", 4)
    flow = p[2] * (x[0] - x[1])
    heater = psa.ode_model(
        {"x": x, "u": u, "p": p, "ode": ca.vertcat((u - flow) / p[0], (flow - p[1] * x[1]) / p[3]),
         "y": x},
        name="heater", inputs=["power"], outputs=["core", "shell"],
        parameters=[
            psa.Parameter(n, v, "1", (0.01, 5000.0), "", log=True)
            for n, v in (("C", 200.0), ("G", 1.0), ("K", 3.0), ("D", 100.0))
        ],
    )  # fmt: skip
    kinds = ["hysteresis", "stop", "lag", "delay", "drift", "zero", "dead", "friction"]
    d = psa.diagnose(
        heater, {"time": t, "power": power, "core": core, "shell": shell}, hold="zero",
        leave_out=kinds,
    )  # fmt: skip
    assert len(d.causes) > 1
    assert any("they cancel each other" in note for note in d.notes)


#: Tests that share a diagnosis run in one process.
shares_hysteresis = pytest.mark.xdist_group("oscillator hysteresis")
_HOSTILE = "</script><img src=x onerror=alert(1)> $x_"


@pytest.mark.slow
@shares_hysteresis
def test_the_hysteresis_of_the_benchmark_is_detected_in_the_restoring_force() -> None:
    d = _hysteresis()
    assert _only(d, "hysteresis_of_x_in_v")
    assert d.causes[0].port == "the rate of v"
    assert d.causes[0].confidence > 0.95
    assert d.errors[0].base > 15.0 * d.errors[0].extended
    assert d.errors[0].extended == pytest.approx(8e-6, rel=0.06)  # the noise
    # the plant's parameters, through an effect of other coordinates
    assert d.model.values["m"] == pytest.approx(2.0, rel=0.01)
    assert d.model.values["k"] == pytest.approx(5e4, rel=0.01)
    per_m = d.model.values["hysteresis_of_x_in_v_size"]
    per_m /= d.model.values["hysteresis_of_x_in_v_range"]
    assert per_m * d.model.values["m"] == pytest.approx(5e4, rel=0.02)  # alpha
    assert d.model.values["hysteresis_of_x_in_v_n"] == pytest.approx(1.0, abs=0.02)  # nu


@pytest.mark.slow
@shares_hysteresis
def test_the_page_of_a_diagnosis_shows_the_story(tmp_path: Path) -> None:
    d, path = _hysteresis(), tmp_path / "page.html"
    psa.write_report(d, path)
    text = path.read_text("utf-8")
    page = Page(text)
    (run,) = d.experiments
    held = (run.measured(0) - d.extended[0][:, 0])[run.held_out]
    rms = 1e6 * np.sqrt(np.mean(held**2))
    assert page.text.startswith("Diagnosis of oscillator: cause named")
    assert (
        "The cause is hysteresis of x in v (the rate of v, confidence 98 %: extremely likely):"
        f" it removes {d.budget.together.percents[0]} % of the base" in page.text
    )
    assert "position: error on held-out samples, rms base model 160 µm" in page.text
    assert f"extended model {rms:.2f} µm" in page.text
    rival = replace(d.causes[0], confidence=0.6, cannot_be_told_from=("stop_of_x",))
    statement = "(the rate of v, confidence 60 %: more likely than not; or stop of x)"
    assert statement in verdict_sentence(replace(d, causes=(rival,)))
    assert re.search(r"hysteresis_of_x_in_v_n 0\.99\d+ 0\.99\d+ to 1\.0\d+ 1 fit", page.text)
    assert page.loaded == []
    assert page.targets <= page.names
    assert "default-src 'none'" in text
    above, below, *_ = (t for t in figures(text)[0]["data"] if t["name"] == "base model")
    miss = 1e3 * (run.measured(0) - d.base[0][:, 0])  # in mm
    assert np.max(np.abs(numbers(below["y"]))) == pytest.approx(np.max(np.abs(miss)), rel=1e-5)
    assert len(numbers(above["y"])) == len(numbers(below["y"])) > 1000
    assert path.stat().st_size < 3_000_000
    output = psa.story(d, width=300).splitlines()
    assert output[0].startswith("verdict    cause named. The cause is hysteresis of x in v")
    (error,) = (line for line in output if line.startswith("error"))
    assert f"position: held-out rms 160 µm of the base, {rms:.2f} µm of the e" in error
    linear = psa.run(
        d.model.with_values({"hysteresis_of_x_in_v_size": 0.0}), run.record.time,
        record_inputs(d.model, run.record, run.record.n),
        np.zeros(len(d.model.state_names)), hold="linear",
    ).y[:, 0]  # fmt: skip
    size = f"it moves the position by up to {1e3 * np.ptp(d.extended[0][:, 0] - linear):.3g} mm"
    assert size in output[1]
    assert size in page.text
    assert "Against it: approach from the same side" in page.text
    document = valid("own_model", d.to_json())
    assert document["causes"][0]["port"] == "the rate of v"
    low, high = document["budget"]["causes"][0]["interval"]
    assert 0.9 < low < d.explained_share < high
    items = [f"{100 * x:.2f}" for x in (d.explained_share, low, 1.0)]
    displayed = f"hysteresis of x in v {items[0]} % {items[1]} to {items[2]} %"
    assert displayed in page.text  # cut, as no share is above 100 %
    assert find_browser(tmp_path).serious_faults(path, DARK) == []


@pytest.mark.slow
@shares_hysteresis
def test_what_a_user_wrote_is_text_in_the_page(tmp_path: Path) -> None:
    d, path = _hysteresis(), tmp_path / "page.html"
    (run,), (cause,) = d.experiments, d.causes
    hostile = replace(
        d,
        experiments=(replace(run, record=replace(run.record, name=_HOSTILE)),),
        causes=(replace(cause, description=_HOSTILE),),
        base_remaining=replace(d.base_remaining, finding=_HOSTILE),
        remarks=(_HOSTILE,),
    )
    hostile.report(path)
    text = path.read_text("utf-8")
    assert "<img src=x" not in text
    page = Page(text)
    assert page.loaded == []
    assert page.text.count(_HOSTILE) >= 6  # the record thrice and more, cause, misfit, note


def _run(block: Block, names: dict[str, Any]) -> None:
    """Run the program of a page."""
    (program,) = block.commands
    exec("\n".join(program.split("\n")[1:-1]), names)


def test_an_oscillator_is_sampled_and_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The program of the page, with a model that has no input."""
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    _run(block_in_tests("docs/python.md"), names)
    (mu,) = names["drawn"].figures
    assert abs(mu.mean - 1.0) < 4.0 * mu.sd < 0.05
    page = Page((tmp_path / "both.html").read_text("utf-8"))
    assert "Beyond noise, mu differs (1 parameter compared)." in page.text


@pytest.mark.slow
def test_dry_friction_of_a_motor_is_detected_at_its_shaft(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The program of the page, whose plant has separate equations."""
    monkeypatch.chdir(tmp_path)
    first, intermediates, effect = blocks_in_tests("docs/howto/own_model.md")
    names: dict[str, Any] = {}
    _run(first, names)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["motor.html", "motor_with_friction.fmu"]
    d = names["result"]
    assert isinstance(d, psa.Diagnosis)
    assert _only(d, "friction_in_speed")
    assert d.model.values["friction_in_speed_size"] == pytest.approx(0.012 / 3e-5, rel=0.02)
    for error, noise in zip(d.errors, (0.3, 0.005), strict=True):
        assert error.base > 5.0 * noise
        assert error.extended == pytest.approx(noise, rel=0.06)
    (share,) = d.budget.causes
    base, left = (
        sum((getattr(e, of) / e.noise) ** 2 for e in d.errors) for of in ("base", "extended")
    )
    assert d.explained_share == pytest.approx((base - left) / (base - 2.0), rel=1e-9)
    assert share.interval[0] < share.share < share.interval[1] < share.interval[0] + 0.1
    assert f"friction in speed removes {share.text}." in " ".join(repr(d).split())
    _run(intermediates, names)
    assert {p.variable for p in ports_of(names["carts"]) if p.kind == "intermediate"} == {"spring"}
    _run(effect, names)
    assert [c.effect for c in names["worn_result"].causes] == ["brush_drop"]
    several = several_motors.main(tmp_path)
    assert isinstance(several["posterior"], psa.Posterior)
    for f in several["posterior"].figures:
        true = {"k": 0.05, "J": 3e-5, "b": 2e-5}[f.name]
        assert abs(f.mean - true) < 4.0 * f.sd < 0.1 * true
    text = Page((tmp_path / "two_motors.html").read_text("utf-8")).text
    assert "Beyond noise, J differs (3 parameters compared)." in text
    assert several["outliers"] == "J of 4"
    assert (tmp_path / "motors.html").stat().st_size > 10_000


@pytest.mark.slow
@shares_hysteresis
def test_a_cause_that_no_effect_has_is_unexplained(tmp_path: Path) -> None:
    """The golden answer of `breathing` has the same verdict with all kinds of effects."""
    few = ["hysteresis", "stop", "curve"]
    d = psa.diagnose(oscillator(), plants.breathing(4), leave_out=few)
    assert d.verdict == "unexplained"
    assert not d.causes
    assert d.extended_fit is d.base_fit
    free = d.correction
    assert free is not None
    assert f"{free.share:.0%}" in d.unnamed
    output = d.budget.unnamed
    assert output is not None
    assert output.interval[0] < output.share == free.share < output.interval[1]
    x = d.experiments[0].measured(0)  # the state that it follows is what was measured
    assert free.variable == "x"
    assert len(free.along) == len(free.added) == len(x)
    assert np.std(x - free.along) < np.std(x - d.base[0][:, 0])  # with it, the model is nearer
    assert free.unit == "m/s2"
    valid("own_model", d.to_json())
    psa.save_model(psa.patched_model(d), tmp_path / "patched.json")
    patched = psa.load_model(tmp_path / "patched.json")
    assert [c.name for c in patched.effects] == ["free_in_rate_v"]
    (run,) = d.experiments
    x0 = np.zeros(len(patched.state_names))
    u = record_inputs(patched, run.record, run.record.n)
    y = psa.run(patched, run.record.time, u, x0, hold="linear").y[:, 0]
    with_it, base = (np.std((x - displayed)[run.held_out]) for displayed in (y, d.base[0][:, 0]))
    assert with_it < 0.8 * base


@pytest.mark.parametrize(
    ("word", "effects"), [("screening", []), ("judging", ["friction_in_speed"])]
)
def test_an_interrupt_keeps_the_best_model_so_far(word: str, effects: list[str]) -> None:
    def stop(text: str) -> None:
        if text.startswith(word):
            raise KeyboardInterrupt

    with pytest.raises(DiagnosisInterrupted) as ended:
        psa.diagnose(motor(), plants.motor(1), starts=1, progress=stop)
    result = ended.value.model
    assert [c.name for c in result.effects] == effects
    assert result.provenance.interrupted
    assert result.values["R"] == pytest.approx(1.2, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("make", [oscillator, tanks, pair])
def test_ports_and_effects_of_gain_0_leave_a_model_as_it_is(make: Callable[[], psa.Model]) -> None:
    model = make()
    runs = experiments_of(model, [_quiet(model)], judged=False)
    table = effects_of(model, sizes_of(model, runs))
    assert len({e.name for e in table}) == len(table)
    opened, every = with_ports(model), extended(model, table)
    t, u = runs[0].record.time, record_inputs(model, runs[0].record, runs[0].record.n)
    x0 = np.array([s.start for s in model.structure.states])
    plain = psa.run(model, t, u, x0, rtol=1e-8)
    others = np.array([s.start for s in every.structure.states])
    assert psa.run(opened, t, u, x0, rtol=1e-8).y == pytest.approx(plain.y, abs=1e-12)
    displayed = psa.run(every, t, u, others, rtol=1e-8).y
    size = np.ptp(plain.y) + np.max(np.abs(plain.y))
    assert np.max(np.abs(displayed - plain.y)) < 1e-4 * size  # steps of other lengths


def _quiet(model: psa.Model) -> Signals:
    t = np.linspace(0.0, 4.0, 200)
    columns = {n: 1.0 + 0.5 * np.sin(2.0 * t + k) for k, n in enumerate(model.input_names)}
    return Signals(
        name="quiet", time=t, columns={**columns, **dict.fromkeys(model.output_names, t)}
    )


def test_the_page_has_the_equation_and_the_parameters_of_every_effect() -> None:
    x, v, u, k = (ca.SX.sym(n) for n in ("x", "v", "u", "k"))
    model = psa.ode_model(
        {"x": [x, v], "u": u, "p": k, "y": x, "ode": [v, u - k * x]},
        name="any", outputs=["y"], values={"k": 1.0},
    )  # fmt: skip
    ones = dict.fromkeys(("x", "v", "u", "y"), 1.0)
    text = f"\n{effects_page.markdown_table(effects_page.of_any_model())}\n"
    items = []
    for effect in effects_of(model, Sizes(ones, ones, sample=1.0, duration=1.0)):
        kind, c = re.split("_of_|_in_", effect.name)[0], effect.component
        if kind not in items:
            items.append(kind)
            fitted = [p for p in c.parameters if p.fitted]
            statement = "; ".join(
                f"`{p.name.removeprefix(f'{c.name}_')}` {p.description}" for p in fitted
            )
            law = re.sub(r"\|(\w+)\|", r"abs(\1)", c.equation_text)
            what = c.description.removeprefix(f"{effect.port.words}: ")
            assert f"\n| `{c.name}` | {what} | `{law}` | {statement} |\n" in text
    assert len(items) == text.count("\n| `") == 15


def test_the_help_of_both_faces_mentions_user_models() -> None:
    for face, word in ((psa.identify, "known_start"), (psa.diagnose, "leave_out")):
        assert f"For your model, {face.__name__}(model: " in str(face.__doc__)
        assert str(face.__doc__).count(word) >= 2  # in the signature and in words


def test_records_that_do_not_fit_are_refused_in_sentences() -> None:
    t = np.linspace(0.0, 1.0, 50)
    quiet = _quiet(oscillator())
    alone = {"position": t}
    with pytest.raises(psa.InputError, match=r"lack the input 'force'.*Name the column so"):
        psa.identify(oscillator(), replace(quiet, columns={"position": quiet.time}))
    for inputs in ({"time": t, **alone}, {"time [s]": t, **alone, "Forces": t}):
        with pytest.raises(
            psa.InputError, match=r"the column 'force' is missing \(present: time, pos"
        ):
            psa.identify(oscillator(), inputs)
    with pytest.raises(psa.InputError, match=r"no output of the model 'oscillator'"):
        psa.diagnose(oscillator(), {"time": t, "force": t})
    with pytest.raises(psa.InputError, match="No output moves"):
        psa.diagnose(oscillator(), {"time": t, "force": t, "position": np.full(50, 0.2)})
    with pytest.raises(psa.InputError, match=r"model comes first.*psa.diagnose\(model, records\)"):
        psa.diagnose({"time": t, "force": t, "position": t}, oscillator())  # type: ignore[call-overload]
    with pytest.raises(psa.InputError, match=r"describes a diagnosis, and this is of type Signals"):
        psa.story(_quiet(oscillator()))  # type: ignore[arg-type]
    with pytest.raises(psa.InputError, match=r"rows are not in the order of time"):
        psa.identify(oscillator(), {"time": t[::-1], "force": t, "position": t})
    with pytest.raises(psa.InputError, match=r"'zero_off', with which no effect's name starts"):
        psa.diagnose(
            oscillator(),
            {"time": t, "force": t, "position": t**2},
            leave_out="zero_off",
            starts=1,
        )


@pytest.mark.slow
def test_effects_of_a_pack_are_named_in_plants_of_other_forms(tmp_path: Path) -> None:
    """The program of the example: each cause hidden once, and one record without any."""
    table = motor_pack.main(tmp_path)
    clean = table.pop("nothing")
    assert clean.verdict == "adequate"
    assert not clean.causes
    for hidden, d in table.items():
        assert [c.effect for c in d.causes] == [hidden]
        assert d.causes[0].confidence > 0.95
        assert d.explained_share is not None
        assert d.explained_share > 0.95
        for error in d.errors:
            assert error.extended < 0.65 * error.base or error.extended < 1.1 * error.noise
    assert table["winding_heat"].verdict == "cause_named"

    pull = table["cogging"].model.values
    first = 0.012 * np.exp(-0.5) * 2.0 * iv(1, 0.5) / 0.5  # of the plant's Fourier series
    assert pull["cogging_torque"] == pytest.approx(first, rel=0.1)
    assert pull["cogging_phase"] == pytest.approx(np.pi - 0.7, abs=0.1)
    ripple = table["commutation_ripple"].model.values
    half = np.pi / 10.0
    assert ripple["k"] == pytest.approx(0.05 * np.sin(half) / half, rel=1e-3)
    assert 0.0202 < ripple["ripple"] < 0.0249  # the first wave, and half of the swing
    assert ripple["ripple_phase"] == pytest.approx(np.pi - 1.0, abs=0.05)
    heat = table["winding_heat"].model.values
    assert heat["heat_time"] == pytest.approx(15.0, rel=0.1)
    assert heat["heating"] * heat["R"] == pytest.approx(0.039 * 1.2, rel=0.2)
