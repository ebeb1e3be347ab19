"""Any CasADi ODE as a model: against scipy, in fmpy, in rumoca, and refused inputs."""

import importlib
import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

import casadi as ca
import numpy as np
import pytest
from fmpy import read_model_description, simulate_fmu
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline, RegularGridInterpolator

import psa_casadi as psa
from psa_casadi.examples.van_der_pol import model as van_der_pol
from psa_casadi.export.common.variable_table import variable_table
from psa_casadi.export.modelica.package import modelica_text
from psa_casadi.model import user_effects as place
from psa_casadi.model.model_file import dumps, loads
from psa_casadi.model.user_effects import declaration_hash, known_effects
from tests.export.modelica_runs import load, simulated

SPAN, MU = 10.0, 3.0


def _oscillation(times: Any) -> Any:
    """Return the position (n,) of the oscillator with mu = MU, by scipy and by hand."""
    result = solve_ivp(
        lambda _, z: [z[1], MU * (1.0 - z[0] ** 2) * z[1] - z[0]],
        (0.0, SPAN), [2.0, 0.0], method="DOP853", rtol=1e-12, atol=1e-12, t_eval=times,
    )  # fmt: skip
    assert result.success
    return result.y[0]


def test_the_oscillator_runs_in_a_modelica_compiler() -> None:
    text = modelica_text(van_der_pol().with_values({"mu": MU}), name="VanDerPol")
    harness = "model Harness VanDerPol.Signal device; end Harness;"
    result = simulated(text + harness, "Harness", SPAN)
    expected = _oscillation(result["time"])
    assert result["device.position"] == pytest.approx(expected, abs=1e-6)
    assert load(text, "VanDerPol.Examples.Free") is not None


def _heated() -> psa.Model:
    """A rod that a current heats, in a room whose temperature swings by the day of 60 s."""
    T, T2 = ca.MX.sym("T"), ca.MX.sym("T2")
    u, p, t = ca.MX.sym("u"), ca.MX.sym("p", 3), ca.MX.sym("t")
    room = p[2] * ca.sin(2 * math.pi * t / 60.0)
    ode = ca.vertcat((p[0] * u**2 - (T - T2)) / p[1], ((T - T2) - (T2 - room)) / p[1])
    return psa.ode_model(
        {"t": t, "x": ca.vertcat(T, T2), "u": u, "p": p, "ode": ode, "y": [T - room, u * T]},
        name="rod",
        states=[psa.State("T", "K", "inner", 10.0, 1.0), psa.State("T2", "K", "outer", 10.0)],
        inputs=[psa.Input("current", "A", "heats the rod", nominal=2.0, display_unit="mA")],
        parameters=[
            psa.Parameter("R", 2.0, "K/A", (0.0, 100.0), "heating"),
            "lag",
            psa.Parameter("swing", 3.0, "K", (0.0, 50.0), "swing of the room"),
        ],
        outputs=["above_room", psa.Output("heat", "A.K", "a product", 20.0)],
        values={"lag": 4.0, "R": 2.5},
    )


def _heated_rates(t: float, z: Any, u: float) -> list[float]:
    room = 3.0 * math.sin(2 * math.pi * t / 60.0)
    return [(2.5 * u**2 - (z[0] - z[1])) / 4.0, ((z[0] - z[1]) - (z[1] - room)) / 4.0]


def test_inputs_outputs_parameters_and_time_against_scipy(tmp_path: Path) -> None:
    model = _heated()
    assert model.values == {"R": 2.5, "lag": 4.0, "swing": 3.0}
    expected = solve_ivp(
        lambda t, z: _heated_rates(t, z, 2.0), (0.0, 30.0), [1.0, 0.0], method="DOP853",
        rtol=1e-12, atol=1e-12, t_eval=np.linspace(0.0, 30.0, 61),
    )  # fmt: skip
    room = 3.0 * np.sin(2 * math.pi * expected.t / 60.0)
    above, product = expected.y[0] - room, 2.0 * expected.y[0]
    run = psa.run(model, expected.t, np.full((61, 1), 2.0), np.array([1.0, 0.0]), rtol=1e-10)
    assert run.y == pytest.approx(np.column_stack([above, product]), abs=1e-7)
    fmu = psa.export_fmu(model, tmp_path / "rod.fmu")
    ends = np.array([(0.0, 2.0), (30.0, 2.0)], dtype=[("time", float), ("current", float)])
    result = simulate_fmu(
        str(fmu), fmi_type="CoSimulation", stop_time=30.0, output_interval=0.5, input=ends,
        relative_tolerance=1e-9, output=["above_room", "heat"],
    )  # fmt: skip
    assert result["above_room"] == pytest.approx(above, abs=1e-6)
    assert result["heat"] == pytest.approx(product, abs=1e-6)
    described = {v.name: v for v in read_model_description(str(fmu)).modelVariables}
    assert (described["current"].unit, described["heat"].unit) == ("A", "A.K")
    assert (described["T"].start, described["lag"].start) == ("1.0", "4.0")


def test_a_function_of_casadi_is_an_ode_too() -> None:
    x, u, k = ca.MX.sym("x", 2), ca.MX.sym("u"), ca.MX.sym("k")
    rates = ca.vertcat(x[1], u - k * x[0])
    function = ca.Function("rates", [x, u, k], [rates], ["x", "u", "p"], ["xdot"])
    model = psa.ode_model(function, name="spring", parameters=["k"], values={"k": 4.0})
    assert model.state_names == ("x_0", "x_1")
    assert model.output_names == ("x_0_out", "x_1_out")
    assert model.input_names == ("u",)
    t = np.linspace(0.0, 2.0, 21)
    steps = psa.run(model, t, np.full((21, 1), 2.0), np.zeros(2), rtol=1e-10)
    assert steps.y[:, 0] == pytest.approx(0.5 * (1.0 - np.cos(2.0 * t)), abs=1e-8)


def test_a_kink_that_is_named_is_met_with_care_and_is_an_event_of_the_fmu() -> None:
    """x' = |sin 3t| for 3 s: a solver that looks for the kinks errs by less than half."""
    x, t = ca.SX.sym("x"), ca.SX.sym("t")
    ode = {"t": t, "x": x, "ode": ca.fabs(ca.sin(3.0 * t))}
    blind, aware = (
        psa.ode_model(inputs, name=name)
        for inputs, name in ((ode, "blind"), ({**ode, "zero": ca.sin(3.0 * t)}, "aware"))
    )
    turns = int(9.0 / math.pi)
    expected = (2.0 * turns + 1.0 - math.cos(9.0 - turns * math.pi)) / 3.0
    rough, fine = (
        abs(psa.run(m, np.array([0.0, 3.0]), np.zeros((2, 0)), np.zeros(1)).y[-1, 0] - expected)
        for m in (blind, aware)
    )
    assert fine < min(0.5 * rough, 1e-4)
    assert [v.name for v in variable_table(aware) if v.kind == "indicator"] == ["switch.kink"]
    assert not [v for v in variable_table(blind) if v.kind == "indicator"]


X, K, U = (ca.SX.sym(n) for n in "xku")


def _bridge(*, whole: bool) -> psa.Model:
    """A condenser at one corner of a bridge of resistors: two algebraic currents, or one formula.

    With the voltage U at the bridge, 1 kOhm to each middle, 2 kOhm below each, and R across.
    """
    v, a, b, r, c = (ca.SX.sym(n) for n in ("v", "a", "b", "R", "across"))
    known = {"x": v, "u": U, "p": r, "y": v}
    values = {"R": 3e3}
    if whole:  # the middle b follows from a = v
        middle = (U / 1e3 + v / r) / (1 / 1e3 + 1 / 2e3 + 1 / r)
        rate = ((U - v) / 1e3 - v / 2e3 - (v - middle) / r) / 1e-6
        return psa.ode_model({**known, "ode": rate}, name="bridge", outputs=["y"], values=values)
    equations = [a - v, (U - b) / 1e3 - b / 2e3 + c]
    rate = ((U - a) / 1e3 - a / 2e3 - c) / 1e-6
    return psa.ode_model(
        {**known, "z": [a, b], "alg": equations, "w": c, "wdef": (a - b) / r, "ode": rate},
        name="bridge", outputs=["y"], values=values, intermediates=["across"],
    )  # fmt: skip


def test_algebraic_equations_are_solved_next_to_intermediates() -> None:
    rng = np.random.default_rng(0)
    for _ in range(5):
        at = 0.0, rng.normal(), rng.normal(), rng.uniform(1e2, 1e4)
        result, expected = (_bridge(whole=q).structure.f(*at)[0] for q in (False, True))
        assert float(result) == pytest.approx(float(expected), rel=1e-12)


def test_a_table_is_the_spline_in_a_file_in_c_and_beyond_its_ends(tmp_path: Path) -> None:
    points, values = [-1.0, 0.0, 0.5, 2.0], [0.3, 1.0, -0.4, 0.6]
    x, gain = ca.SX.sym("x"), ca.SX.sym("gain")
    model = psa.ode_model(
        {"x": x, "p": gain, "ode": 1.0, "y": psa.table(x, points, [gain, *values[1:]])},
        name="looked_up", states=[psa.State("x", "1", "x", 1.0, -2.0)], values={"gain": 0.3},
        outputs=["value"],
    )  # fmt: skip
    spline = CubicSpline(points, values)
    t = np.linspace(0.0, 6.0, 61)
    inside = np.clip(t - 2.0, -1.0, 2.0)
    expected = spline(inside) + (t - 2.0 - inside) * spline(inside, 1)
    psa.save_model(model, tmp_path / "m.json")
    for m in (model, psa.load_model(tmp_path / "m.json")):
        np.testing.assert_allclose(
            psa.run(m, t, np.zeros((61, 0)), np.array([-2.0])).y[:, 0], expected, atol=1e-9
        )
    psa.export_fmu(model, tmp_path / "m.fmu")
    played = simulate_fmu(str(tmp_path / "m.fmu"), stop_time=6.0, output_interval=0.1)
    np.testing.assert_allclose(played["value"], expected, atol=1e-6)


def test_a_table_of_two_variables_and_straight_lines() -> None:
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    p, q = [0.0, 0.2, 0.7, 1.0, 1.5], [0.0, 1.0, 3.0, 4.0]
    values = np.random.default_rng(1).normal(size=(5, 4))
    at = 0.33, 1.7
    methods: tuple[Literal["linear", "cubic"], ...] = ("linear", "cubic")
    for kind in methods:
        f = ca.Function("f", [x, y], [psa.table(x, p, y, q, values, kind=kind)])
        expected = RegularGridInterpolator((np.array(p), np.array(q)), values, method=kind)(at)
        assert float(f(*at)) == pytest.approx(float(expected), rel=1e-12)
    for wrong in (([0, 0], [1, 2]), ([0, 1], [1, 2, 3]), ([0], [1])):
        with pytest.raises(psa.InputError, match="points that rise, and a value for each"):
            psa.table(x, *wrong)
    with pytest.raises(psa.InputError, match="cubic or linear"):
        psa.table(x, p, p, kind="spline")
    with pytest.raises(psa.InputError, match="matrix"):
        psa.table(x, p, y, q, [1.0, 2.0])


def _solved() -> dict[str, Any]:
    u, q = ca.MX.sym("u"), ca.MX.sym("q")
    root = ca.rootfinder("root", "newton", {"x": q, "p": u, "g": q**3 + q - u})
    return {"x": u, "ode": root(x0=0.0, p=u)["x"]}


#: The fault, the inputs, a part of the message.
WRONG: dict[str, tuple[Callable[[], Any], dict[str, Any], str]] = {
    "unknown symbol": (lambda: {"x": X, "ode": K * X}, {}, "'ode' uses the symbol 'k'"),
    "unknown symbol in y": (lambda: {"x": X, "ode": X, "y": K}, {}, "'y' uses the symbol 'k'"),
    "rows": (lambda: {"x": X, "ode": ca.vertcat(X, X)}, {}, "'x' has 1 row and 'ode' 2 rows"),
    "another order": (
        lambda: {"x": ca.vertcat(X, K), "ode": ca.vertcat(K, X)}, {"states": ["k", "x"]},
        "declare them in the order of the symbols",
    ),
    "matrix": (lambda: {"x": X, "ode": X, "y": ca.SX(2, 2) + X}, {}, "'y' is 2 by 2"),
    "both kinds": (lambda: {"x": X, "p": ca.MX.sym("k"), "ode": X}, {}, "mixes SX and MX"),
    "symbol twice": (lambda: {"x": X, "p": X, "ode": X}, {}, "'x' occurs 2 times in x and p"),
    "two symbols of one name": (
        lambda: {"x": X, "p": ca.SX.sym("x"), "ode": X}, {}, "a separate symbol and name"),
    "expression for a symbol": (lambda: {"x": 2 * X, "ode": X}, {}, "must be symbols"),
    "two times": (lambda: {"x": X, "t": ca.SX.sym("t", 2), "ode": X}, {}, "time is one symbol"),
    "not linear": (
        lambda: {"x": X, "z": K, "alg": K**3 - X, "ode": K}, {}, "are not linear in 'z'"),
    "left open": (lambda: {"x": X, "z": K, "alg": X, "ode": K}, {}, "leave 1 of 'z' open"),
    "no equations": (lambda: {"x": X, "z": K, "ode": K}, {}, "lacks 'alg'"),
    "no definition": (lambda: {"x": X, "w": K, "ode": K}, {}, "lacks 'wdef'"),
    "loop": (
        lambda: {"x": X, "w": [K, U], "wdef": [U, K + X], "ode": K}, {}, "balances form a loop"),
    "unknown word": (lambda: {"x": X, "ode": X, "rhs": X}, {}, "'rhs', which is not known"),
    "no states": (lambda: {"ode": X}, {}, "lacks 'x'"),
    "no mapping": (lambda: [X], {}, "give a mapping"),
    "no expression": (lambda: {"x": X, "ode": "k*x"}, {}, "no SX expression"),
    "no formula": (_solved, {}, "no elementary function"),
    "too many names": (lambda: {"x": X, "ode": X}, {"states": ["a", "b"]}, "2 of the states"),
    "no name": (lambda: {"x": X, "ode": X}, {"states": [3]}, "give a State or a name"),
    "no number": (lambda: {"x": X, "p": K, "ode": X}, {}, "'k' has no number"),
    "no such parameter": (
        lambda: {"x": X, "ode": X}, {"values": {"k": 1.0}}, "'k', which is no parameter"),
    "out of bounds": (
        lambda: {"x": X, "p": K, "ode": X},
        {"parameters": [psa.Parameter("k", 2.0, "1", (0.0, 1.0), "k")]}, "outside its bounds"),
    "no decades": (
        lambda: {"x": X, "p": K, "ode": X},
        {"parameters": [psa.Parameter("k", 2.0, "1", (-1.0, 9.0), "k", log=True)]},
        "with log=True"),
    "name clash": (
        lambda: {"x": X, "ode": X, "y": X}, {"outputs": ["x"]}, "Two variables are named 'x'"),
    "not an identifier": (lambda: {"x": X, "ode": X}, {"states": ["x 1"]}, "cannot name a var"),
    "model name": (lambda: {"x": X, "ode": X}, {"name": "1st"}, "'1st' cannot name a model"),
    "unit": (
        lambda: {"x": X, "ode": X}, {"states": [psa.State("x", "furlang", "", 1.0)]},
        "unit 'furlang'"),
    "not finite": (
        lambda: {"x": X, "ode": X}, {"states": [psa.State("x", "m", "", 1.0, math.nan)]},
        "not finite"),
    "foreign size": (
        lambda: {"x": X, "ode": X}, {"states": [psa.State("x", "m", "", lambda v: v["stroke"])]},
        "parameter 'stroke'"),
}  # fmt: skip


@pytest.mark.parametrize("what", WRONG)
def test_a_mistake_is_named_in_a_sentence(what: str) -> None:
    inputs, words, sentence = WRONG[what]
    with pytest.raises(psa.InputError) as caught:
        psa.ode_model(inputs(), **{"name": "model", **words})
    assert sentence in str(caught.value)
    for problem in caught.value.problems:
        assert problem.endswith(".")
        assert len(problem) > 30


RIPPLE = """
import casadi as ca
import psa_casadi as psa


def _equations(s):
    return psa.Equations(
        add={"measured_displacement": s.ripple * ca.sin(2.0 * ca.pi * s.x / s.ripple_period)}
    )


SENSOR_RIPPLE = psa.Component(
    "encoder_ripple",
    "an error that repeats with the grating's period",
    "Heydemann 1981",
    _equations,
    (
        psa.Parameter("ripple", 0.0, "m", (-1e-6, 1e-6), "its amplitude", scale=2e-8),
        psa.Parameter(
            "ripple_period", 4e-6, "m", (1e-7, 1e-4), "its period", log=True, fitted=False
        ),
    ),
    gain="ripple",
    belongs_to="sensor",
    needs=("sensor",),
)
"""


@pytest.fixture
def ripple(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[psa.Component]:
    """The effect of a module in the current folder."""
    (tmp_path / "gratings.py").write_text(RIPPLE)
    monkeypatch.chdir(tmp_path)
    _forget()
    yield psa.load_effects("gratings")["encoder_ripple"]
    _forget()


def _forget() -> None:
    psa.load_effects.cache_clear()
    place.installed_effects.cache_clear()
    sys.modules.pop("gratings", None)
    sys.modules.pop("rulings", None)
    importlib.invalidate_caches()


def extended(ripple: psa.Component) -> psa.Model:
    return psa.stack_model("P-885.51").with_effect(ripple, {"ripple": 5e-8})


def test_a_declaration_that_has_changed_is_refused(ripple: psa.Component, tmp_path: Path) -> None:
    text = dumps(extended(ripple))
    source = tmp_path / "gratings.py"
    source.write_text("# a comment changes nothing\n" + RIPPLE)
    _forget()
    commented = psa.load_effects("gratings")["encoder_ripple"]
    assert declaration_hash(commented) == declaration_hash(ripple)
    source.write_text(RIPPLE.replace("ca.sin", "ca.cos"))
    _forget()
    other = psa.load_effects("gratings")["encoder_ripple"]
    with pytest.raises(psa.InputError, match="declared in another way"):
        loads(text, effects=[other])


def install(site: Path, text: str) -> None:
    """Lay a package down as pip does, with the entry point that announces its effects."""
    (site / "gratings-1.dist-info").mkdir(parents=True)
    (site / "gratings.py").write_text(text)
    (site / "gratings-1.dist-info" / "METADATA").write_text("Name: gratings\nVersion: 1\n")
    (site / "gratings-1.dist-info" / "entry_points.txt").write_text(
        f"[{place.GROUP}]\ngratings = gratings\n"
    )


@pytest.fixture
def neighbours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A current folder with files of the names of what is imported; each leaves a file if run."""
    here = tmp_path / "here"
    here.mkdir()
    text = "from pathlib import Path; Path(__file__).with_suffix('.ran').touch()\n"
    install(tmp_path / "site", "import rulings\n" + RIPPLE)
    (tmp_path / "site" / "rulings.py").touch()
    install(here, text + RIPPLE)
    (here / "rulings.py").write_text(text)
    monkeypatch.chdir(here)
    monkeypatch.syspath_prepend(tmp_path / "site")
    _forget()
    yield here
    _forget()


@pytest.mark.parametrize("first", ["", "here", None])
def test_installed_packages_announce_theirs_and_no_neighbour_replaces_one(
    first: str | None, neighbours: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if first is not None:  # as `python -m`, `python` and notebooks have it
        monkeypatch.syspath_prepend(str(neighbours) if first else "")
    before = list(sys.path)
    assert "encoder_ripple" in known_effects()
    assert len(known_effects()) == len(psa.EFFECTS) + 1
    assert psa.load_effects("gratings").keys() == {"encoder_ripple"}
    assert not list(neighbours.glob("*.ran"))
    assert sys.path == before


def test_a_neighbour_replaces_nothing_that_is_missing(
    neighbours: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "site" / "gratings.py").unlink()
    monkeypatch.syspath_prepend("")
    with pytest.raises(psa.InputError, match=r"No module named 'gratings'"):
        known_effects()
    assert not list(neighbours.glob("*.ran"))
    assert "encoder_ripple" in psa.load_effects("gratings")  # by its name
    assert (neighbours / "gratings.ran").is_file()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("import nothing_of_that_name", "cannot be imported"),
        ("X = 1", "holds no effect"),
        (RIPPLE.replace('"encoder_ripple"', '"slow_creep"'), "named 'slow_creep' too"),
        (RIPPLE.replace("s.x /", "s.no_such_symbol /"), "no_such_symbol"),
    ],
)
def test_a_module_that_does_not_fit_is_refused_in_a_sentence(
    text: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "gratings.py").write_text(text)
    monkeypatch.chdir(tmp_path)
    _forget()
    with pytest.raises(psa.InputError, match=message):
        psa.load_effects("gratings")
    _forget()


def test_names_that_stacks_have_are_free(tmp_path: Path) -> None:
    """A state, an input, a parameter and an output bear the names of a stack's sums."""
    force, v, pull, k = (ca.SX.sym(n) for n in ("free_force", "v", "displacement", "tip_force"))
    model = psa.ode_model(
        {"x": [force, v], "u": pull, "p": k, "y": v, "ode": [v, pull - k * force - v]},
        name="any", outputs=["velocity"], values={"tip_force": 4.0},
    )  # fmt: skip
    t = 0.02 * np.arange(201.0)
    u = np.sin(2.0 * t)
    velocity = psa.run(model, t, u[:, None], np.zeros(2), rtol=1e-9, hold="zero").y[:, 0]
    path = tmp_path / "any.fmu"
    psa.export_fmu(model, path)
    played = simulate_fmu(
        str(path), stop_time=4.0, output_interval=0.02, relative_tolerance=1e-8,
        input=np.array(
            list(zip(t, u, strict=True)), dtype=[("time", float), ("displacement", float)]
        ),
    )  # fmt: skip
    again = np.interp(t, played["time"], played["velocity"])
    assert np.max(np.abs(again - velocity)) < 1e-5 * np.ptp(velocity)
