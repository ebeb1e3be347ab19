"""The exact linear response, play operators, and vector fitting behind the starting values."""

import numpy as np
import pytest
from scipy.signal import lsim

from psa_casadi.identification.start.linear_response import (
    Response,
    mechanics_poles,
    numerator_time,
    plays,
    respond,
    vector_fit,
)
from psa_casadi.identification.start.starting_points import arrangements
from tests.identification.paper_cases import transfer


def test_the_response_is_exact_between_samples() -> None:
    theta = np.log([1e-5, 3e-5, 2e-7, 9e-12, 4e-6, 6e-11, 4.0])
    poles, b, h = np.append(mechanics_poles(theta), -1e5), numerator_time(theta), 1e-6
    x = np.concatenate([[0.0], np.cumsum(np.random.default_rng(1).standard_normal(2000))])
    gain = np.real(np.prod(-poles)) * b
    _, exact, _ = lsim(([-1.0 / b], poles, gain), x, h * np.arange(x.size))
    assert np.max(np.abs(respond(poles, b, x, h) - exact)) < 1e-9 * np.ptp(exact)
    f = np.geomspace(1e2, 1e6, 20)
    s = 2j * np.pi * f[:, None]
    direct = gain * (s[:, 0] + 1.0 / b) / np.prod(s - poles, axis=1)
    assert np.allclose(transfer(theta, f), direct, rtol=1e-9)


@pytest.mark.parametrize("q", [1e-10, 0.9999999e-10, 1.0000001e-10])
def test_equal_poles_are_no_singularity(q: float) -> None:
    """Two critically damped pairs at one place, against pairs a hair apart: the same response."""
    x, h = np.minimum(np.arange(600) / 3.0, 1.0), 1e-6
    theta = np.log([2e-5, 4e-5, 2e-5, q, 2e-5, q, 5.0])
    apart = np.log([2e-5, 4e-5, 2.2e-5, 1e-10, 2e-5, 0.9e-10, 5.0])
    result, near = (respond(mechanics_poles(t), numerator_time(t), x, h) for t in (theta, apart))
    assert result[-1] == pytest.approx(1.0, abs=1e-4)
    assert np.max(np.abs(result - near)) < 0.05


def test_play_operators_follow_their_recursion() -> None:
    u = np.cumsum(np.random.default_rng(3).standard_normal(777))
    radii = np.array([0.5, 3.0, 20.0])
    state = np.full(3, u[0])
    for value, result in zip(u, plays(u, radii), strict=True):
        state = np.minimum(np.maximum(state, value - radii), value + radii)
        assert np.array_equal(result, state)


def test_vector_fitting_finds_the_poles() -> None:
    theta, h = np.log([1e-7, 5e-5, 1e-7, 1e-14, 6e-6, 6e-11, 5.0]), 1e-6
    w = np.where(np.arange(1500) < 10, 0.0, 1e-5)
    y = respond(mechanics_poles(theta), numerator_time(theta), w, h)
    y += 1e-8 * np.random.default_rng(0).standard_normal(w.size)
    poles = vector_fit(Response(h, w, y, np.ones(w.size, dtype=bool), 1e-8), 3)
    tone = poles[poles.imag > 0][0]
    assert abs(tone) == pytest.approx(6e-11**-0.5, rel=0.01)
    assert -2.0 * tone.real / abs(tone) ** 2 == pytest.approx(6e-6, rel=0.1)
    assert poles[poles.imag == 0][0].real == pytest.approx(-2e4, rel=0.02)


def test_every_arrangement_holds_the_poles_it_is_given() -> None:
    inputs = np.array([-1e3, -8e3, -2e3 + 3e4j, -2e3 - 3e4j])
    for theta in arrangements(inputs, 1e-6):
        placed = np.append(mechanics_poles(theta), -np.exp(-theta[0]))
        for pole in inputs:
            assert np.min(np.abs(placed - pole)) < 1e-6 * abs(pole)
    assert len(arrangements(inputs, 1e-6)) > 2
