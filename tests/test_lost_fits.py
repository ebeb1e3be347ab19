"""Fits that lose themselves: an effect far from its ordinary size, a cause chosen too early."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from psa_casadi.components import BASE
from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.diagnosis.search.best_first import best_first
from psa_casadi.diagnosis.search.fits import (
    any_afresh,
    begun_again,
    to_end,
    with_cause,
    without,
)
from psa_casadi.diagnosis.search.hypothesis import hypothesis
from psa_casadi.diagnosis.search.steps import steps_of
from psa_casadi.diagnosis.search.view import View, examine
from psa_casadi.diagnosis.task import Task
from psa_casadi.effects import EFFECTS
from psa_casadi.identification.fitting.fit import fit
from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.identification.search import fit_base
from psa_casadi.identification.start.ordinary import starting_model
from psa_casadi.model.compose import compose
from psa_casadi.records.read.reading import read_record
from psa_casadi.records.record import Record
from psa_casadi.records.split import split, whole
from psa_casadi.simulation.simulate import simulate_record
from tests.plants.again import play_again
from tests.plants.base import simulate_base
from tests.plants.drive_lag import DRIVE_LAG
from tests.plants.excitations import draw_excitation
from tests.plants.make import make_record
from tests.plants.stack import draw_stack
from tests.tiers import slow

#: A fit to a piece of a measured record, whose causes hold each other.
_HELD = {
    "R_s": 7.87, "C_p": 1.6e-6, "u_rated": 3.6, "k_L": 1570.3, "A": -1180.6, "beta": 10.36,
    "gamma": -5.723, "delta": -29.26, "n": 1.0, "h_ref": 185.3, "hold_rate": 3.6e-3, "tau": 9.08e-3,
    "m_P": 5e-3, "c_P": 6.854e4, "k_P": 2.5e8, "m_B": 5e-3, "c_B": 5.089e5, "k_B": 5e7,
    "field_gain": 0.151, "load_gain": 0.138, "load_angle": 1.4774, "load_wave": 0.1229,
    "saturation_gain": 0.2,
}  # fmt: skip


@slow
def test_a_slow_amplifier_is_found(tmp_path: Path) -> None:
    """Of 7 ms, seventy times the ordinary lag, in a triangle and steps together."""
    path = tmp_path / "triangle.csv"
    truth = make_record("drive_lag", 11, path, excitation="triangle", gain=4e-3)
    time = np.linspace(0.0, 0.749, 750)
    steps = np.where((time // 0.15) % 2 == 1, 0.8, 0.2) * truth.stack.u_rated
    steps[:20] = 0.0
    play_again(truth, 11, tmp_path / "steps.csv", (time, steps))
    records = [read_record(path).slice(0, 900), read_record(tmp_path / "steps.csv")]
    found = diagnose(records, effects=[EFFECTS["drive_lag"], EFFECTS["backlash"]])
    assert [c.effect for c in found.causes] == ["drive_lag"]
    assert found.verdict == "cause_named"
    lag = found.causes[0].parameters["drive_lag_time"].value
    assert lag == pytest.approx(2.0 * truth.parameters["zeta"] * truth.gain, rel=0.02)
    assert found.extended_errors.holdout_rms_m < 1.05 * truth.sigma


@slow
def test_the_order_of_the_records_tells_nothing(tmp_path: Path) -> None:
    ends = (1000, 1000)  # their lengths tell nothing either
    truth = make_record("offset_drift", 3, tmp_path / "a.csv", excitation="triangle")
    play_again(truth, 4, tmp_path / "b.csv")
    pairs = zip(("a", "b"), ends, strict=True)
    records = [read_record(tmp_path / f"{n}.csv").slice(0, end) for n, end in pairs]
    effects = [EFFECTS["offset_drift"]]
    one, other = (diagnose(r, effects=effects) for r in (records, records[::-1]))
    for mine, yours in zip(one.experiments, other.experiments, strict=True):
        np.testing.assert_array_equal(measured(mine.record), measured(yours.record))
    assert one.extended_errors == other.extended_errors
    assert one.causes == other.causes


def _begun(record: Record, names: tuple[str, ...]) -> tuple[View, Task]:
    """The base fitted with these effects screened, and the task."""
    table = tuple(EFFECTS[n] for n in names)
    experiments = (split(record),)
    base = fit_base(starting_model([record], None), experiments)
    task = Task(experiments, table)
    plain = hypothesis((), base, experiments, final=True)
    assert plain is not None
    return examine(plain, task), task


@slow
def test_a_needless_cause_is_not_kept(tmp_path: Path) -> None:
    """A leaking charge and a creep look alike at first; one of them explains all of it."""
    make_record("charge_leakage", 5, tmp_path / "a.csv", visible=(1.0, 2.0))
    record = read_record(tmp_path / "a.csv").slice(0, 2500)
    seen, task = _begun(record, ("slow_creep", "charge_leakage"))
    found = best_first(seen.of.fit, task)
    assert found.best.names == {"charge_leakage"}
    both = found.known.get(frozenset({"slow_creep", "charge_leakage"}))
    assert both is None or found.scale.score(both) < found.scale.score(found.best)
    steps = steps_of(found, task)
    assert [s.cause.name for s in steps if s.chosen is not None] == ["charge_leakage"]
    assert steps[0].probability["charge_leakage"] > 0.9


@slow
def test_two_causes_are_found_whichever_of_their_like_leads(tmp_path: Path) -> None:
    """A spring that hardens looks like a lost preload while a mode still rings."""
    make_record(
        "load_stiffness", 31003, tmp_path / "a.csv", visible=(1.0, 3.0),
        more=("structural_mode",), more_visible=(1.0, 3.0),
    )  # fmt: skip
    record = read_record(tmp_path / "a.csv").slice(0, 3000)
    seen, task = _begun(record, ("preload_loss", "load_stiffness", "structural_mode"))
    found = best_first(seen.of.fit, task)
    assert found.best.names == {"load_stiffness", "structural_mode"}
    steps = steps_of(found, task)
    of_load = next(s for s in steps if s.chosen and s.cause.name == "load_stiffness")
    assert of_load.probability["load_stiffness"] > 0.9
    assert set(of_load.probability) <= {"preload_loss", "load_stiffness"}


@slow
def test_an_effect_that_the_bent_base_hides_is_found(tmp_path: Path) -> None:
    """Four effects lead the screening, none explains the data: an amplifier of 0.9 ms does."""
    path = tmp_path / "record.csv"
    truth = make_record("drive_lag", 52001, path, gain=9.171e-4)
    record = read_record(path)
    names = ("rate_dependent_hysteresis", "voltage_saturation", "preload_loss", "load_stiffness")
    found = diagnose([record], effects=[EFFECTS[n] for n in (*names, "drive_lag")])
    assert found.verdict == "cause_named"
    assert [c.effect for c in found.causes] == ["drive_lag"]
    seen, task = _begun(record, ("rate_dependent_hysteresis", "preload_loss", "drive_lag"))
    scores = list(seen.screening.best_by_effect().values())
    any_ = any_afresh(seen.of, task.experiments, scores)
    assert any_ is not None
    assert any_.names == {"drive_lag"}
    assert to_end(any_, task.experiments).fit.rms < 1.02 * truth.sigma


def test_a_cause_at_the_end_of_its_range_begins_again() -> None:
    """Half of the lag with one pole is a minimum; the lag with two is another one."""
    rng = np.random.default_rng(np.random.SeedSequence(961076).spawn(3)[0])
    stack = draw_stack(rng)
    run = simulate_base(stack, *draw_excitation(rng, "rich", stack.u_rated))
    lag, zeta = 4e-3, 0.93
    moved = run.displacement + DRIVE_LAG.contribution(run, {"zeta": zeta}, lag)
    read = moved + 2e-8 * rng.standard_normal(moved.size)
    record = Record(name="r", time=run.times, voltage=run.command, displacement=read)
    seen, task = _begun(record.slice(0, 3000), ("drive_lag",))
    first = with_cause(seen.of, task.experiments, seen.starts_of("drive_lag"))
    assert first is not None
    at_end = to_end(first, task.experiments)
    assert at_end.fit.model.values["drive_lag_shape"] < 2e-4
    again = begun_again(at_end, task.experiments)
    assert again is not None
    assert again.fit.model.values["drive_lag_time"] == pytest.approx(2.0 * zeta * lag, rel=0.01)
    assert again.fit.rms < 0.95 * at_end.fit.rms
    assert begun_again(again, task.experiments) is None


@slow
def test_each_form_of_an_effect_gets_a_start(tmp_path: Path) -> None:
    """Between its forms no fit moves."""
    make_record("rate_dependent_hysteresis", 303, tmp_path / "a.csv", visible=(0.3, 3.0))
    record = read_record(tmp_path / "a.csv").slice(0, 3000)
    name = "rate_dependent_hysteresis"
    seen, _ = _begun(record, (name, "slow_creep"))
    starts = seen.starts_of(name)
    assert {s.direction.values["rate_by_threshold"] for s in starts} == {0.0, 1.0}


@slow
def test_stuck_readings_that_the_misfit_hid_are_masked_once_the_cause_is_known(
    tmp_path: Path,
) -> None:
    """Seven standard deviations of the noise off, two of what a hum leaves of the base fit."""
    truth = make_record("mains_hum", 3, tmp_path / "a.csv", excitation="triangle", visible=3.0)
    given = read_record(tmp_path / "a.csv").slice(0, 1200)
    counts = 0.7 * truth.sigma
    y = counts * np.round(measured(given) / counts)
    moves = np.abs(np.diff(truth.displacement[:1200], prepend=0.0))
    stuck = []
    for k in range(100, 1100, 50):
        length = max(1, round(7.0 * truth.sigma / max(moves[k], 1e-12)))
        if length < 8:
            y[k : k + length] = y[k - 1]
            stuck.append(k + length - 1)
    assert len(stuck) > 10
    record = Record(name="a", time=given.time, voltage=given.voltage, displacement=y)
    found = diagnose([record], effects=[EFFECTS["mains_hum"]])
    used = found.experiments[0].record.mask
    assert [c.effect for c in found.causes] == ["mains_hum"]
    assert np.mean(used[stuck]) < 0.4
    assert np.mean(used) > 0.95
    assert "repeat the last one far from the model" in found.notes[-1]


def test_a_cause_that_others_hold_can_be_left_out() -> None:
    """A stiffening load that needs the saturation beside it has no rest without: it begins weaker.

    The values are those of a fit to a piece of a measured record.
    """
    causes = [
        EFFECTS[n] for n in ("field_dependent_gain", "load_stiffness", "saturation_of_strain")
    ]
    model = compose((*BASE, *causes), _HELD)
    t = np.arange(600) * np.float64(5e-3)
    record = Record(name="sine", time=t, voltage=1.8 + 1.8 * np.cos(2 * np.pi * t))
    moved = simulate_record(model, record).displacement
    experiments = [whole(replace(record, displacement=moved))]
    free = ["k_L", "field_gain", "load_gain", "saturation_gain"]
    rest = [{"f_H": -2084.8}]
    found = fit(model, experiments, free, sigma=[1e-8], start_states=rest, evaluations=2)
    with_all = hypothesis(causes, found, experiments)
    assert with_all is not None
    less = without(with_all, EFFECTS["saturation_of_strain"], experiments)
    assert less is not None
    assert less.names == {"field_dependent_gain", "load_stiffness"}
    assert less.fit.rms < 0.01 * np.ptp(moved)
