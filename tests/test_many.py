"""Many sets of parameters at once: the bits of each alone, whatever stands beside it."""

import numpy as np
import pytest
from numpy.typing import NDArray

from psa_casadi.component import Component
from psa_casadi.effects import EFFECTS
from psa_casadi.errors import InputError
from psa_casadi.model.compose import Model
from psa_casadi.records.record import Record
from psa_casadi.simulation.many import simulate_many
from psa_casadi.simulation.simulate import simulate_record
from tests.stack_models import stack

FloatArray = NDArray[np.float64]


def record(uneven: bool = False) -> Record:
    """Return two cycles, a ramp and a hold; with other time steps throughout if `uneven`."""
    t: FloatArray = np.arange(600, dtype=np.float64) * 2e-4
    if uneven:
        t = t + 1e-5 * np.random.default_rng(1).standard_normal(600)
    s = np.arange(600) / 600
    v = np.where(s < 0.6, 40.0 * (1.0 - np.cos(2 * np.pi * s / 0.3)), np.minimum(400 * s - 240, 80))
    return Record(name="sets", time=t, voltage=np.asarray(v, dtype=np.float64))


def sets(model: Model, count: int) -> list[dict[str, float]]:
    rng = np.random.default_rng(3)
    return [
        {
            "k_L": model.values["k_L"] * (1 + 0.2 * rng.random()),
            "n": 1.0 + rng.random(),
            "delta": 20.0 * rng.standard_normal(),
            "R_s": model.values["R_s"] * 10.0 ** rng.uniform(-1, 1),
        }
        for _ in range(count)
    ]


@pytest.mark.parametrize("effect", ["", "load_stiffness", "rate_dependent_hysteresis"])
def test_a_set_has_the_same_bits_alone_and_beside_others(effect: str) -> None:
    """Nine sets fill two groups of four lanes and begin a third; loops and turns differ by set."""
    model = stack("P-885.51")
    if effect:
        gains = {"load_stiffness": "load_gain", "rate_dependent_hysteresis": "rate_gain"}
        model = model.with_effect(_effect(effect), {gains[effect]: 0.02})
    given = sets(model, 9)
    together = simulate_many(model, given, record())
    assert together.shape == (9, 600)
    for k in (0, 3, 4, 8):
        assert np.array_equal(simulate_many(model, [given[k]], record())[0], together[k])
    assert np.array_equal(simulate_many(model, given[::-1], record()), together[::-1])


def test_each_set_is_what_simulate_gives() -> None:
    model = stack("P-885.51")
    given = sets(model, 4)
    for row, values in zip(simulate_many(model, given, record()), given, strict=True):
        alone = simulate_record(model.with_values(values), record())
        assert np.max(np.abs(row - alone.displacement)) < 2e-5 * np.ptp(row)


def test_a_set_that_cannot_be_simulated_leaves_the_others_alone() -> None:
    model = stack("PTBS200")
    lost = {"A": -5.0, "beta": -4000.0, "gamma": 0.0, "n": 3.0}
    given = [{}, lost, {"k_L": 1.1 * model.values["k_L"]}]
    found = simulate_many(model, given, record())
    assert np.isnan(found[1, -1])
    assert np.isfinite(found[[0, 2]]).all()
    assert np.array_equal(found[[0, 2]], simulate_many(model, [given[0], given[2]], record()))


def test_what_is_kept_of_each_set() -> None:
    """Whole rows, a number and an array of each set; groups of four lanes and the stepper alike."""
    model = stack("P-885.51")
    given = sets(model, 5)
    for one in (record(), record(uneven=True)):
        rows = simulate_many(model, given, one)
        ranges = simulate_many(model, given, one, reduce=np.ptp)
        thinned = simulate_many(model, given, one, reduce=lambda row: row[::100])
        assert np.array_equal(ranges, np.ptp(rows, axis=1))
        assert np.array_equal(thinned, rows[:, ::100])


def test_sets_by_the_names_of_parameters() -> None:
    model = stack("P-885.51")
    given = sets(model, 5)
    columns = {name: [values[name] for values in given] for name in given[0]}
    rows = simulate_many(model, given, record())
    assert np.array_equal(simulate_many(model, columns, record()), rows)
    with pytest.raises(InputError, match=r"in arrays of one length; .*k_L \(5,\), n \(1,\)"):
        simulate_many(model, {"k_L": columns["k_L"], "n": 1.5}, record())
    with pytest.raises(InputError, match="there are: none"):
        simulate_many(model, {}, record())
    with pytest.raises(InputError, match="no parameter 'stiffness'"):
        simulate_many(model, {"stiffness": [1.0]}, record())
    with pytest.raises(InputError, match="outside its bounds"):
        simulate_many(model, {"n": [1.5, -1.0]}, record())


def test_uneven_records_run_in_the_stepper() -> None:
    model = stack("P-885.51")
    found = simulate_many(model, [{}, {"k_L": 1.1 * model.values["k_L"]}], record(uneven=True))
    even = simulate_many(model, [{}], record())
    assert np.isfinite(found).all()
    assert np.max(np.abs(found[0] - even[0])) < 0.05 * np.ptp(even)


def test_mistakes_are_told() -> None:
    model = stack("P-885.51")
    assert simulate_many(model, [], record()).shape == (0, 600)
    with pytest.raises(InputError, match="no parameter 'stiffness'"):
        simulate_many(model, [{"stiffness": 1.0}], record())
    with pytest.raises(InputError, match="outside its bounds"):
        simulate_many(model, [{"n": -1.0}], record())


def _effect(name: str) -> Component:
    return EFFECTS[name]
