"""Fits to slow loops, that leave parameters open: what is known of them, which records help."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from psa_casadi.common.units import FloatArray
from psa_casadi.identification.advice import Advice, advice, plans
from psa_casadi.identification.determinacy import (
    Combination,
    Determinacy,
    covariance_of,
    determinacy,
    free_combinations,
    physical_formulas,
)
from psa_casadi.identification.fitting.fit import Fit, fit
from psa_casadi.model.compose import Model
from psa_casadi.records import Record
from psa_casadi.records.split import Experiment, whole
from psa_casadi.report.words.notes import plan_words
from psa_casadi.simulation.simulate import simulate
from tests.model.stack_models import stack
from tests.studies.benchmarks.records import LOOP_FREQUENCIES, loop_voltage
from tests.tiers import slow_but

NOISE = 1e-3  # of the stroke
LOOP = ("k_L", "A", "beta", "gamma", "delta", "n")
FREE = (*LOOP, "tau", "R_s", "c_P", "c_B")


def measured(model: Model, name: str, time: FloatArray, voltage: FloatArray, seed: int) -> Record:
    x = simulate(model, time, voltage).displacement
    stroke = model.values["k_L"] * model.values["u_rated"] / model.values["k_B"]
    white = np.random.default_rng(seed).standard_normal(len(time))
    return Record(name=name, time=time, voltage=voltage, displacement=x + NOISE * stroke * white)


@cache
def loops(name: str) -> tuple[Fit, tuple[Experiment, ...], Determinacy]:
    """Return a fit to slow loops of a named stack: 1 Hz and 10 Hz, 500 samples a period."""
    model = stack(name)
    records = [
        measured(model, f"{f:g} Hz", *loop_voltage(model.values, 1.0, f), seed)
        for seed, f in enumerate(LOOP_FREQUENCIES)
    ]
    experiments = tuple(whole(r) for r in records)
    sigma = [NOISE * r.range_m for r in records]
    result = fit(model, experiments, FREE, sigma=sigma)
    return result, experiments, determinacy(result)


UNITS_OF_FORCE = ("N/V", "N/(V.s)", "N", "kg", "N.s/m", "N/m")


def of(result: tuple[Combination, ...], text: str) -> Combination:
    """Return the one combination whose sentence holds the text."""
    (combination,) = [c for c in result if text in c.sentence]
    return combination


@pytest.mark.parametrize("name", ["micromanipulator", "demo"])
def test_slow_loops_know_the_sum_of_the_lags(name: str) -> None:
    matches, _, determined = loops(name)
    p, errors = matches.model.values, determined.standard_errors
    result = of(free_combinations(matches.model, determined), "the sum of the lags")
    assert result.relative_error < 0.05
    (formula,) = [f for f in physical_formulas(p, FREE) if f.text == result.known]
    error = result.relative_error * formula.value(p)
    lag = {"tau": 1.0, "R_s": p["C_p"], "c_P": 1.0 / p["k_P"], "c_B": 1.0 / p["k_B"]}
    for n in result.parameters:
        assert errors[n] * lag[n] > 5.0 * error
    assert len(result.parameters) >= 2
    assert formula.value(p) == pytest.approx(formula.value(stack(name).values), abs=4.0 * error)


@pytest.mark.parametrize("name", ["micromanipulator", "P-885.51"])
def test_every_undetermined_parameter_is_in_a_sentence(name: str) -> None:
    matches, _, determined = loops(name)
    assert determined.undetermined
    result = free_combinations(matches.model, determined)
    named = {n for c in result[:-2] for n in c.parameters}
    assert set(determined.undetermined) <= named
    for c in result:
        assert c.sentence[0].isupper() or c.sentence.split()[0] in matches.model.values
        assert c.sentence.endswith(".")
        assert all(n in c.sentence for n in c.parameters)


def test_what_follows_from_the_form_is_true() -> None:
    """Forces may all be scaled, and R_s against C_p, and no displacement changes."""
    result, experiments, determined = loops("P-885.51")
    model, record = result.model, experiments[1].record
    scale = of(free_combinations(model, determined), "The scale of force is free")
    assert scale.parameters == tuple(
        p.name for p in model.structure.parameters if p.unit in UNITS_OF_FORCE
    )
    scaled = {n: 3.0 * model.values[n] for n in scale.parameters}
    drive = of(free_combinations(model, determined), "Only the product R_s C_p")
    assert drive.parameters == ("R_s", "C_p")
    other = {"R_s": 2.0 * model.values["R_s"], "C_p": 0.5 * model.values["C_p"]}
    x = simulate(model, record.time, record.voltage).displacement
    for values in (scaled, other):
        same = simulate(model.with_values(values), record.time, record.voltage).displacement
        np.testing.assert_allclose(same, x, rtol=0, atol=2e-6 * np.ptp(x))


def test_a_known_stiffness_ends_the_freedom_of_scale() -> None:
    matches, _, determined = loops("P-885.51")
    result = free_combinations(matches.model, determined, force_scale_given=True)
    assert not any("scale of force" in c.sentence for c in result)


def made(model: Model, errors: dict[str, float], free: dict[str, float]) -> Determinacy:
    """Return a determinacy of relative `errors` with a free direction (relative)."""
    names = tuple(errors)
    values = np.array([model.values[n] for n in names])
    along = np.array([free.get(n, 0.0) for n in names]) * values
    item = np.array([errors[n] for n in names]) * values
    covariance: FloatArray = np.outer(along, along) + np.diag(item**2)
    spread: FloatArray = np.sqrt(np.diag(covariance))
    return Determinacy(
        names=names,
        intervals={},
        standard_errors=dict(zip(names, spread.tolist(), strict=True)),
        covariance=covariance,
        correlations=covariance / np.outer(spread, spread),
        undetermined=tuple(
            n for n, s, v in zip(names, spread, values, strict=True) if s > 0.5 * abs(v)
        ),
        on_bound=(),
    )


@pytest.mark.parametrize(
    ("free", "known", "start"),
    [
        ({"c_P": 0.8, "k_P": 0.8}, "c_P/k_P", "Only the wafers' lag, c_P/k_P, is determined, to"),
        ({"c_P": 1.0, "c_B": -1300.0 / 670.0}, "c_P + c_B", "Only the sum of the dampings, c_P +"),
        ({"m_B": 2.0, "k_B": 2.0}, "m_B/k_B", "Only the bonding layers' resonance, m_B/k_B, is"),
        ({"k_L": 0.03, "A": 0.12}, "k_L + A", "k_L and A trade off: the slope after a reversal, k"),
        ({"beta": 0.6, "gamma": -4.4}, "beta + gamma", "Only the bend of a growing f_H, beta + g"),
        ({"delta": 0.7, "m_P": -0.7}, "delta m_P", "Only the product, delta m_P, is determined, "),
        ({"delta": 0.7, "m_P": 0.7}, "delta/m_P", "Only the ratio, delta/m_P, is determined, to"),
    ],
)
def test_a_trade_off_is_named_by_its_formula(
    free: dict[str, float], known: str, start: str
) -> None:
    model = stack("P-885.51")
    names = ("k_L", "A", "beta", "gamma", "delta", "n", "m_P", "c_P", "k_P", "m_B", "c_B", "k_B")
    result = free_combinations(model, made(model, dict.fromkeys(names, 1e-3), free))
    assert [c.known for c in result[:-1]] == [known]
    assert set(result[0].parameters) == set(free)
    assert result[0].sentence.startswith(start)
    assert result[0].relative_error < 0.02


def test_what_is_determined_or_free_by_itself_has_no_formula() -> None:
    model = stack("P-885.51")
    sure = made(model, dict.fromkeys(LOOP, 1e-2), {})
    assert len(free_combinations(model, sure)) == 1  # the scale of force
    alone = made(model, {"k_L": 1e-3, "delta": 3.0, "c_P": 2.0}, {})
    first, _ = free_combinations(model, alone)
    assert first.known is None
    assert first.parameters == ("delta", "c_P")
    assert first.sentence == "delta and c_P are free: these records hardly depend on any of them."


@pytest.mark.parametrize("samples", [20, 90, 400])
def test_slow_residuals_leave_no_negative_variance(samples: int) -> None:
    """Of residuals that swing slowly the correlation, cut off at its last lag, is none."""
    result, _, _ = loops("P-885.51")
    count = len(result.residuals)
    slow = result.sigma[0] * np.sin(2.0 * np.pi * np.arange(count) / samples)
    covariance = covariance_of(replace(result, residuals=slow))
    sizes = np.linalg.eigvalsh(covariance)
    assert sizes[0] >= -1e-9 * sizes[-1]
    assert np.all(np.diag(covariance) > 0.0)


def advised(name: str) -> tuple[Advice, ...]:
    result, _, determined = loops(name)
    return advice(result, determined)


def test_slow_loops_of_a_ringing_stack_call_for_fast_records() -> None:
    results = advised("PTBS200")
    planned = [a for a in results if a.record is not None]
    assert {n for a in planned for n in a.parameters} == {"tau", "R_s", "c_P", "c_B"}
    for a in planned:
        assert a.record is not None
        assert 5e3 < 1.0 / a.record.sample_time < 5e6
        assert a.record.duration < 0.5  # the loops take two seconds
        assert a.record.displacement is None
    assert results[0].sentence.endswith(f"would determine {', '.join(planned[0].parameters[:-1])}"
                                        f" and {planned[0].parameters[-1]}.")  # fmt: skip
    ringing, last = results[-2:]
    assert ringing.sentence.startswith("If the mechanics ring, m_P and m_B would be determined")
    assert (last.kind, last.record) == ("force", None)
    result, _, determined = loops("PTBS200")
    advices = advice(result, determined, force_scale_given=True)
    assert [a.sentence for a in advices] == [a.sentence for a in results[:-1]]


@pytest.mark.parametrize("name", slow_but(["P-885.51"], ["PTBS200", "P-885.51"]))
def test_following_the_advice_determines_what_it_promises(name: str) -> None:
    """The advice does not use the truth beyond the loops: PTBS200 rings, the other does not."""
    model = stack(name)
    result, experiments, determined = loops(name)
    results = advised(name)
    new = [
        whole(measured(model, f"new {k}", a.record.time, a.record.voltage, 10 + 20 * k + i))
        for k, a in enumerate(results)
        if a.record is not None
        for i in range(a.repeats)
    ]
    promised = [n for a in results if a.record is not None for n in a.parameters]
    if name == "PTBS200":
        promised += [n for a in results if a.sentence.startswith("If") for n in a.parameters]
    assert set(determined.undetermined) <= set(promised)
    both = [*experiments, *new]
    sigma = [*result.sigma, *[result.sigma[0]] * len(new)]
    again = fit(model, both, tuple(dict.fromkeys([*FREE, *promised])), sigma=sigma)
    after = determinacy(again)
    assert not set(promised) & set(after.undetermined)
    for n in promised:
        error = after.standard_errors[n]
        assert abs(again.model.values[n] - model.values[n]) < 4.0 * error
        if n in determined.undetermined:
            assert error < 0.5 * determined.standard_errors[n]


def test_what_no_record_can_determine_is_reported() -> None:
    """Only the product of resistance and capacitance acts on a displacement."""
    model = stack("P-885.51")
    time, voltage = loop_voltage(model.values, 1.0, 1.0)
    record = measured(model, "loop", time, voltage, 3)
    experiments = [whole(record)]
    result = fit(model, experiments, ("k_L", "R_s", "C_p"), sigma=[NOISE * record.range_m])
    determined = determinacy(result)
    assert {"R_s", "C_p"} == set(determined.undetermined)
    results = advice(result, determined)
    nothing = [a for a in results if a.sentence.startswith("None of the ")]
    assert len(nothing) == 1
    assert set(determined.undetermined) <= set(nothing[0].parameters)
    assert nothing[0].record is None


def test_plans_stay_within_the_records_voltages() -> None:
    model = stack("P-885.51")
    time, voltage = loop_voltage(model.values, 0.7, 1.0)
    record = Record(name="loop", time=time, voltage=voltage - 20.0)
    result = plans([model], [record])
    assert {p.kind for p in result} == {"step", "multisine", "loop", "minor loops"}
    for p in result:
        assert p.record.voltage.min() >= -20.0 - 1e-9
        assert p.record.voltage.max() <= 0.7 * 120.0 - 20.0 + 1e-9
        assert p.record.voltage[0] == pytest.approx(-20.0)
        assert "-20 V" in plan_words(p)
    rates = [p.rate for p in result if p.kind == "step"]
    assert rates == sorted(rates)
    assert len(rates) <= 6
