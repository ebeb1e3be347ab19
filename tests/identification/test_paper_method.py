"""The paper's method: exact where its assumptions hold, and a sentence wherever they do not."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from psa_casadi.identification.paper import (
    COEFFICIENTS,
    coefficients_of_limits,
    find_loops,
    find_steps,
    hysteresis_part,
    identify_by_paper,
    linear_part,
    mechanics_of,
    moment_coefficients,
    paper_method,
)
from psa_casadi.records import Record, decaying_triangle, multisine, time_grid, triangle
from tests.identification.paper_cases import (
    LEADING,
    LINEAR,
    closed_step,
    coefficients_of_values,
    compliance,
    loop,
    noisy,
    poles,
    real_step,
    residues,
    step_response,
)
from tests.model.stack_models import PAPER_STACKS, stack_values
from tests.tiers import slow, slow_but
from tests.voltages import steps

STACK = "P-885.51"


@pytest.mark.parametrize("name", PAPER_STACKS)
def test_exact_limits_give_exact_coefficients(name: str) -> None:
    """With 1 - g = -sum r_i e^(p_i t), the limits are K_m = (-1)^(m+1) sum r_i / p_i^m."""
    p = stack_values(name)
    limits = [(-1) ** (m + 1) * np.sum(residues(p) / poles(p) ** m).real for m in range(1, 7)]
    result = coefficients_of_limits(np.array(limits))
    np.testing.assert_allclose(result, coefficients_of_values(p), rtol=1e-3)


def test_moments_without_noise_and_with_a_little() -> None:
    """The breakdown as known: 8 ms at 100 kHz, white noise of 1e-5 of the step.

    The underdamped stack needs hardly any: 1e-9 is less than a simulation leaves.
    """
    time = np.linspace(0.0, 8e-3, 801)
    over, under = stack_values("WYDS0808020"), stack_values("PTBS200")

    def errors(p: dict[str, float], noise: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        white = noise * np.random.default_rng(0).standard_normal(time.size)
        result = moment_coefficients(time, step_response(p, time) + white)
        return np.asarray(np.abs(result / coefficients_of_values(p) - 1.0))

    quiet = errors(over, 0.0)
    assert np.all(quiet[:3] < 0.02)
    assert np.all(quiet < 0.3)
    assert errors(over, 1e-5).min() > 1.0
    assert errors(under, 1e-9).min() > 1.0


@pytest.mark.parametrize("name", PAPER_STACKS)
def test_factors_reproduce_the_coefficients(name: str) -> None:
    """The poles do not show which part is which, but all six coefficients come back."""
    p = stack_values(name)
    exact = coefficients_of_values(p)
    named = dict(zip(COEFFICIENTS, exact.tolist(), strict=True))
    result, notes = mechanics_of(named, p["k_P"], p["k_B"])
    assert notes == ()
    np.testing.assert_allclose(coefficients_of_values({**p, **result}), exact, rtol=1e-6)
    for key in ("tau", "m_P", "c_P", "m_B", "c_B") if name == "PTBS200" else ("tau",):
        assert result[key] == pytest.approx(p[key], rel=1e-4)


def test_a_zero_that_the_poles_do_not_allow_is_reported() -> None:
    p = stack_values("PTBS200")
    named = dict(zip(COEFFICIENTS, coefficients_of_values(p).tolist(), strict=True))
    result, notes = mechanics_of({**named, "b_1": 1e-3}, p["k_P"], p["k_B"])
    assert "the poles allow" in str(notes[0])
    assert result["tau"] == pytest.approx(p["tau"], rel=1e-4)


@pytest.mark.parametrize("leading", slow_but([False], [False, True]))
def test_the_loop_is_recovered_from_quiet_loops(leading: bool) -> None:
    p = stack_values(STACK)
    if leading:
        p |= {key: share * p["k_L"] for key, share in LEADING.items()}
    result = hysteresis_part(find_loops([loop(leading=leading)]), p["k_L"] * compliance(p))
    assert result.A is not None
    assert result.delta is not None
    assert result.bends is not None
    n, beta, gamma = result.bends.n, result.bends.beta, result.bends.gamma
    unit = compliance(p) ** (n - 1.0) * p["h_ref"] ** n
    assert result.A / compliance(p) == pytest.approx(p["A"], rel=0.01)
    assert result.delta / compliance(p) == pytest.approx(p["delta"], rel=0.15)
    assert n == pytest.approx(p["n"], rel=0.04)
    assert (beta + gamma) * unit == pytest.approx(p["beta"] + p["gamma"], rel=0.02)
    assert (gamma - beta) * unit == pytest.approx(p["gamma"] - p["beta"], rel=0.02)
    assert [n.code for n in result.notes] == ["lagging_loop"] * (not leading)


@slow
def test_the_whole_method_where_its_assumptions_hold() -> None:
    """A step without hysteresis and noise, long and dense; loops of the same stack."""
    p = stack_values(STACK)
    records = [closed_step(stack_values(STACK, **LINEAR), 8e-3, 40001), loop()]
    paper_identification = paper_method(records, stiffness=p["k_B"])
    assert paper_identification.coefficients is not None
    for name, exact in zip(COEFFICIENTS, coefficients_of_values(p), strict=True):
        assert paper_identification.coefficients[name] == pytest.approx(exact, rel=0.15), name
    assert paper_identification.k == pytest.approx(p["k_L"] * compliance(p), rel=1e-6)
    model = paper_identification.model.values
    assert model["k_B"] == p["k_B"]
    assert model["k_L"] == pytest.approx(p["k_L"], rel=1e-6)
    assert model["A"] == pytest.approx(p["A"], rel=0.01)
    same_unit = (p["h_ref"] / model["h_ref"]) ** model["n"]
    assert model["beta"] * same_unit == pytest.approx(p["beta"], rel=0.05)
    evaluated = identify_by_paper([loop()], stiffness=p["k_B"])
    assert evaluated.fit.rms < 0.02 * loop().range_m
    both = identify_by_paper(records, stiffness=p["k_B"])
    assert both.fit.unknowns.names == ()
    on_loop = both.fit.residuals[-loop().n :]
    assert np.sqrt(np.mean(on_loop**2)) < 0.003 * loop().range_m


def test_steps_and_loops_are_classified_by_their_voltage() -> None:
    time = time_grid(2.0, 1e-3)
    held = np.where(time < 0.5, 10.0, 60.0)
    shapes = {
        "held": held,
        "ramped": np.interp(time, [0.5, 0.52], [0.0, 60.0]),
        "slow": np.interp(time, [0.5, 0.8], [0.0, 60.0]),
        "staircase": steps(time, [0.0, 20.0, 40.0, 60.0]),
        "triangle": triangle(time, 0.0, 60.0, 2.0),
        "minor": decaying_triangle(time, 0.0, 60.0, 4),
        "multisine": multisine(time, 0.0, 60.0, (1.0, 20.0), seed=2),
    }
    records = [
        Record(name=n, time=time, voltage=v, displacement=1e-7 * v) for n, v in shapes.items()
    ]
    table = {s.name: s for s in find_steps(records)}
    assert list(table) == ["held", "ramped"]
    assert table["held"].volts == 50.0
    assert table["ramped"].k == pytest.approx(1e-7)
    start = table["ramped"].time[-1] - (time[-1] - 0.51)
    assert start == pytest.approx(0.0, abs=1e-6)
    loops = {a.name: a.frequency for a in find_loops(records)}
    assert loops == {"triangle": pytest.approx(2.0), "minor": pytest.approx(2.0)}


def _gap() -> Record:
    x = np.array(loop().displacement)
    x[100:110] = np.nan
    return replace(loop(), displacement=x)


def _late_loop() -> Record:
    r = loop()
    return r.slice(170, r.n)


def _quiet(duration: float = 8e-3, samples: int = 40001, **changes: float) -> Record:
    return closed_step(stack_values(STACK, **LINEAR, **changes), duration, samples)


#: Records, and the sentence on them.
FAILURES: dict[str, tuple[Callable[[], list[Record]], str]] = {
    "no step": (lambda: [loop()], "No record is a step"),
    "no loop": (lambda: [_quiet()], "No record is a loop"),
    "truncated": (lambda: [_quiet(1e-3)], "the window truncates the response"),
    "noise": (
        lambda: [closed_step(stack_values(STACK, **LINEAR), 4e-3, 4001, 1e-5)],
        "white noise of 1e-05 of the step",
    ),
    "ringing": (
        lambda: [closed_step(stack_values("PTBS200", **LINEAR), 8e-3, 8001)],
        "the response rings (it overshoots by",
    ),
    "signs": (lambda: [_quiet(1e-3)], "not larger than zero"),
    "poles": (lambda: [_quiet(1e-3)], "The denominator of eq. (15) is no stack's"),
    "fast loops": (lambda: [_quiet(), loop(frequency=10.0)], "the paper asks for less than 1 Hz"),
    "lag": (
        lambda: [_quiet(1.0, 4001, tau=1e-2), loop()],
        "which the method counts as hysteresis",
    ),
    "not from rest": (lambda: [_quiet(), _late_loop()], "do not begin at 0 V"),
    "gaps": (lambda: [_quiet(), _gap()], "Missing samples were bridged"),
    "secant": (lambda: [real_step(120.0), loop()], "k, read from a step, holds what"),
    "small step": (lambda: [real_step(1.0), loop()], "x = k u is not met on the falling"),
    "logarithms": (lambda: [_quiet(), noisy(loop(), 5e-3)], "% of the logarithms on the"),
    "velocity": (lambda: [_quiet(), noisy(loop(), 3e-3)], "does not allow a good velocity"),
    "lagging": (lambda: [_quiet(), loop()], "gamma > beta does not hold"),
    "range": (lambda: [_quiet(), noisy(loop(), 5e-3)], "is outside of its range, 1 to 4"),
}


@pytest.mark.parametrize(
    "case", slow_but(["no step", "no loop", "ringing", "logarithms"], FAILURES)
)
def test_every_condition_that_fails_has_its_sentence(case: str) -> None:
    make, expected = FAILURES[case]
    paper_identification = paper_method(make())
    assert any(expected in s for s in paper_identification.sentences), (
        paper_identification.sentences
    )
    numbers = [
        *paper_identification.model.values.values(),
        *(paper_identification.coefficients or {}).values(),
    ]
    assert np.all(np.isfinite(numbers))
    assert all(s.endswith(".") for s in paper_identification.sentences)


@slow
def test_no_warning_concerns_a_step_that_serves() -> None:
    assert linear_part(find_steps([_quiet(6e-3, 40001)])[0])[1] == []
    paper_identification = paper_method([_quiet(6e-3, 40001), loop()])
    assert not any(
        "not to be trusted" in s or "no stack's" in s for s in paper_identification.sentences
    )
    names = {"k_L", "A", "beta", "gamma", "delta", "n", "tau", "m_B", "c_B"}
    assert set(paper_identification.identified) >= names


def test_a_hysteresis_that_runs_away_is_set_back(monkeypatch: pytest.MonkeyPatch) -> None:
    real = paper_method([loop()])
    wild = real.model.with_values({"beta": -2e3, "gamma": 0.0, "A": -50.0, "n": 4.0})
    monkeypatch.setattr(
        "psa_casadi.identification.paper.paper_method",
        lambda *_, **__: replace(real, model=wild),
    )
    stack_identification = identify_by_paper([loop()])
    assert "cannot be simulated on the records" in stack_identification.warnings[-1]
    assert np.isfinite(stack_identification.fit.rms)
