"""The benchmark `sampling`: the one equation that PyMC gets shows what the whole stack shows."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from psa_casadi.simulation.simulate import simulate
from tests.studies.benchmarks.sampling import (
    LEG,
    Drawn,
    hysteresis_rate,
    record,
    speed,
    stack,
)

#: NumPy under the names of PyMC's symbols.
NUMPY = SimpleNamespace(
    floor=np.floor, mod=np.mod, eq=np.equal, lt=np.less, switch=np.where, sqrt=np.sqrt
)


def test_the_reduced_equation_shows_the_stack_at_other_values() -> None:
    model = stack().with_values({"k_L": 7.9, "A": -1.5, "delta": -0.2, "n": 1.7})
    v, given = model.values, record()
    p = [v["A"], v["delta"], v["n"]]
    found = solve_ivp(
        lambda t, y: [hysteresis_rate(y[0], t, p, v, NUMPY)], (0.0, given.time[-1]), [30.0],
        t_eval=given.time, method="LSODA", rtol=1e-9, atol=1e-6, max_step=LEG / 20,
    )  # fmt: skip
    compliance = 1.0 / v["k_P"] + 1.0 / v["k_B"]
    reduced = compliance * (v["k_L"] * given.voltage + found.y[0])
    whole = simulate(model, given.time, given.voltage, memory={"f_H": 30.0}, rtol=1e-9)
    miss = reduced - whole.displacement
    assert np.max(np.abs(miss - np.mean(miss))) < 1e-4 * np.ptp(whole.displacement)
    assert np.ptp(found.y[0]) > 50.0  # it is the hysteresis that is compared


def test_the_table_states_effective_samples_per_processor_time() -> None:
    draws = np.random.default_rng(0).standard_normal((20000, 2))
    fast, slow = (Drawn(n, draws, 8000.0, s) for n, s in (("a", 2.0), ("b", 500.0)))
    told = speed([fast, slow])
    assert "250 times" in told.note
    for row, seconds in zip(told.table.rows, (2.0, 500.0), strict=True):
        assert float(row[4]) == pytest.approx(20000, rel=0.1)
        assert float(row[6]) == pytest.approx(float(row[4]) / seconds, rel=0.01)
