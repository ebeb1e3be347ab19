"""Screening of several effects at once, against least squares over every set."""

from itertools import combinations
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from psa_casadi.diagnosis.colour import Colour
from psa_casadi.diagnosis.probes import Direction
from psa_casadi.diagnosis.screening import best_sets
from psa_casadi.effects import EFFECTS
from psa_casadi.identification.fitting.fit import Fit

FloatArray = NDArray[np.float64]

NAMES = ("slow_creep", "load_stiffness", "sensor_nonlinearity", "sensor_delay", "mains_hum")
SAMPLES, UNIT = 600, 0.03


def direction(name: str, column: FloatArray, *, one_sided: bool = False) -> Direction:
    return Direction(EFFECTS[name], {}, ({},), UNIT, column, one_sided, finite=False)


def case(seed: int) -> tuple[Fit, list[Direction], FloatArray, FloatArray]:
    """A base of three columns, two directions of every effect, and a residual of two of them.

    What is explained most by one direction is neither of the two: it lies between them.
    """
    rng = np.random.default_rng(seed)
    base = rng.standard_normal((SAMPLES, 3))
    columns = rng.standard_normal((SAMPLES, 2 * len(NAMES)))
    columns[:, 8] = columns[:, 0] + columns[:, 6] + 0.3 * columns[:, 8]
    truth = 2.0 * columns[:, 0] + 2.0 * columns[:, 6] + base @ [5.0, -3.0, 1.0]
    residual = truth + 0.1 * rng.standard_normal(SAMPLES)
    fit = cast("Fit", cast("Any", SimpleNamespace(jacobian=base, residuals=residual, further=())))
    own = [direction(NAMES[k // 2], columns[:, k]) for k in range(columns.shape[1])]
    return fit, own, base, residual


COLOUR = Colour((np.array([0.4]),), 0.1, (SAMPLES,))


@pytest.mark.parametrize("seed", range(4))
def test_the_best_set_is_that_of_least_squares(seed: int) -> None:
    fit, own, base, residual = case(seed)
    for size in (1, 2, 3):
        found = best_sets(fit, own, COLOUR, size)
        assert len(found) == len(list(combinations(NAMES, size)))
        for best in (found[0], found[-1]):
            columns = np.column_stack([base, *(d.column for d in best.directions)])
            w, r = COLOUR.whiten(columns), COLOUR.whiten(residual)
            theta = np.linalg.lstsq(w, r, rcond=None)[0]
            left = float(np.sum((r - w @ theta) ** 2))
            start = w[:, :3] @ np.linalg.lstsq(w[:, :3], r, rcond=None)[0]
            before = float(np.sum((r - start) ** 2))
            gains = pytest.approx(theta[3:] * UNIT, rel=1e-6, abs=1e-4 * UNIT)
            assert np.array(best.gains) == gains
            assert best.promise == pytest.approx(0.5 * SAMPLES * np.log(before / left), rel=1e-5)


def test_two_causes_are_found_where_one_at_a_time_is_led_astray() -> None:
    fit, own, _, _ = case(0)
    alone, pair = (best_sets(fit, own, COLOUR, size)[0] for size in (1, 2))
    assert alone.names == {"mains_hum"}
    assert pair.names == {"slow_creep", "sensor_delay"}
