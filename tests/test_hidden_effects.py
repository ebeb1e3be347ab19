"""The hidden-effect suite: independent plants hide an effect, the public `diagnose` must find it.

The plants (`tests/plants/`) share no code and no equation form with the effects. Every case runs
`psa_casadi.diagnose` on the file that was written, and judges what a user would see.
"""

from pathlib import Path

import numpy as np
import pytest

import psa_casadi as psa
from tests.plants.make import Truth, make_record
from tests.plants.table import FOREIGN, KNOWN

SEEDS = range(5)
NAMING = ("cause_named", "partly_explained", "ambiguous")


def diagnose(effect: str | None, seed: int, folder: Path) -> tuple[psa.Diagnosis, Truth]:
    path = folder / "record.csv"
    truth = make_record(effect, seed, path)
    return psa.diagnose([psa.read_record(path)]), truth


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("effect", sorted(KNOWN))
def test_the_hidden_effect_is_named_and_the_gain_is_real(
    effect: str, seed: int, tmp_path: Path
) -> None:
    found, truth = diagnose(effect, seed, tmp_path)
    assert found.verdict in NAMING, found.remaining.where
    assert found.causes[0].effect == effect
    assert found.gain.holdout_rms_reduction_percent > 15
    assert found.extended_errors.holdout_rms_m < found.base_errors.holdout_rms_m
    assert found.noise_floor_rms_m == pytest.approx(truth.sigma, rel=0.2)
    # the clean displacement is known here: the extended model must be nearer to it than the base
    held = found.experiments[0].held_out
    errors = [np.std((y - truth.displacement)[held]) for y in (found.base[0], found.extended[0])]
    assert errors[1] < 0.8 * errors[0]


@pytest.mark.parametrize("seed", SEEDS)
def test_clean_data_leave_the_diagnosis_silent(seed: int, tmp_path: Path) -> None:
    found, truth = diagnose(None, seed, tmp_path)
    assert found.verdict == "adequate"
    assert found.causes == ()
    assert found.remaining.white
    assert found.base_errors.holdout_rms_m == pytest.approx(truth.sigma, rel=0.1)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("effect", sorted(FOREIGN))
def test_a_cause_that_is_not_in_the_table_is_not_named(
    effect: str, seed: int, tmp_path: Path
) -> None:
    found, _ = diagnose(effect, seed, tmp_path)
    assert found.verdict == "unexplained", [c.effect for c in found.causes]
    assert found.causes == ()
    assert not found.remaining.white
