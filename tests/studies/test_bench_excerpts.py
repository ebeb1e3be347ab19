"""The benchmark `excerpts`: its pieces, and how their ends are counted."""

import numpy as np

from psa_casadi.model.stacks import stack_model
from psa_casadi.records.record import Record
from psa_casadi.simulation.simulate import simulate
from tests.studies.benchmarks.excerpts import Ended, ended_of, table


def _record() -> Record:
    t = np.linspace(0.0, 2.999, 3000)
    voltage = 50.0 - 40.0 * np.cos(2 * np.pi * t)
    x = simulate(stack_model("P-885.51"), t, voltage).displacement
    return Record(
        name="r",
        time=t,
        voltage=voltage,
        displacement=x + 5e-9 * np.random.default_rng(2).standard_normal(t.size),
    )


def test_a_refusal_is_no_crash_and_a_crash_is_told() -> None:
    whole = _record()
    still = Record(
        name="still",
        time=whole.time,
        voltage=np.full(whole.n, 3.0),
        displacement=whole.displacement,
    )
    refused = ended_of(still)
    assert refused.how == "refused"
    found = [refused, Ended("a", "adequate", "", 2.0), Ended("b", "crashed", "KeyError: 'x'", 9.0)]
    told = table(found)
    assert ("crashed", "1", "") in told.table.rows
    assert ("crashed because", "1", "KeyError: 'x'") in told.table.rows
    assert "The slowest took 9 s" in told.note
