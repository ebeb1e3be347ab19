"""Hysteresis read from loops by the integrated equation, on loops of the independent reference."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from psa_casadi.identification.fitting.unknowns import static_compliance
from psa_casadi.identification.start.ordinary import loop_start, starting_model
from psa_casadi.model.stacks import STACKS
from psa_casadi.records import Record
from tests.studies.benchmarks.coverage import quantities
from tests.studies.benchmarks.records import clean_loops, step_voltage, with_noise
from tests.tiers import slow, slow_but

BENDS = ("beta", "gamma", "delta")


def truth(name: str) -> dict[str, float]:
    return {key: figure.value for key, figure in STACKS[name].values.items()}


@cache
def loops(name: str) -> list[Record]:
    return clean_loops(truth(name))


def errors(name: str, records: list[Record]) -> dict[str, float]:
    """Return errors of what the loops show: k, A and the bends over k + A, n as it is."""
    p = truth(name)
    model = starting_model(records, p["k_B"])
    values = loop_start(model, records)
    assert values is not None
    size = static_compliance(p) * p["h_ref"]
    true, value = quantities(p, size), quantities({**model.values, **values}, size)
    over = true["k_L"] + true["A"]
    shares = {n: (value[n] - true[n]) / over for n in ("k_L", "A", *BENDS)}
    return {**shares, "n": value["n"] - true["n"]}


@pytest.mark.parametrize("name", slow_but(["P-885.51"], STACKS))
def test_loops_with_noise_tell_the_hysteresis(name: str) -> None:
    result = errors(name, with_noise(loops(name), 1e-3, seed=2))
    assert all(abs(e) < 0.03 for e in result.values()), result


def test_noise_of_one_per_cent_and_missing_samples_still_leave_a_good_start() -> None:
    """The logarithms of (31) and (34) have no samples left there."""
    spoiled = []
    for r in with_noise(loops("P-885.51"), 1e-2, seed=5):
        y = np.array(r.displacement)
        y[200:230] = np.nan
        spoiled.append(replace(r, displacement=y))
    result = errors("P-885.51", spoiled)
    assert all(abs(e) < 0.3 for e in result.values()), result
    assert abs(result["k_L"] + result["A"]) < 0.03


@slow
def test_loops_that_begin_amid_a_period_tell_it_too() -> None:
    cut = [replace_from(r, 300) for r in with_noise(loops("PTBS200"), 1e-3, seed=1)]
    result = errors("PTBS200", cut)
    assert all(abs(e) < 0.1 for e in result.values()), result


def replace_from(r: Record, first: int) -> Record:
    y = np.array(r.displacement)
    return Record(
        name=r.name, time=r.time[first:], voltage=r.voltage[first:], displacement=y[first:]
    )


def test_nothing_is_read_where_nothing_turns_or_moves() -> None:
    p = truth("P-885.51")
    t, v = step_voltage(p)
    step = Record(name="step", time=t, voltage=v, displacement=1e-7 * v)
    assert loop_start(starting_model([step]), [step]) is None
    still = replace_from(loops("P-885.51")[0], 0)
    still = replace(still, displacement=np.full(still.n, 1e-6))
    assert loop_start(starting_model(loops("P-885.51")), [still]) is None
