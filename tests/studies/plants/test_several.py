"""Several effects of one record act on each other in the order of the signal."""

from dataclasses import replace

import numpy as np
import pytest

from tests.studies.plants.base import Run, simulate_base
from tests.studies.plants.hide import Effect, added_by, effect_called
from tests.studies.plants.stack import FloatArray, draw_stack

_RATE, _FREQUENCY = 1000.0, 20.0
_LAG, _DELAY, _DRIVE, _ZETA = 4e-3, 2.5e-3, 3e-3, 0.8


@pytest.fixture(scope="module")
def linear() -> Run:
    """A stack without hysteresis, driven by a sine of 20 Hz for half a second."""
    stack = replace(draw_stack(np.random.default_rng(3)), a=0.0, beta=0.0, gamma=0.0, delta=0.0)
    times = np.arange(501) / _RATE
    return simulate_base(stack, times, 20.0 * np.sin(2.0 * np.pi * _FREQUENCY * times), 24)


def _amplitude(run: Run, signal: FloatArray) -> complex:
    """Complex amplitude of the last five periods at the drive's frequency [m]."""
    last = slice(-250, None)
    turn = np.exp(-2j * np.pi * _FREQUENCY * run.times[last])
    return complex(2.0 * np.mean(signal[last] * turn))


def _effect(name: str, gain: float, **parameters: float) -> Effect:
    return effect_called(name), parameters, gain


def test_lags_of_a_linear_stack_multiply(linear: Run) -> None:
    """Reference: the product of the transfer functions, by hand."""
    chain = [
        _effect("sensor_delay", _DELAY),
        _effect("sensor_lag", _LAG),
        _effect("drive_lag", _DRIVE, zeta=_ZETA),
    ]
    s = 2j * np.pi * _FREQUENCY
    expected = np.exp(-s * _DELAY) / (1.0 + s * _LAG)
    expected /= 1.0 + 2.0 * _ZETA * s * _DRIVE + (s * _DRIVE) ** 2
    moved = linear.displacement + added_by(linear, chain)
    result = _amplitude(linear, moved) / _amplitude(linear, linear.displacement)
    assert result == pytest.approx(expected, abs=2e-3)
    summed = linear.displacement + sum(e.contribution(linear, p, g) for e, p, g in chain)
    apart = _amplitude(linear, summed) / _amplitude(linear, linear.displacement)
    assert abs(apart - expected) > 0.2


def test_a_sensor_reads_what_the_stack_adds(linear: Run) -> None:
    """A sensor's step of the converter lies where the whole displacement passes its place."""
    place = 0.5 * float(linear.displacement.max())
    heights = {"mid": place, "quarter": 1.0, "next": 0.0}
    contact = _effect("preload_loss", 0.5, x_0=0.0, side=1.0)
    total = added_by(linear, [_effect("converter_step", 1e-7, **heights), contact])
    moved = linear.displacement + added_by(linear, [contact])
    assert np.allclose(total - added_by(linear, [contact]), 1e-7 * (moved > place), atol=1e-18)


def test_one_effect_and_none_are_as_without_others(linear: Run) -> None:
    effect, parameters, gain = _effect("charge_leakage", 0.1, t=0.2)
    alone = effect.contribution(linear, parameters, gain)
    assert np.array_equal(added_by(linear, [(effect, parameters, gain)]), alone)
    none = [_effect("drive_lag", 0.0, zeta=_ZETA), _effect("sensor_lag", 0.0)]
    assert not np.any(added_by(linear, none))
    assert not np.any(added_by(linear, []))


def test_two_drives_are_one_after_the_other(linear: Run) -> None:
    """A stack limited to a rate by its amplifier, with a slower command: the limit does nothing."""
    limit = _effect("current_limit", 1.0 / 2000.0)
    assert np.any(np.abs(added_by(linear, [limit])) > 1e-8)
    slow = _effect("drive_lag", 15e-3, zeta=_ZETA)
    both, only = added_by(linear, [slow, limit]), added_by(linear, [slow])
    assert np.allclose(both[100:], only[100:], atol=1e-11)
