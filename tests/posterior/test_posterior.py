"""Parameter sets within the uncertainty: mean, sigma points and samples of the covariance."""

from dataclasses import replace

import numpy as np

from psa_casadi.export.common.parameter_sets import posterior_sets
from psa_casadi.model.compose import Model
from psa_casadi.model.evidence import Covariance
from psa_casadi.model.stacks import stack_model
from tests.model.evidence_models import evident_model

NAMES = ("k_L", "tau", "A")


def spread(errors: tuple[float, ...], correlation: float, names: tuple[str, ...] = NAMES) -> Model:
    """Return a model whose values have these relative standard errors, the first two correlated."""
    model = evident_model()
    assert model.evidence is not None
    sizes = np.array([model.values[n] for n in names]) * errors
    matrix = np.outer(sizes, sizes) * np.eye(len(names))
    matrix[0, 1] = matrix[1, 0] = correlation * sizes[0] * sizes[1]
    rows = tuple(tuple(row) for row in matrix.tolist())
    return replace(model, evidence=replace(model.evidence, covariance=Covariance(names, rows)))


def coordinates(model: Model, sets: dict[str, dict[str, float]], chosen: str) -> np.ndarray:
    """Return the chosen sets (n, k), as relative changes from the mean; logarithms where these are
    spread."""
    names = list(sets["mean"])
    mean = np.array(list(sets["mean"].values()))
    rows = np.array([list(v.values()) for n, v in sets.items() if n.startswith(chosen)])
    log = [model.parameter(n).log for n in names]
    return np.array(np.where(log, np.log(rows / mean), rows / mean - 1.0))


def sets_of(model: Model, samples: int) -> dict[str, dict[str, float]]:
    return {n: dict(v) for n, v in posterior_sets(model, samples).items()}


def test_sigma_points_have_the_covariance() -> None:
    model = spread((0.02, 0.05, 0.03), 0.7)
    sets = sets_of(model, 1)
    assert sets["mean"] == {n: model.values[n] for n in NAMES}
    plus, minus = (
        coordinates(
            model, {k: v for k, v in sets.items() if k == "mean" or k.endswith(side)}, "sig"
        )
        for side in ("plus", "minus")
    )
    assert len(plus) == len(minus) == 3
    half = 0.5 * (plus - minus)
    expected = np.diag([0.02, 0.05, 0.03]) ** 2
    expected[0, 1] = expected[1, 0] = 0.7 * 0.02 * 0.05
    np.testing.assert_allclose(half.T @ half, expected, atol=1e-7)


def test_samples_have_the_covariance() -> None:
    model = spread((0.02, 0.05, 0.03), 0.7)
    rows = coordinates(model, sets_of(model, 900), "sample")
    assert len(rows) == 900
    np.testing.assert_allclose(np.std(rows, axis=0), [0.02, 0.05, 0.03], rtol=0.08)
    assert abs(np.corrcoef(rows.T)[0, 1] - 0.7) < 0.05
    assert np.max(np.abs(np.mean(rows, axis=0)) / [0.02, 0.05, 0.03]) < 0.1


def test_all_lie_within_the_bounds() -> None:
    model = spread((3.0, 40.0, 3.0), 0.9)
    for values in posterior_sets(model, 30).values():
        for name, value in values.items():
            low, high = model.parameter(name).bounds
            assert low <= value <= high
            model.with_values({name: value})


def test_a_covariance_that_overflows_gives_no_values_that_are_none() -> None:
    """A file may hold any numbers; what is not a number could not be read back."""
    model = spread((1e150, 1e150, 1e150), 0.5)
    for values in posterior_sets(model, 3).values():
        model.with_values(values)
        assert all(np.isfinite(v) for v in values.values())


def test_a_value_without_spread_stays() -> None:
    model = spread((0.02, 0.05, 0.0), 1.0)  # two that are one, and one that is known
    sets = sets_of(model, 5)
    assert all(abs(v["A"] / model.values["A"] - 1.0) < 1e-6 for v in sets.values())
    rows = coordinates(model, sets, "sample")
    np.testing.assert_allclose(rows[:, 1] / rows[:, 0], 2.5, rtol=0.1)


def test_the_same_model_gives_the_same_sets() -> None:
    model = spread((0.02, 0.05, 0.03), 0.2)
    assert sets_of(model, 12) == sets_of(model, 12)
    assert list(sets_of(model, 12).items())[:10] == list(sets_of(model, 3).items())[:10]
    assert posterior_sets(stack_model("demo"), 20) == {}
