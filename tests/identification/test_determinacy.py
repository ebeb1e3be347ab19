"""What records know of parameters that they leave open, in words."""

from dataclasses import replace

import numpy as np
import pytest

from psa_casadi.common.units import FloatArray
from psa_casadi.identification.determinacy import (
    Combination,
    Determinacy,
    covariance_of,
    free_combinations,
    physical_formulas,
)
from psa_casadi.model.compose import Model
from psa_casadi.simulation.simulate import simulate
from tests.identification.loop_fits import FREE, LOOP, loops
from tests.model.stack_models import stack

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


def test_a_given_stiffness_ends_the_freedom_of_scale() -> None:
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
