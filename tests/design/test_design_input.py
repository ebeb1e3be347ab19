"""Designed inputs against the independent reference, the limits, the FMU, and a linear bound."""

import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import fmpy
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import least_squares, linprog

import psa_casadi as psa
from psa_casadi import reference
from psa_casadi.common.units import FloatArray
from psa_casadi.design.tracking.inversion import correct, invert
from psa_casadi.design.tracking.minimum_time import INTERVALS, QuickMove, quickest_move
from psa_casadi.design.tracking.targets import (
    AmplifierLimits,
    Target,
    binding,
    dynamics_of,
    error_of,
    read_target,
    uncompensated,
)
from psa_casadi.design.tracking.tracking import (
    NoSolutionError,
    Program,
    TrackedInput,
    interval_of,
    track,
)
from psa_casadi.examples.tracking_on_the_fmu import fmu_equations
from psa_casadi.records.read.columns import parse_columns
from psa_casadi.simulation.start import linear_part
from tests.contract.helpers import done, refused
from tests.export.fmu_models import exported
from tests.tiers import slow

_RATIOS = (1.0, 10.0, 100.0)


def creeping_displacement(
    values: Mapping[str, float], time: FloatArray, voltage: FloatArray, *, rtol: float = 1e-7
) -> FloatArray:
    """Return the displacement (n,) [m] of a voltage (n,) [V] that starts at 0 from rest."""
    result = reference.simulate(
        values, reference.from_samples(time, voltage), time,
        breakpoints=[float(t) for t in time[1:-1]], rtol=rtol,
    )  # fmt: skip
    return crept(values, time, result.displacement)


def crept(values: Mapping[str, float], time: FloatArray, x: FloatArray) -> FloatArray:
    """Return the displacement (n,) [m] with creep behind an x (n,) [m] that began at rest."""
    gain, first = values.get("creep_gain", 0.0), values.get("creep_time", 1.0)
    return np.asarray(x + gain * sum(_relaxed(time, x, first * r) for r in _RATIOS))


def _relaxed(time: FloatArray, x: FloatArray, constant: float) -> FloatArray:
    """Solve constant z' = x - z for an x that is linear between samples, from z = x."""
    z, decays = np.empty_like(x), np.exp(-np.diff(time) / constant)
    z[0] = x[0]
    for k, (h, decay) in enumerate(zip(np.diff(time), decays, strict=True)):
        slope = (x[k + 1] - x[k]) / h
        z[k + 1] = x[k + 1] - slope * constant + decay * (z[k] - x[k] + slope * constant)
    return z


def bang_bang_bound(
    p: Mapping[str, float], begin: float, end: float, low: float, high: float, n: int = 300
) -> float:
    """Return the least time [s] of the linear part from `begin` to `end` [m], `low` to `high` [V].

    The voltage is held over n intervals, so the bound is that from above, by less than two of them.
    """
    a, b = _chain(p)
    level = -np.linalg.solve(a, b)
    size = level * (high - low)
    size[3] = size[2] * np.sqrt(p["k_P"] / p["m_P"])
    size[5] = size[4] * np.sqrt(p["k_B"] / p["m_B"])
    a, b, level = a * size / size[:, None], b / size, level / size
    gain = p["k_L"] * p["G"] * (1.0 / p["k_P"] + 1.0 / p["k_B"])
    first: FloatArray = np.asarray(level * begin / gain, dtype=float)
    last: FloatArray = np.asarray(level * end / gain, dtype=float)
    short, long = 0.0, 100.0 * float(np.max(1.0 / np.abs(np.linalg.eigvals(a))))
    while long - short > 1e-3 * long:
        middle = 0.5 * (short + long)
        if _possible(a, b, (first, last), (low, high), middle / n, n):
            long = middle
        else:
            short = middle
    return long


def _chain(p: Mapping[str, float]) -> tuple[FloatArray, FloatArray]:
    """Return x' = a x + b v of u, f, y, y', x, x'."""
    drive, a = p["R_s"] * p["C_p"], np.zeros((6, 6))
    a[0, 0] = -1.0 / drive
    a[1, :2] = p["k_L"] / p["tau"], -1.0 / p["tau"]
    a[2, 3] = a[4, 5] = 1.0
    a[3, 1:4] = np.array([1.0, -p["k_P"], -p["c_P"]]) / p["m_P"]
    a[5, 2:] = np.array([p["k_P"] + p["k_B"], p["c_P"] + p["c_B"], -p["k_B"], -p["c_B"]]) / p["m_B"]
    return a, np.r_[p["G"] / drive, np.zeros(5)]


def _possible(
    a: FloatArray, b: FloatArray, ends: tuple[FloatArray, FloatArray],
    limits: tuple[float, float], h: float, n: int,
) -> bool:  # fmt: skip
    """Say whether some voltage takes the chain from one end to the other in n intervals h."""
    k = len(b)
    block = np.zeros((k + 1, k + 1))
    block[:k, :k], block[:k, k] = a * h, b * h
    power = expm(block)
    step, weights = power[:k, :k], [power[:k, k]]
    for _ in range(n - 1):
        weights.append(step @ weights[-1])
    left = ends[1] - np.linalg.matrix_power(step, n) @ ends[0]
    rows = np.hstack([np.array(weights[::-1]).T, np.eye(k), -np.eye(k)])
    bounds = [limits] * n + [(0.0, None)] * (2 * k)
    answer: Any = linprog(np.r_[np.zeros(n), np.ones(2 * k)], A_eq=rows, b_eq=left, bounds=bounds)
    return bool(answer.status == 0 and answer.fun < 1e-7)


ARCS = 6
#: Samples of a trajectory, along which creep is summed; lengths of the last arcs at the start of
#: the search over the whole move; evaluations; residual, over the move, that is a solution.
_SAMPLES, _TAIL, _EVALUATIONS, _SOLVED = 200, (0.02, 0.002), 200, 1e-6


def bang_bang_move(model: psa.Model, movement: QuickMove) -> float | None:
    """Return the length [s] of the stack's bang-bang move that a design leads to.

    Between the limits, from the rest in which the design starts, of which x has crept; the search
    starts from the arcs of the design's voltage. None if it does not settle.
    """
    first = dict(zip(model.state_names, movement.response.states[0].tolist(), strict=True))
    initial = {n: first[n] for n in ("u", "f_H", "f_out", "y", "v_y", "x", "v_x")}
    limits = (movement.limits.min_voltage, movement.limits.max_voltage)
    played, length = movement.response.voltage[2 : 2 + INTERVALS], movement.move_time
    span, upward = limits[1] - limits[0], movement.end > movement.begin
    shares = _arcs(played, limits)

    def miss(q: FloatArray) -> FloatArray:
        """Return the distances from rest at the end (8,), in percent of the move."""
        p, move, held = model.values, abs(movement.end - movement.begin), float(q[-1]) * span
        ends = np.cumsum(np.maximum(q[:-1] * length, 1e-12))
        time = np.unique(np.concatenate([[0.0], ends, np.linspace(0.0, ends[-1], _SAMPLES)]))

        def voltage(t: float) -> float:
            arc = min(int(np.searchsorted(ends, t, side="right")), ARCS - 1)
            return limits[int((arc % 2 == 0) == upward)]

        run = reference.simulate(
            p, voltage, time, initial=initial, breakpoints=ends[:-1].tolist(), rtol=1e-9
        )
        s = {n: float(v[-1]) for n, v in run.states.items()}
        displayed = float(crept(p, time, run.displacement)[-1])
        force, c = p["k_L"] * p["G"] * held + s["f_H"], 1.0 / p["k_P"] + 1.0 / p["k_B"]
        w_p, w_b = np.sqrt(p["k_P"] / p["m_P"]), np.sqrt(p["k_B"] / p["m_B"])
        far = [(s["f_out"] - force) * c, s["y"] - force / p["k_P"], s["x"] - force * c,
               displayed - movement.end, s["v_y"] / w_p, s["v_x"] / w_b]  # fmt: skip
        return 100.0 * np.array([(s["u"] - p["G"] * held) / span, *(d / move for d in far)])

    solved = least_squares(
        miss, np.append(shares, played[-1] / span),
        bounds=(np.append(np.zeros(ARCS), limits[0] / span),
                np.append(np.full(ARCS, np.inf), limits[1] / span)),
        x_scale=np.append(np.maximum(shares, 0.01), 0.5), diff_step=[1e-5],
        xtol=1e-12, ftol=1e-12, max_nfev=_EVALUATIONS,
    )  # fmt: skip
    settled = float(np.max(np.abs(solved.fun))) < 100.0 * _SOLVED
    return float(np.sum(solved.x[:-1]) * length) if settled else None


def _arcs(voltage: FloatArray, limits: tuple[float, float]) -> FloatArray:
    """Return the shares of the first four arcs of a designed voltage, and two short ones."""
    high = voltage > 0.5 * sum(limits)
    switches = np.flatnonzero(np.diff(high.astype(int))) + 1
    edges = np.concatenate([[0], switches, [high.size]]) / high.size
    observed = np.diff(edges)[: ARCS - len(_TAIL)]
    rest = np.full(ARCS - len(_TAIL) - len(observed), _TAIL[0])
    return np.concatenate([observed, rest, _TAIL])


#: The stack carries a payload [kg], so that it rings at 1.6 kHz, and a loop 10 % of the stroke.
PAYLOAD, LOOP = 0.5, 0.8
STROKE = 10e-6
#: Samples of one line of the scan; size of the parameters' errors; parameters that are conventions.
LINE, WRONG = 250, 0.05
_CONVENTIONS = ("hold_rate", "u_rated")
LIMITS = AmplifierLimits(min_voltage=-20.0, max_voltage=120.0)


def scanner(payload: float = PAYLOAD) -> psa.Model:
    """Return the P-885.51 with a payload, creep, and a hysteresis loop 10 % of the stroke wide."""
    creep = {"creep_gain": 0.02, "creep_time": 0.01}
    model = psa.stack_model("P-885.51").with_effect(psa.EFFECTS["slow_creep"], creep).plant()
    loop = {name: LOOP * model.values[name] for name in ("A", "beta", "gamma")}
    return model.with_values({**loop, **({"m_B": payload} if payload else {})})


def scan(model: psa.Model, samples: int) -> Target:
    """Return a raster scan at a twentieth of the first resonance, 250 samples a line."""
    poles = np.linalg.eigvals(linear_part(model).a)
    ringing = np.abs(poles[np.abs(poles.imag) > 1e-6 * np.abs(poles)])
    frequency = float(np.min(ringing)) / (2.0 * np.pi) / 20.0
    lines = max(1, samples // LINE)
    time = np.linspace(0.0, lines / frequency, samples)
    return Target(time, STROKE * rounded_triangle(time * frequency, 0.2))


def rounded_triangle(phase: FloatArray, turn: float) -> FloatArray:
    """Return a triangle of period 1 from 0 to 1 and back whose turns take the share `turn`.

    Over that share of each half period the acceleration is a half sine; it starts at rest.
    """
    s = 1.0 - np.abs(1.0 - 2.0 * np.mod(phase, 1.0))  # way along the half period, 0 to 1
    half = 0.5 * turn
    near = np.minimum(s, 1.0 - s)  # way from the nearer turn
    # speed sin(pi near / turn) in the turn, 1 outside; distance is its integral
    inside = turn / np.pi * (1.0 - np.cos(np.pi * np.minimum(near, half) / turn))
    way = inside + np.maximum(near - half, 0.0)
    full = 2.0 * (turn / np.pi + 0.5 - half)
    return np.asarray(np.where(s <= 0.5, way, full - way) / full)


def wrong_values(model: psa.Model, generator: np.random.Generator) -> dict[str, float]:
    """Return the values with every parameter off by 5 %, up or down at random."""
    changed = {
        name: value * (1.0 + WRONG * generator.choice([-1.0, 1.0]))
        for name, value in model.values.items()
        if name not in _CONVENTIONS
    }
    return {**model.values, **changed}


@cache
def a_scan() -> Target:
    return scan(scanner(), 250)


@cache
def a_design() -> TrackedInput:
    return track(scanner(), a_scan())


def on_reference(voltage: np.ndarray) -> float:
    values = creeping_displacement(scanner().values, a_scan().time, voltage)
    return error_of(a_scan(), values).rms_percent


def test_a_designed_scan_follows_its_path_on_the_independent_reference() -> None:
    plain = on_reference(uncompensated(scanner(), a_scan()).voltage)
    assert 5.0 < plain < 20.0
    assert on_reference(a_design().voltage) < 0.1
    assert on_reference(invert(scanner(), a_scan()).response.voltage) < 0.02 * plain


def test_the_simulator_agrees_with_the_reference() -> None:
    values = creeping_displacement(scanner().values, a_scan().time, a_design().voltage)
    assert values == pytest.approx(a_design().response.displacement, abs=1e-4 * a_scan().span)


def test_trials_make_up_for_parameters_that_are_off() -> None:
    values = wrong_values(scanner(), np.random.default_rng(3))
    voltage, errors = a_design().voltage, []
    for _ in range(3):
        displayed = creeping_displacement(values, a_scan().time, voltage)
        errors.append(error_of(a_scan(), displayed).rms_percent)
        voltage = correct(scanner(), a_scan(), voltage, displayed)
    assert errors[2] < 1.0
    assert errors[2] < 0.5 * errors[0]


@pytest.mark.parametrize(
    "limits",
    [
        AmplifierLimits(max_rate=11e3),
        pytest.param(AmplifierLimits(max_current=0.016), marks=slow),
    ],
)
def test_limits_are_kept_and_cost_accuracy(limits: AmplifierLimits) -> None:
    result = track(scanner(), a_scan(), limits, corrections=0)
    rate = np.abs(np.diff(result.voltage) / np.diff(a_scan().time))
    assert rate.max() <= limits.max_rate * (1.0 + 1e-6)
    assert np.abs(result.response.current).max() <= limits.max_current * (1.0 + 1e-3)
    assert result.error.rms > 10.0 * a_design().error.rms


@slow
def test_minimax_lowers_the_largest_error() -> None:
    result = track(scanner(), a_scan(), minimax=True, corrections=1)
    assert result.error.largest < 0.98 * a_design().error.largest


@pytest.mark.parametrize("payload", [0.5, 0.0])
def test_a_quickest_move_is_near_the_bound_of_the_linear_part(payload: float) -> None:
    model = scanner(payload)
    quick_move = quickest_move(model, 2e-6, 10e-6, LIMITS)
    bound = bang_bang_bound(model.values, 2e-6, 10e-6, -20.0, 120.0)
    assert bound < quick_move.move_time < 1.1 * bound
    assert quick_move.residual < 1e-3
    assert abs(quick_move.offset) < 1e-3
    voltage = quick_move.response.voltage
    assert voltage.min() >= -20.0 - 1e-6
    assert voltage.max() <= 120.0 + 1e-6


@slow
def test_a_quickest_move_is_near_what_hysteresis_and_creep_allow() -> None:
    """Downwards that is 21 % over the bound of the linear part; a bang-bang move has no ramps."""
    begin, end = 10e-6, 2e-6
    model = scanner(0.0)
    quick_move = quickest_move(model, begin, end, LIMITS)
    value = bang_bang_move(model, quick_move)
    assert value is not None
    assert bang_bang_bound(model.values, begin, end, -20.0, 120.0) < value
    assert value < quick_move.move_time < 1.02 * value


def test_a_move_obeys_rate_and_current() -> None:
    limits = AmplifierLimits(-20.0, 120.0, max_rate=8e5, max_current=0.9)
    quick_move = quickest_move(scanner(), 2e-6, 10e-6, limits, intervals=60)
    rate = np.diff(quick_move.response.voltage) / np.diff(quick_move.response.time)
    assert np.abs(rate).max() <= 8e5 * (1.0 + 1e-6)
    assert np.abs(quick_move.response.current).max() <= 0.9 * (1.0 + 1e-3)
    assert quick_move.residual < 1e-3


def test_a_path_may_have_other_columns(tmp_path: Path) -> None:
    path = tmp_path / "path.csv"
    path.write_text("t,x\n" + "".join(f"{k},{2 * k}\n" for k in range(20)), encoding="utf-8")
    of_path = "path.csv@time=t:ms,path.csv@displacement=x:nm"
    target = read_target(path, parse_columns(f"{of_path},time=s:s,voltage=v:V"))
    assert target.displacement[-1] == pytest.approx(38e-9)
    assert target.time[-1] == pytest.approx(0.019)
    target = read_target(path, parse_columns("displacement=x:nm"), sample_time=0.5)
    assert target.step == pytest.approx(0.5)


def test_mistakes_are_reported_together(tmp_path: Path) -> None:
    bad = tmp_path / "path.csv"
    bad.write_text("time [s],displacement [um]\n0,0\n1,x\n", encoding="utf-8")
    with pytest.raises(psa.InputError, match="'x'"):
        read_target(bad)
    rows = "".join(f"{k},{k}\n" for k in range(20))
    bad.write_text(f"time [s],displacement [counts]\n{rows}", encoding="utf-8")
    with pytest.raises(psa.InputError, match="line 1: the displacement is in counts of a sensor"):
        read_target(bad)
    with pytest.raises(psa.InputError, match="not below"):
        AmplifierLimits(5.0, 1.0)
    with pytest.raises(psa.InputError, match="both limits"):
        quickest_move(scanner(), 0.0, 1e-6, AmplifierLimits())
    with pytest.raises(psa.InputError, match="rests at"):
        quickest_move(scanner(), 0.0, 50e-6, LIMITS)


def test_the_command_writes_voltage_and_page(tmp_path: Path) -> None:
    psa.save_model(scanner(), tmp_path / "m.json")
    path, out = a_scan(), tmp_path / "v.csv"
    um = 1e6 * path.displacement
    psa.write_record(tmp_path / "p.csv", {"time [s]": path.time, "displacement [um]": um})
    arguments = ["design", "input", "--model", str(tmp_path / "m.json"), "-o", str(out)]
    more = ["--target", str(tmp_path / "p.csv"), "--report", str(tmp_path / "r.html"), "--still"]
    ended = done(*arguments, *more)
    rows = [line for line in ended.out.splitlines() if line.startswith("designed")]
    simulated, fmu = (float(row.split()[-2]) for row in rows[:2])
    assert fmu == pytest.approx(simulated, rel=0.02)
    record = psa.read_record(out)
    assert on_reference(record.voltage) < 0.1
    assert "Limits and margins" in (tmp_path / "r.html").read_text(encoding="utf-8")
    refused(*arguments, "--fast", "--minimax")
    cut = done(*arguments, *more, "--fast", "--max-voltage", "50", "--no-check-fmu").words
    assert "The highest voltage, 50 V, is reached from" in cut
    assert "Inverted input" in (tmp_path / "r.html").read_text(encoding="utf-8")


def test_a_path_beyond_the_voltage_is_followed_to_the_limit_and_that_is_reported() -> None:
    """A peak that is cut by 10 %: the remaining error is where the limit is."""
    need = float(invert(scanner(), a_scan()).response.voltage.max())
    limits = AmplifierLimits(max_voltage=0.9 * need)
    result = invert(scanner(), a_scan(), limits).response
    assert result.voltage.max() <= limits.max_voltage + 1e-9
    (statement,) = binding(result, limits)
    assert f"highest voltage, {limits.max_voltage:.4g} V" in statement
    spans = re.findall(r"from (\S+) to (\S+) ms", statement)
    first, last = float(spans[0][0]), float(spans[-1][1])
    time = 1e3 * a_scan().time
    peak = time[np.argmax(a_scan().displacement)]
    assert first < peak < last
    values = creeping_displacement(scanner().values, a_scan().time, result.voltage)
    error = np.abs(values - a_scan().displacement) / a_scan().span
    assert error.max() == pytest.approx(0.11, abs=0.03)
    assert np.median(error[time < first]) < 0.003


def test_a_search_that_fails_leaves_the_cut_inversion(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> None:
        raise NoSolutionError("out of iterations")

    monkeypatch.setattr(Program, "solve", fails)
    limits = AmplifierLimits(max_voltage=50.0)
    result = track(scanner(), a_scan(), limits)
    assert not result.by_program
    assert result.voltage.max() <= 50.0
    assert result.error.rms == pytest.approx(invert(scanner(), a_scan(), limits).error.rms)


def test_a_measured_trial_corrects_the_voltage(tmp_path: Path) -> None:
    """On a plant with every parameter off by 5 %: the second trial is nearer than the first."""
    values = wrong_values(scanner(), np.random.default_rng(3))
    path, folder = a_scan(), tmp_path
    played = invert(scanner(), path).response.voltage
    displayed = creeping_displacement(values, path.time, played)
    psa.save_model(scanner(), folder / "m.json")
    um = {"displacement [um]": 1e6 * path.displacement}
    psa.write_record(folder / "p.csv", {"time [s]": path.time, **um})
    measured = {"voltage [V]": played, "displacement [um]": 1e6 * displayed}
    psa.write_record(folder / "t.csv", {"time [s]": path.time, **measured})
    words = ["design", "input", "--model", str(folder / "m.json"), "-o", str(folder / "c.csv")]
    words += ["--target", str(folder / "p.csv"), "--measured", str(folder / "t.csv")]
    done(*words, "--report", folder / "c.html", "--still")
    again = creeping_displacement(values, path.time, psa.read_record(folder / "c.csv").voltage)
    assert error_of(path, again).rms < 0.5 * error_of(path, displayed).rms
    assert "played in the trial" in (folder / "c.html").read_text(encoding="utf-8")
    psa.write_record(folder / "t.csv", {"time [s]": 0.1 * path.time, **measured})
    assert "record the whole path" in refused(*words)


@slow
def test_the_equations_of_an_fmu_have_the_derivatives_of_the_model(tmp_path: Path) -> None:
    """Those of the residual of one interval by its states."""
    model = psa.stack_model("P-885.51").plant()
    unpacked = str(fmpy.extract(str(exported("P-885.51")), str(tmp_path / "unpacked")))
    x, inner = ca.MX.sym("x", 7), ca.MX.sym("inner", 14)
    slopes = []
    for dynamics, symbolic in ((fmu_equations(unpacked, model), False), (dynamics_of(model), True)):
        step = interval_of(dynamics, symbolic=symbolic).step
        items = [x, inner, ca.MX(ca.DM([0.0, 10.0])), ca.MX(ca.DM([0.0, 1e-5]))]
        residual = step.call(items, not symbolic, False)[0]
        f = ca.Function("slopes", [x, inner], [ca.jacobian(residual, inner)])
        slopes.append(np.array(f(np.full(7, 0.1), np.linspace(0.1, 0.3, 14))))
    assert slopes[0] == pytest.approx(slopes[1], abs=1e-5 * np.abs(slopes[1]).max())
