"""The trial sizes at which effects are looked for stand close enough to find every size."""

import numpy as np
import pytest

from psa_casadi.components import BASE
from psa_casadi.diagnosis.probes import directions, residual_jumps, residual_periods
from psa_casadi.effects import EFFECTS
from psa_casadi.identification.fitting.fit import fit
from psa_casadi.model.compose import compose
from psa_casadi.records.record import Record
from psa_casadi.records.split import whole
from psa_casadi.simulation.simulate import simulate
from psa_casadi.units import FloatArray
from tests.tiers import slow_but


@pytest.mark.parametrize("share", [0.97, 0.9, 0.8, 0.65, 0.5, 0.3, 0.1])
@pytest.mark.parametrize("size", slow_but([0.75], [0.4, 0.55, 0.75, 1.0]))
def test_a_current_limit_of_any_height_is_near_one_that_is_tried(share: float, size: float) -> None:
    """Steps of many sizes, all slewed in 1 ms; the limit is a share of the tallest one's current.

    Of limits three times apart, one would cut no step and the next most of them.
    """
    effect = EFFECTS["current_limit"]
    model = compose(BASE)
    time = np.linspace(0.0, 1.199, 1200)
    levels = np.array([0.0, 0.3, 0.1, 0.5, 0.2, 0.25, 0.7, 0.02, 0.95, 0.4])
    voltage = size * model.values["u_rated"] * np.repeat(np.tile(levels, 2), 60)
    clean = simulate(model, time, voltage).displacement
    experiments = (whole(Record(name="r", time=time, voltage=voltage, displacement=clean)),)
    base = fit(model, experiments, ["k_L"], sigma=[1e-8])
    current = model.values["C_p"] * float(np.max(np.abs(np.diff(voltage)))) / 1e-3
    limited = model.with_effect(effect, {"inverse_current_limit": 1.0 / (share * current)})
    added = simulate(limited, time, voltage).displacement - clean
    tried = [d.column for d in directions(base, experiments, [effect])]
    alike = [c @ added / np.sqrt((c @ c) * (added @ added)) for c in tried]
    assert max(alike) > 0.95


def _loops() -> tuple[FloatArray, FloatArray]:
    t = np.linspace(0.0, 4.0, 4001)
    return t, 50.0 - 40.0 * np.cos(2 * np.pi * t) * (1.0 - 0.15 * t)


@pytest.mark.parametrize("period", [0.2e-6, 0.7e-6, 1.3e-6])
def test_the_period_of_a_ripple_is_read_off_the_residual(period: float) -> None:
    """Under noise as large as the ripple, to a quarter of a period over the range."""
    model = compose(BASE)
    t, voltage = _loops()
    x = simulate(model, t, voltage).displacement
    noise = 2e-8 * np.random.default_rng(4).standard_normal(t.size)
    reading = x + 2e-8 * np.sqrt(2.0) * np.sin(2 * np.pi * x / period + 0.4) + noise
    experiments = (whole(Record(name="r", time=t, voltage=voltage, displacement=reading)),)
    found = residual_periods(fit(model, experiments, ["k_L", "A"], sigma=[2e-8]), experiments)
    count = float(np.ptp(x)) / period
    assert min(abs(np.ptp(x) / p - count) for p in found) < 0.25


@pytest.mark.parametrize("share", [0.2, 0.5, 0.85])
def test_the_place_of_a_jump_is_read_off_the_residual(share: float) -> None:
    """Under noise as large as half the jump; in the model's displacement, whatever the offset."""
    model = compose(BASE)
    t, voltage = _loops()
    x = simulate(model, t, voltage).displacement
    noise = 1e-8 * np.random.default_rng(4).standard_normal(t.size)
    place = float(x.min() + share * np.ptp(x))
    reading = x + 2e-8 * (x > place) + noise + 3e-6
    experiments = (whole(Record(name="r", time=t, voltage=voltage, displacement=reading)),)
    places = residual_jumps(fit(model, experiments, ["k_L", "A"], sigma=[2e-8]), experiments)
    assert min(abs(p - place) for p in places) < 0.01 * np.ptp(x)
