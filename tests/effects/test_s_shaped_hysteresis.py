"""A loop with an S-shaped middle is a memory of past reversals; effects linear in weights."""

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.identification.search import fit_base
from psa_casadi.identification.start.ordinary import starting_model
from psa_casadi.records.split import whole
from tests.studies.exam.hysteresis import relay_means
from tests.tiers import slow

_MEMORY = psa.EFFECTS["hysteresis_memory"]
_STROKE, _RATED, _NOISE = 20e-6, 100.0, 20e-9


def _record() -> psa.Record:
    """Loops of rising and falling amplitude of relays, whose density has a bell in its middle.

    4000 relays switch up at m + w/2 and down at m - w/2; w exponential, m as 1 + 0.8 exp(-(...)^2)
    (Mayergoyz, Mathematical Models of Hysteresis, ch. 1). None of the effects has relays.
    """
    rng = np.random.default_rng(11)
    t = np.arange(3000) * 2e-3
    swing = 0.5 * _RATED * np.interp(t, [0.0, 3.0, 6.0], [0.1, 1.0, 0.3])
    v = swing * (1.0 - np.cos(2.0 * np.pi * 1.5 * t))
    width = rng.exponential(0.12, 4000).clip(0.0, 0.9) * _RATED
    drawn = rng.uniform(-0.1, 1.1, 40_000)
    likely = 1.0 + 0.8 * np.exp(-(((drawn - 0.5) / 0.3) ** 2))
    middle = _RATED * drawn[rng.uniform(0.0, 1.8, drawn.size) < likely][:4000]
    up, down = middle + width / 2.0, middle - width / 2.0
    means = relay_means(v, up, down, np.full(4000, -1.0))
    x = 0.7 * v / _RATED + 0.15 * (means + 1.0)
    noise = rng.normal(0.0, _NOISE, t.size)
    return psa.record_from(
        {"time [s]": t, "voltage [V]": v, "displacement [m]": _STROKE * x / x.max() + noise}
    )


def test_a_gain_is_a_factor_of_the_linear_parameters() -> None:
    at = _MEMORY.at_gain(-3.0, {"memory_threshold": 0.1, "memory_square_0": 0.5})
    assert at["memory_gain"] == 1.0
    assert at["memory_threshold"] == 0.1
    assert at["memory_square_0"] == pytest.approx(-1.5)
    declared = next(p.value for p in _MEMORY.parameters if p.name == "memory_play_0")
    assert at["memory_play_0"] == pytest.approx(-3.0 * declared)
    assert psa.EFFECTS["slow_creep"].at_gain(0.2, {}) == {psa.EFFECTS["slow_creep"].gain: 0.2}


@slow
def test_a_fit_switches_an_effect_on_that_the_model_has_off() -> None:
    record = _record()
    base = starting_model([record])
    model = psa.compose([*psa.BASE, _MEMORY], dict(base.values))
    assert model.values["memory_gain"] == 0.0
    found = fit_base(model, [whole(record)])
    assert found.model.values["memory_gain"] == 1.0
    assert found.rms < 0.5 * fit_base(base, [whole(record)]).rms
