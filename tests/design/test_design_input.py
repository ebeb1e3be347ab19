"""Designed inputs against the independent reference, the limits, the FMU, and a linear bound."""

import re
from functools import cache
from pathlib import Path

import casadi as ca
import fmpy
import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.design.tracking.inversion import correct, invert
from psa_casadi.design.tracking.minimum_time import quickest_move
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
from tests.contract.helpers import done, refused
from tests.design.scanned_stack import (
    LIMITS,
    bang_bang_bound,
    bang_bang_move,
    creeping_displacement,
    scan,
    scanner,
    wrong_values,
)
from tests.export.fmu_models import exported
from tests.tiers import slow


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


def test_the_simulator_says_what_the_reference_says() -> None:
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


def test_mistakes_are_told_together(tmp_path: Path) -> None:
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


def test_a_path_beyond_the_voltage_is_followed_to_the_limit_and_says_so() -> None:
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
