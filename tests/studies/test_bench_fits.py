"""What the benchmark `fits` counts and prints: on figures made up here, so that all can be told."""

from dataclasses import replace

import numpy as np
import pytest

from psa_casadi.effects import EFFECTS
from psa_casadi.errors import PsaError
from psa_casadi.model.stacks import STACKS
from psa_casadi.simulation.simulate import EXACT, STEPPER, simulate
from tests.studies.benchmarks.fits import (
    Point,
    cheapest,
    least_times,
    run_table,
    time_at,
)
from tests.studies.benchmarks.fits_ways import (
    MIXED,
    Reached,
    Trial,
    effects_table,
    errors_table,
    stepper_alone,
    voltage,
    with_one_effect,
)

POINTS = [
    Point(EXACT, 1e-5, 2e-5, 5e-6, 1.5, 0.7, 1.4),
    Point(EXACT, 1e-6, 5e-6, 1e-6, 2.0, 0.8, 1.9),
    Point(EXACT, 1e-7, 2e-6, 2e-7, 3.0, 1.2, 2.8),
    Point(STEPPER, 1e-6, 2e-5, 2e-6, 16.0, 7.0, 1.9),
    Point(STEPPER, 1e-7, 1e-6, 2e-7, 22.0, 10.0, 2.8),
]
TRIAL = Trial("demo", "slow_creep", MIXED, 1e-3)
FINE = Reached(TRIAL, 1e-6, EXACT, 5e-7, 1.0, 1e-7, 4.0, 1e-9, EXACT, 2e-6)
FOUND = [
    replace(FINE, trial=replace(TRIAL, effect="base")),
    FINE,
    replace(FINE, trial=replace(TRIAL, effect="sensor_delay"), way=STEPPER, error=1e-7),
    replace(FINE, trial=replace(TRIAL, record="steps"), error=3e-6, stepper_error=2e-6),
]


def test_of_each_way_the_cheapest_run_below_the_error_counts() -> None:
    assert cheapest(POINTS, EXACT, "differentiated").tolerance == 1e-6
    assert cheapest(POINTS, STEPPER, "plain").tolerance == 1e-7
    with pytest.raises(PsaError, match="No tolerance"):
        cheapest(POINTS, STEPPER, "plain", 1e-9)
    note = run_table(POINTS, 5248).note
    assert "with 12 sensitivities 1/11 of the stepper's time" in note
    assert "without 1/12 of the stepper's time" in note


def test_a_time_between_two_tolerances_is_read_off_their_logarithms() -> None:
    assert time_at(POINTS, EXACT, "plain", 2e-5) == pytest.approx(0.7)
    assert time_at(POINTS, EXACT, "plain", 1e-5) == pytest.approx((0.7 * 0.8) ** 0.5)
    assert np.isnan(time_at(POINTS, EXACT, "plain", 1e-9))


def test_every_work_is_timed_after_a_first_use_in_turns() -> None:
    calls: list[str] = []
    least = least_times([lambda: calls.append("a"), lambda: calls.append("b")], 2)
    assert "".join(calls) == "ababab"
    assert all(0.0 <= s < 1.0 for s in least)


def test_the_base_is_no_effect_that_takes_a_way() -> None:
    loose = [replace(r, rtol=1e-4, way=EXACT) for r in FOUND[:3]]
    table = effects_table([*loose, *FOUND[:3]])
    assert table.note.startswith("Of 2 effects 2 take the exact way in a fit")
    assert "in `simulate` 2 at 1e-04, 1 at 1e-06." in table.note
    assert table.table.rows[2][0] == "sensor delay"
    assert table.table.rows[2][1:5] == (EXACT, "2.0e-6", EXACT, STEPPER)
    assert table.table.rows[1][5:] == ("5.0e-7", "0.50", "0.25")


def test_errors_above_the_tolerance_are_counted() -> None:
    everyone, exact, stepper = errors_table(FOUND).table.rows
    assert everyone[1:5] == ("simulate", "75 % (3 of 4)", "25 % (1 of 4)", "3.0")
    assert exact[1:5] == ("its exact runs", "100 % (3 of 3)", "33 % (1 of 3)", "3.0")
    assert stepper[1:] == (
        "stepper", "0 % (0 of 4)", "25 % (1 of 4)", "2.0", "demo, slow creep, steps, 1 ms"
    )  # fmt: skip
    assert "over its tolerance is 3.00" in errors_table(FOUND).note


def test_every_effect_is_at_work_beside_the_base_of_every_stack() -> None:
    for stack in STACKS:
        for name, effect in EFFECTS.items():
            assert with_one_effect(stack, name).values[str(effect.gain)] != 0.0


def test_exact_steps_are_left_out_only_within() -> None:
    def way() -> str:
        model, (t, v) = with_one_effect("demo", "base"), voltage("steps", 100.0, 1e-3)
        return simulate(model, t[:50], v[:50], rtol=1e-3).way

    assert way() == EXACT
    with stepper_alone():
        assert way() == STEPPER
    assert way() == EXACT
