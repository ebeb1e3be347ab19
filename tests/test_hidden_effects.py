"""The hidden-effect suite: independent plants hide a cause, the public `diagnose` must find it.

The plants (`tests/plants/`) share no code and no equation form with the effects. Every case runs
`psa_casadi.diagnose` on the file that was written, and judges what a user would see. Here every
effect that no other test finds has one record, and fresh seeds a few more; the benchmark `diagnose`
is the full study. The quick tier has a clean record here.
"""

import secrets
from pathlib import Path

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.diagnosis.task import Method
from psa_casadi.units import FloatArray
from tests.benchmarks.hidden_cases import Case, Found, records_of, run_case
from tests.plants.make import Truth, make_record
from tests.plants.table import KNOWN, called
from tests.tiers import slow, slow_but

NAMING = ("cause_named", "partly_explained", "ambiguous")
#: The seed of every effect's record, and its samples: half of the whole one, which names the effect
#: as well (tried with two seeds each) in half the time.
SEED, SAMPLES = 1, 3000
#: Lags that a slow record hardly tells apart.
LAGS = {"drive_lag", "sensor_lag", "sensor_delay"}
#: Their size here [s]: the base takes over most of it.
LAG = 2.1e-3
#: Share of the noise below which nothing of an effect is left beside the base.
HARDLY = 0.1
#: Effects that another test hides and names, by the file of that test.
ELSEWHERE = {
    "charge_leakage": "test_lost_fits", "current_limit": "test_generalisation",
    "drive_lag": "test_lost_fits", "field_dependent_gain": "test_next_experiment",
    "hysteresis_memory": "test_measured_rows", "load_stiffness": "test_lost_fits",
    "mains_hum": "test_lost_fits", "offset_drift": "test_lost_fits", "preload_loss": "test_alike",
    "saturation_of_strain": "test_further_columns", "self_heating": "test_hidden_effects",
    "sensor_delay": "test_base_resonances", "sensor_nonlinearity": "test_further_columns",
    "slow_creep": "test_cli", "structural_mode": "test_hidden_effects",
    "temperature": "test_hidden_effects",
}  # fmt: skip
#: Foreign causes of which one is tried here for each verdict: the benchmark `diagnose` has all.
TRIED = ("floor_vibration", "dry_friction")
#: Three causes, and what looks like one of them.
LIKE_THREE = ("temperature", "self_heating", "structural_mode", "slow_creep", "drive_lag",
              "hysteresis_memory", "ageing")  # fmt: skip
#: Fresh records in every run: so many, and twice as many where one of them misleads.
FRESH = 2


def diagnose(
    effect: str | None, seed: int, folder: Path, gain: float | None = None
) -> tuple[psa.Diagnosis, Truth]:
    path = folder / "record.csv"
    truth = make_record(effect, seed, path, gain=gain)
    return psa.diagnose([psa.read_record(path).slice(0, SAMPLES)]), truth


def within(found: psa.Diagnosis) -> set[str]:
    """Return the causes named, with what they cannot be told from."""
    return {n for c in found.causes for n in (c.effect, *c.cannot_be_told_from)}


@slow
@pytest.mark.parametrize("effect", sorted({*KNOWN} - LAGS - {*ELSEWHERE}))
def test_the_hidden_effect_is_named_and_the_gain_is_real(effect: str, tmp_path: Path) -> None:
    found, truth = diagnose(effect, SEED, tmp_path)
    assert found.verdict in NAMING, found.remaining.where
    assert called(effect) in within(found)
    assert found.extended_errors.holdout_rms_m < found.base_errors.holdout_rms_m
    assert found.noise_floor_rms_m == pytest.approx(truth.sigma, rel=0.2)
    # the clean displacement is known here: the extended model must be nearer to it than the base
    errors = [_missed(found, truth, y) for y in (found.base[0], found.extended[0])]
    assert errors[1] < 0.8 * errors[0]


def _missed(found: psa.Diagnosis, truth: Truth, y: FloatArray) -> float:
    """Return the rms by which a prediction misses the clean displacement, held out [m]."""
    return float(np.std((y - truth.displacement[:SAMPLES])[found.experiments[0].held_out]))


@slow
@pytest.mark.parametrize("effect", sorted(LAGS - {*ELSEWHERE}))
def test_a_lag_is_named_as_a_lag(effect: str, tmp_path: Path) -> None:
    found, truth = diagnose(effect, SEED, tmp_path, gain=LAG)
    if found.verdict == "adequate":  # the base's own lags and masses have taken it over
        assert _missed(found, truth, found.base[0]) < HARDLY * truth.sigma
        return
    assert found.causes
    assert found.causes[0].effect in LAGS
    assert found.extended_errors.holdout_rms_m < found.base_errors.holdout_rms_m


@pytest.mark.parametrize("seed", slow_but([0], range(2)))
def test_clean_data_leave_the_diagnosis_silent(seed: int, tmp_path: Path) -> None:
    found, truth = diagnose(None, seed, tmp_path)
    assert found.verdict == "adequate"
    assert found.causes == ()
    assert found.remaining.white
    assert found.base_errors.holdout_rms_m == pytest.approx(truth.sigma, rel=0.1)


@slow
def test_three_causes_are_found_where_one_by_one_ends_with_two(tmp_path: Path) -> None:
    other = ("self_heating", "structural_mode")
    case = Case("three", "temperature", 205877, (1.0, 3.0), other)
    truth, records = records_of(case, tmp_path)
    few = [psa.EFFECTS[n] for n in LIKE_THREE]
    found = psa.diagnose(records, effects=few)
    assert {c.effect for c in found.causes} == set(case.hidden)
    assert found.extended_errors.holdout_rms_m < 1.05 * truth.sigma
    method = Method(frozenset({"several at once"}))
    one_by_one = psa.diagnose(records, effects=few, method=method)
    assert one_by_one.extended_errors.holdout_rms_m > 1.1 * truth.sigma
    assert {c.effect for c in one_by_one.causes} < set(case.hidden)


@slow
@pytest.mark.parametrize("effect", TRIED)
def test_a_cause_that_is_not_in_the_table_is_not_named_alone(effect: str, tmp_path: Path) -> None:
    found, _ = diagnose(effect, SEED, tmp_path)
    if effect == "dry_friction" and found.causes:
        # friction holds back over a fixed width after every reversal, which is what backlash does
        assert within(found) == {"backlash"}
        return
    assert found.verdict in ("unexplained", "partly_explained", "ambiguous"), within(found)
    assert not found.remaining.white or found.verdict == "ambiguous"


@slow
def test_fresh_records_every_time() -> None:
    """Seeds are drawn anew and printed: none of two may mislead, or at most one of four."""
    seeds = [secrets.randbelow(10**6) for _ in range(2 * FRESH)]
    draw = np.random.default_rng(seeds[0])
    cases = [Case("known", str(draw.choice(KNOWN)), s, (1.0, 3.0)) for s in seeds]
    found = [_told(case) for case in cases[:FRESH]]
    if not all(map(_right, found)):
        found += [_told(case) for case in cases[FRESH:]]
    assert sum(not _right(f) for f in found) <= 1


def _told(case: Case) -> Found:
    found = run_case(case)
    print(found.case, found.rho, found.verdict, found.within)
    return found


def _right(f: Found) -> bool:
    """Whether no other cause is named alone, and the hidden one is named if it shows."""
    return f.alone in (None, f.case.right) and (f.case.right in f.within or f.rho < 0.9)
