from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from psa_casadi.common.errors import InputError
from psa_casadi.records import decaying_triangle, multisine, sine, time_grid, triangle

TIME = time_grid(2.0, 1e-3)


@given(st.floats(-50, 100), st.floats(0.1, 200), st.floats(0.6, 60))
def test_no_voltage_leaves_its_range(low: float, span: float, frequency: float) -> None:
    high = low + span
    made = (
        sine(TIME, low, high, frequency),
        triangle(TIME, low, high, frequency),
        decaying_triangle(TIME, low, high, 5),
        multisine(TIME, low, high, (1.0, 1.0 + frequency), seed=1),
    )
    for voltage in made:
        assert voltage.shape == TIME.shape
        assert low <= voltage.min()
        assert voltage.max() <= high
    for voltage in made[:3]:
        assert voltage[0] == pytest.approx(low, abs=1e-9)


def test_sine_and_triangle_reach_their_ends_at_their_times() -> None:
    for voltage in (sine(TIME, -10.0, 90.0, 2.0), triangle(TIME, -10.0, 90.0, 2.0)):
        assert voltage[[0, 250, 500, 750, 1000]] == pytest.approx([-10, 90, -10, 90, -10])
        assert voltage[125] == pytest.approx(40.0)
    rates = np.abs(np.diff(triangle(TIME, -10.0, 90.0, 2.0))) / 1e-3
    np.testing.assert_allclose(rates, 2 * 2.0 * 100.0, rtol=1e-9)


@pytest.mark.parametrize("centre", [0.0, 50.0])
def test_a_decaying_triangle_nests_its_reversals(centre: float) -> None:
    voltage = decaying_triangle(TIME, 0.0, 100.0, 8, centre=centre)
    slope = np.sign(np.diff(voltage))
    turns = voltage[1:-1][np.flatnonzero(np.diff(slope))]
    upper, lower = turns[turns > centre + 1e-9], turns[turns < centre - 1e-9]
    assert upper.size == 8
    assert (np.diff(upper) < 0).all()
    assert (np.diff(lower) > 0).all()
    assert lower.size == (7 if centre else 0)
    assert abs(voltage[-1] - centre) < 0.2
    branch = voltage[:126]
    np.testing.assert_allclose(np.diff(branch), branch[-1] / 125, rtol=1e-9)


def test_a_multisine_is_flat_in_its_band_and_empty_outside() -> None:
    voltage = multisine(TIME, 0.0, 100.0, (5.0, 100.0), seed=3)
    lines = np.abs(np.fft.rfft(voltage)) / TIME.size
    inside = np.zeros(lines.size, dtype=bool)
    inside[10:201] = True
    np.testing.assert_allclose(lines[inside], lines[10], rtol=1e-9)
    assert lines[1:][~inside[1:]].max() < 1e-12
    assert (voltage.min(), voltage.max()) == pytest.approx((0.0, 100.0))
    again = multisine(TIME, 0.0, 100.0, (5.0, 100.0), seed=3)
    np.testing.assert_array_equal(voltage, again)
    assert np.abs(voltage - multisine(TIME, 0.0, 100.0, (5.0, 100.0), seed=4)).max() > 1.0


def test_what_the_grid_cannot_show_is_refused() -> None:
    for call in (
        partial(sine, TIME, 0.0, 1.0, 500.0),
        partial(triangle, TIME, 0.0, 1.0, 0.0),
        partial(decaying_triangle, TIME, 0.0, 1.0, 1000),
        partial(multisine, TIME, 0.0, 1.0, (1.0, 501.0), seed=0),
    ):
        with pytest.raises(InputError, match=r"cannot be shown .* up to 500 Hz"):
            call()
    with pytest.raises(InputError, match="low below high"):
        sine(TIME, 1.0, 1.0, 1.0)
    with pytest.raises(InputError, match=r"no multiple of 0\.5 Hz"):
        multisine(TIME, 0.0, 1.0, (1.1, 1.4), seed=0)
    with pytest.raises(InputError, match="centre 5"):
        decaying_triangle(TIME, 0.0, 1.0, 4, centre=5.0)
