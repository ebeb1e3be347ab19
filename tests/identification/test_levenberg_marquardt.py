"""The minimiser against problems whose answers are known."""

from functools import partial

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from psa_casadi.common.units import FloatArray
from psa_casadi.identification.fitting.levenberg_marquardt import Minimum, minimise

Pair = tuple[FloatArray, FloatArray]

OPEN = (np.full(2, -np.inf), np.full(2, np.inf))


def rosenbrock(x: FloatArray, steep: float = 10.0) -> Pair:
    residual = np.array([steep * (x[1] - x[0] ** 2), 1.0 - x[0]])
    return residual, np.array([[-2.0 * steep * x[0], steep], [-1.0, 0.0]])


def above(x: FloatArray, steep: float = 10.0) -> Pair:
    """Rosenbrock's valley at a height of 100."""
    residual, jacobian = rosenbrock(x, steep)
    return np.append(residual, 10.0), np.vstack([jacobian, np.zeros(2)])


def solved(minimum: Minimum | None) -> Minimum:
    assert minimum is not None
    assert minimum.converged
    return minimum


@pytest.mark.parametrize("start", [(-1.2, 1.0), (5.0, -30.0), (0.0, 0.0)])
def test_rosenbrocks_valley(start: tuple[float, float]) -> None:
    result = solved(minimise(rosenbrock, np.array(start), OPEN, tolerance=1e-10, evaluations=200))
    np.testing.assert_allclose(result.theta, [1.0, 1.0], atol=1e-8)
    assert result.cost < 1e-16
    assert result.evaluations < 60


def test_rosenbrocks_valley_behind_a_bound() -> None:
    """With x <= 0.5 the minimum lies on the bound, at y = x^2."""
    bounds = (np.array([-2.0, -2.0]), np.array([0.5, 2.0]))
    start = np.array([-1.2, 1.0])
    result = solved(minimise(rosenbrock, start, bounds, tolerance=1e-10, evaluations=200))
    assert result.theta[0] == 0.5
    assert result.theta[1] == pytest.approx(0.25, abs=1e-6)
    assert result.cost == pytest.approx(0.25, rel=1e-9)


@pytest.mark.parametrize("seed", range(8))
def test_linear_problems_in_a_box(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = rng.standard_normal((20, 6)), rng.standard_normal(20)
    a[:, 1] = a[:, 0] + 1e-2 * a[:, 1]  # a narrow valley
    bounds = (np.full(6, -0.15), np.full(6, 0.2))

    def evaluate(x: FloatArray) -> Pair:
        return a @ x - b, a

    result = solved(minimise(evaluate, np.zeros(6), bounds, tolerance=1e-12, evaluations=300))
    true = lsq_linear(a, b, bounds, tol=1e-14, max_iter=1000)
    assert np.count_nonzero(np.abs(true.active_mask)) > 0
    np.testing.assert_allclose(result.theta, true.x, atol=1e-5)
    assert result.cost == pytest.approx(2.0 * true.cost, rel=1e-9)
    np.testing.assert_array_equal((result.theta == 0.2).astype(int) - (result.theta == -0.15),
                                  np.sign(true.active_mask))  # fmt: skip


def test_a_start_outside_the_box_is_moved_into_it() -> None:
    arrays: list[FloatArray] = []

    def evaluate(x: FloatArray) -> Pair:
        arrays.append(x)
        return x - 0.5, np.eye(2)

    box = (np.zeros(2), np.ones(2))
    result = solved(minimise(evaluate, np.array([9.0, -9.0]), box, tolerance=1e-9, evaluations=50))
    np.testing.assert_allclose(result.theta, 0.5, atol=1e-9)
    assert all(np.all((x >= 0) & (x <= 1)) for x in arrays)


@pytest.mark.parametrize("size", [1e80, 1e160])
def test_a_start_whose_squares_overflow_counts_as_none(size: float) -> None:
    """A simulation that diverges to a huge and finite value: no damping is large enough there."""
    box = (np.array([-1.0, -1.0]), np.array([0.1, 1.0]))

    def diverged(_: FloatArray) -> Pair:
        return size * np.array([-1.0, 1.0]), size * np.array([[1.0, 0.5], [0.5, -1.0]])

    assert minimise(diverged, np.zeros(2), box, tolerance=1e-9, evaluations=20) is None


def test_a_step_into_overflow_is_taken_back() -> None:
    def cliff(x: FloatArray) -> Pair:
        return (np.full(1, 1e200), np.eye(1)) if x[0] > 2.0 else (x - 1.0, np.eye(1))

    result = solved(minimise(cliff, np.full(1, -4.0), (OPEN[0][:1], OPEN[1][:1]), tolerance=1e-9,
                            evaluations=50, radius=20.0))  # fmt: skip
    np.testing.assert_allclose(result.theta, 1.0, atol=1e-9)


def test_what_cannot_be_evaluated() -> None:
    def nowhere(_: FloatArray) -> Pair | None:
        return None

    def left_of_one(x: FloatArray) -> Pair | None:
        return (np.exp(x) - np.exp(0.98), np.diag(np.exp(x))) if np.all(x < 1.0) else None

    start = np.array([-2.0, 0.0])
    assert minimise(nowhere, start, OPEN, tolerance=1e-9, evaluations=50) is None
    result = solved(minimise(left_of_one, start, OPEN, tolerance=1e-9, evaluations=100))
    np.testing.assert_allclose(result.theta, 0.98, atol=1e-6)


def test_an_iteration_that_is_cut_off_reports_it() -> None:
    start = np.array([-1.2, 1.0])
    minimum = minimise(rosenbrock, start, OPEN, tolerance=1e-10, evaluations=4)
    assert minimum is not None
    assert (minimum.converged, minimum.evaluations) == (False, 4)
    residual, jacobian = rosenbrock(minimum.theta)
    np.testing.assert_array_equal(minimum.residual, residual)
    np.testing.assert_array_equal(minimum.jacobian, jacobian)
    assert minimum.cost == residual @ residual
    assert minimum.cost < 24.2


def shifted(x: FloatArray) -> Pair:
    """Rosenbrock's valley above a level that is far from the start of a search."""
    residual, jacobian = rosenbrock(x[:2])
    far = x[2] - 1e3 + x[0] ** 2
    slope = [2.0 * x[0], 0.0, 1.0]
    return np.append(residual, far), np.vstack([np.column_stack([jacobian, np.zeros(2)]), slope])


def test_linear_coordinates_are_best_from_the_first_evaluation_on() -> None:
    start, none = np.array([-1.2, 1.0, 0.0]), (np.full(3, -np.inf), np.full(3, np.inf))
    first = minimise(shifted, start, none, tolerance=1e-10, evaluations=1, linear=[2])
    assert first is not None
    assert first.theta[2] == pytest.approx(1e3 - 1.44)
    assert first.cost == pytest.approx(float(np.sum(rosenbrock(start[:2])[0] ** 2)))
    result = solved(minimise(shifted, start, none, tolerance=1e-10, evaluations=200, linear=[2]))
    np.testing.assert_allclose(result.theta, [1.0, 1.0, 1e3 - 1.0], atol=1e-7)
    assert result.evaluations < 30


def test_a_goal_out_of_reach_ends_the_search() -> None:
    start = np.array([-1.2, 1.0])
    free, near, far = (
        minimise(above, start, OPEN, tolerance=1e-10, evaluations=200, goal=goal)
        for goal in (np.inf, 100.5, 50.0)
    )
    assert free
    assert near
    assert far
    assert near.theta.tolist() == free.theta.tolist()
    assert not far.converged
    assert far.evaluations < free.evaluations


@pytest.mark.parametrize("steep", [10.0, 30.0, 100.0, 300.0])
@pytest.mark.parametrize("start", [(-1.2, 1.0), (-2.0, 2.0), (-3.0, 1.0), (0.0, 3.0)])
def test_a_short_step_does_not_end_a_search_for_a_goal_within_reach(
    steep: float, start: tuple[float, float]
) -> None:
    """In Rosenbrock's valley a radius that was too large makes one step short, and not the next."""
    valley = partial(rosenbrock, steep=steep)
    minimum = minimise(valley, np.array(start), OPEN, tolerance=1e-10, evaluations=200, goal=1e-2)
    assert minimum is not None
    assert minimum.cost < 1e-2


@pytest.mark.parametrize("steep", [30.0, 100.0, 300.0, 1000.0])
@pytest.mark.parametrize("start", [(-2.0, 4.0), (-3.0, 9.0), (-4.0, 16.0)])
def test_a_patient_search_does_not_end_where_a_valley_bends(
    start: tuple[float, float], steep: float
) -> None:
    """It ends where no step promises over ten tolerances, 1 % of the cost; the end is at 100.

    That height hides what short steps gain.
    """
    patient, hasty = (
        solved(minimise(partial(above, steep=steep), np.array(start), OPEN, tolerance=1e-3,
                        evaluations=500, radius=0.1, patient=p))
        for p in (True, False)
    )  # fmt: skip
    assert patient.cost < 101.1
    assert steep < 300.0 or hasty.cost > 101.8
