"""Fits that lose themselves: an effect far from its ordinary size, a cause chosen too early."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.diagnosis.noise.colour import excess_power
from psa_casadi.diagnosis.search.backward import reconsidered
from psa_casadi.diagnosis.search.extension import extend, extend_any, polish
from psa_casadi.diagnosis.search.rounds import Round, examine, settle_on
from psa_casadi.diagnosis.search.selection import WORTHWHILE, choose, starts_of
from psa_casadi.diagnosis.task import Task
from psa_casadi.effects import EFFECTS
from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.identification.search.multistart import fit_base
from psa_casadi.identification.start.ordinary import starting_model
from psa_casadi.records.read.reading import read_record
from psa_casadi.records.record import Record
from psa_casadi.records.split import split
from tests.plants.again import play_again
from tests.plants.make import make_record
from tests.tiers import slow


@slow
def test_a_slow_amplifier_is_found(tmp_path: Path) -> None:
    """Of 7 ms, seventy times the ordinary lag, in a triangle and steps together."""
    path = tmp_path / "triangle.csv"
    truth = make_record("drive_lag", 11, path, excitation="triangle", visible=(1.0, 2.0))
    time = np.linspace(0.0, 1.499, 1500)
    steps = np.where((time // 0.15) % 2 == 1, 0.8, 0.2) * truth.stack.u_rated
    steps[:20] = 0.0
    play_again(truth, 11, tmp_path / "steps.csv", (time, steps))
    records = [read_record(path).slice(0, 1500), read_record(tmp_path / "steps.csv")]
    found = diagnose(records, effects=[EFFECTS["drive_lag"], EFFECTS["backlash"]])
    assert [c.effect for c in found.causes] == ["drive_lag"]
    assert found.verdict == "cause_named"
    lag = found.causes[0].parameters["drive_lag_time"].value
    assert lag == pytest.approx(2.0 * truth.parameters["zeta"] * truth.gain, rel=0.02)
    assert found.extended_errors.holdout_rms_m < 1.05 * truth.sigma


@slow
@pytest.mark.parametrize("ends", [(900, 1200), (1000, 1000)], ids=["lengths", "alike"])
def test_the_order_of_the_records_tells_nothing(ends: tuple[int, int], tmp_path: Path) -> None:
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


def _begun(record: Record, names: tuple[str, ...]) -> tuple[list[Round], Task]:
    """A first round, with the base fitted and these effects screened, and its task."""
    table = tuple(EFFECTS[n] for n in names)
    experiments = (split(record),)
    base = fit_base(starting_model([record], None), experiments)
    task = Task(experiments, table)
    rounds = [examine(base, tuple(base.predicted(experiments)), task)]
    return rounds, task


def _forced(rounds: list[Round], task: Task, name: str) -> None:
    current = rounds[-1]
    colour = current.screening.colour
    found = extend(current.fit, task.experiments, starts_of(current.screening, name), colour)
    assert found is not None
    first = rounds[0].chosen if len(rounds) > 1 else None
    settle_on(current, polish(current.fit, found, task.experiments, colour), task, first)
    assert current.chosen is not None
    rounds.append(examine(current.chosen.fit, current.chosen.predicted, task, current.trials))


def _causes(rounds: list[Round]) -> list[str]:
    return [r.chosen.effect.name for r in rounds if r.chosen is not None]


def test_a_needless_first_cause_leaves_the_second_as_good(tmp_path: Path) -> None:
    """What stays has the fit that both together reached, and the probabilities of its own."""
    make_record("charge_leakage", 5, tmp_path / "a.csv", visible=(1.0, 2.0))
    record = read_record(tmp_path / "a.csv").slice(0, 2500)
    rounds, task = _begun(record, ("slow_creep", "charge_leakage"))
    for name in ("slow_creep", "charge_leakage"):
        _forced(rounds, task, name)
    both = rounds[-1].fit.rms
    left = reconsidered([replace(r) for r in rounds], task)
    assert _causes(left) == ["charge_leakage"]
    assert left[-1].fit.rms < 1.01 * both
    assert left[0].probability["charge_leakage"] > 0.9


@slow
def test_a_wrong_first_cause_gives_way_beside_the_second(tmp_path: Path) -> None:
    """A spring that hardens, taken for a lost preload while a mode still rang."""
    make_record(
        "load_stiffness", 31003, tmp_path / "a.csv", visible=(1.0, 3.0),
        second="structural_mode", second_visible=(1.0, 3.0),
    )  # fmt: skip
    record = read_record(tmp_path / "a.csv").slice(0, 3000)
    rounds, task = _begun(record, ("preload_loss", "load_stiffness", "structural_mode"))
    for name in ("preload_loss", "structural_mode"):
        _forced(rounds, task, name)
    _also(rounds[0], task, "load_stiffness")
    again = reconsidered(rounds, task)
    assert _causes(again) == ["load_stiffness", "structural_mode"]
    assert again[-1].fit.rms < 0.9 * rounds[-1].fit.rms
    assert again[0].probability["load_stiffness"] > 0.9


def _also(step: Round, task: Task, name: str) -> None:
    """Fit a further effect in a step, as a search would have."""
    colour = step.screening.colour
    found = extend(step.fit, task.experiments, starts_of(step.screening, name), colour)
    assert found is not None
    step.extensions.append(polish(step.fit, found, task.experiments, colour))
    step.evidence = {**step.evidence, name: step.extensions[-1].evidence}


@slow
def test_an_effect_that_the_bent_base_hides_is_found(tmp_path: Path) -> None:
    """Four effects lead the screening, none explains the data: an amplifier of 0.9 ms does."""
    path = tmp_path / "record.csv"
    truth = make_record("drive_lag", 52001, path, visible=(0.3, 3.0))
    record = read_record(path)
    names = ("rate_dependent_hysteresis", "voltage_saturation", "preload_loss", "load_stiffness")
    found = diagnose([record], effects=[EFFECTS[n] for n in (*names, "drive_lag")])
    assert found.verdict == "cause_named"
    assert [c.effect for c in found.causes] == ["drive_lag"]
    rounds, task = _begun(record, ("rate_dependent_hysteresis", "preload_loss", "drive_lag"))
    screening = rounds[0].screening
    scores = list(screening.best_by_effect().values())
    any_ = extend_any(rounds[0].fit, task.experiments, scores, screening.colour)
    assert any_ is not None
    assert any_.effect.name == "drive_lag"
    ended = polish(rounds[0].fit, any_, task.experiments, screening.colour)
    assert ended.fit.rms < 1.02 * truth.sigma


def test_each_form_of_an_effect_gets_a_start_and_near_ones_stay_rivals(tmp_path: Path) -> None:
    """Between its forms no fit moves; a threshold of worth does not cut rivals from each other."""
    make_record("rate_dependent_hysteresis", 303, tmp_path / "a.csv", visible=(0.3, 3.0))
    record = read_record(tmp_path / "a.csv").slice(0, 3000)
    name = "rate_dependent_hysteresis"
    rounds, task = _begun(record, (name, "slow_creep"))
    current = rounds[0]
    starts = starts_of(current.screening, name)
    assert {s.direction.values["rate_by_threshold"] for s in starts} == {0.0, 1.0}
    colour = current.screening.colour
    one = extend(current.fit, task.experiments, starts, colour)
    assert one is not None
    excess = excess_power(current.fit.residuals, colour)
    best = replace(one, removed=1.01 * WORTHWHILE * excess)

    def chosen(share: float) -> list[str]:
        other = replace(best.effect, name="another")
        rival = replace(best, effect=other, removed=share * best.removed)
        given = (task.experiments, current.fit, current.predicted, colour, None)
        return [e.effect.name for e in choose([best, rival], *given, alarm=True, knowable=0.0)]

    assert set(chosen(0.98)) == {name, "another"}
    assert chosen(0.5) == [name]


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
    record = Record("a", given.time, given.voltage, y)
    found = diagnose([record], effects=[EFFECTS["mains_hum"]])
    used = found.experiments[0].record.mask
    assert [c.effect for c in found.causes] == ["mains_hum"]
    assert np.mean(used[stuck]) < 0.4
    assert np.mean(used) > 0.95
    assert "repeat the last one far from the model" in found.notes[-1]
