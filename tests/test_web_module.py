"""A model as WebAssembly runs as it does here: every effect in one module, by the same methods."""

import re

import numpy as np
import pytest

from psa_casadi.component import Component
from psa_casadi.effects import EFFECTS
from psa_casadi.errors import InputError
from psa_casadi.export.web import web_module
from psa_casadi.model.compose import Model
from psa_casadi.model.stacks import stack_model
from psa_casadi.report.page.live import live_data
from psa_casadi.simulation.simulate import input_samples, simulate
from psa_casadi.simulation.start import initial_slope, start_on
from psa_casadi.simulation.ways import accurate
from psa_casadi.units import FloatArray
from tests.browser import Browser, find_browser
from tests.live_pages import case, run_in_browser
from tests.sampled_models import controller
from tests.tiers import slow

pytestmark = pytest.mark.xdist_group("browser")

#: Of the range; what the mathematical functions of two machines differ by, many times over.
SAME = 1e-9


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Browser:
    return find_browser(tmp_path_factory.mktemp("browser"))


def loops(samples: int = 400, period: float = 0.02) -> tuple[FloatArray, FloatArray]:
    """Return loops of two sizes that begin in motion, and a step."""
    t = np.linspace(0.0, 2.0 * period, samples)
    v = 60.0 - 50.0 * np.cos(2.0 * np.pi * t / period + 0.5) * np.where(t < period, 1.0, 0.4)
    v[t > 1.8 * period] += 15.0
    return t, v


def off(found: FloatArray, wanted: FloatArray) -> float:
    """Return the largest difference over the range."""
    return float(np.max(np.abs(found - wanted)) / np.ptp(wanted))


def inputs(model: Model, v: FloatArray) -> FloatArray:
    """Return the samples of all inputs, those beside the voltage constant."""
    return input_samples(model, len(v), {"voltage": v})


def started(model: Model, t: FloatArray, v: FloatArray) -> FloatArray:
    return start_on(model, t, inputs(model, v)).x


def rest_in_numpy(model: Model, t: FloatArray, v: FloatArray) -> FloatArray:
    """Return the state that the first voltage and its rate imply, by NumPy's linear algebra."""
    s, u, p = model.structure, inputs(model, v)[0], model.parameter_vector()
    rate = np.array([initial_slope(t, v), *np.zeros(len(u) - 1)])
    memory = [i for i, q in enumerate(s.states) if q.memory]
    fast = [i for i, q in enumerate(s.states) if not q.memory]
    settling = [i for i, q in enumerate(s.states) if not q.memory or q.settles]

    def slopes(x: FloatArray) -> FloatArray:
        return np.array(s.f(t[0], x, u, p)[0]).ravel()

    def blocks(x: FloatArray) -> list[FloatArray]:
        return [np.array(block) for block in s.slopes(t[0], x, u, p)]

    still = started(model, t, v)
    for _ in range(30):
        for rows in (settling, fast):
            jacobian = blocks(still)[0][np.ix_(rows, rows)]
            still[rows] -= np.linalg.solve(jacobian, slopes(still)[rows])
    x = still.copy()
    a, b = blocks(still)[:2]
    for _ in range(2):
        drive = b[fast] @ rate + a[np.ix_(fast, memory)] @ slopes(x)[memory]
        steady = -np.linalg.solve(a[np.ix_(fast, fast)], drive)
        x = still.copy()
        x[fast] += np.linalg.solve(a[np.ix_(fast, fast)], steady)
    return x


def ordinary_size(model: Model, effect: Component) -> float:
    """Return the gain that a page switches an effect on with."""
    (told,) = (e for e in live_data(model, b"")["effects"] if e["name"] == effect.name)
    return float(told["on"])


def everything() -> Model:
    model = stack_model("P-885.51")
    for effect in EFFECTS.values():
        model = model.with_effect(effect)
    return model


@slow
def test_every_effect_runs_in_one_module_as_it_does_here(browser: Browser) -> None:
    model, (t, v) = everything(), loops()
    rows: dict[str, Model] = {"none": model}
    for effect in EFFECTS.values():
        rows[effect.name] = model.with_values({effect.gain or "": ordinary_size(model, effect)})
    starts = {name: started(m, t, v) for name, m in rows.items()}
    told = run_in_browser(
        browser, model, [case(m, t, v, start=starts[name].tolist()) for name, m in rows.items()]
    )
    changed = []
    for (name, m), row in zip(rows.items(), told, strict=True):
        here, way = accurate(m, t, inputs(m, v), starts[name], rtol=1e-6, hold="linear")
        wanted = here.y[:, m.output_names.index("measured_displacement")]
        assert row["way"] == way, name
        assert off(row["shown"], wanted) < SAME, name
        changed.append(off(row["shown"], told[0]["shown"]))
    assert sum(c > 1e-5 for c in changed) >= 18  # the others need another voltage to show


@slow
def test_a_record_starts_where_it_does_here_and_gains_of_0_leave_the_base(browser: Browser) -> None:
    base, (t, v) = stack_model("P-885.51"), loops(40)
    model = everything()
    rows = {e.name: base.with_effect(e) for e in EFFECTS.values()}
    rows = {n: m.with_values({EFFECTS[n].gain or "": ordinary_size(m, EFFECTS[n])})
            for n, m in rows.items()}  # fmt: skip
    gains = {e.gain or "": ordinary_size(model, e) for e in EFFECTS.values()}
    rows["every effect"] = model.with_values(gains)
    cases = [case(model.with_values(m.values), t, v, quick=True) for m in (base, *rows.values())]
    told = run_in_browser(browser, model, cases)
    wanted = [simulate(base, t, v).displacement]
    for (name, m), row in zip(rows.items(), told[1:], strict=True):
        x0 = rest_in_numpy(m, t, v)
        at = m.structure.f(t[0], x0, inputs(m, v)[0], m.parameter_vector())[1]
        first = float(at[m.output_names.index("measured_displacement")])
        assert abs(row["shown"][0] - first) < SAME * np.ptp(wanted[0]), name
        own = m.structure.f(t[0], started(m, t, v), inputs(m, v)[0], m.parameter_vector())[1]
        here = float(own[m.output_names.index("measured_displacement")])
        assert abs(here - first) < SAME * np.ptp(wanted[0]), name
    assert off(told[0]["shown"], wanted[0]) < 1e-5  # one run of exact steps


@slow
def test_tight_tolerances_and_a_memory_agree(browser: Browser) -> None:
    model = stack_model("P-885.51").with_effect(EFFECTS["hysteresis_memory"], {"memory_gain": 0.05})
    t, v = loops(150)
    memory = {"f_H": 20.0}
    told = run_in_browser(
        browser,
        model,
        [
            case(model, t, v, rtol=1e-8),
            case(model, t, v, deviation=memory),
            case(model, t, v, rtol=1e-5, hold="zero"),
            case(model.with_values({"k_L": 9.0, "tau": 3e-4}), t, v, rtol=1e-8),
        ],
    )
    wanted = [
        simulate(model, t, v, rtol=1e-8),
        simulate(model, t, v, memory=memory),
        simulate(model, t, v, rtol=1e-5, hold="zero"),
        simulate(model.with_values({"k_L": 9.0, "tau": 3e-4}), t, v, rtol=1e-8),
    ]
    for row, here in zip(told, wanted, strict=True):
        assert row["way"] == here.way
        assert off(row["shown"], here.displacement) < SAME
    assert [row["way"] for row in told] == ["stepper", "exact steps", "exact steps", "stepper"]
    assert off(told[1]["shown"], told[0]["shown"]) > 1e-3  # the memory shows
    # exact steps err by less than they are asked for
    assert off(simulate(model, t, v).displacement, told[0]["shown"]) < 1e-6


def test_a_model_that_no_page_runs_is_refused() -> None:
    with pytest.raises(InputError, match="sampled states"):
        web_module(controller())


@slow
def test_a_module_asks_for_nothing_but_mathematical_functions() -> None:
    module = web_module(stack_model("P-885.51"))
    assert module[:4] == b"\0asm"
    assert len(module) < 90_000
    asked = set(re.findall(rb"Math[\x01-\x08]([a-z0-9]+)\x00", module))
    assert asked == {b"pow"}
    assert b"wasi" not in module
