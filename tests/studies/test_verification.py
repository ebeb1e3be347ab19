"""The benchmark `verification`: what it judges was not fitted, its figures are what they say."""

from pathlib import Path

import numpy as np
import pytest

from psa_casadi.model.stacks import STACKS
from psa_casadi.records import steps, time_grid
from tests.studies.benchmarks.verification import (
    FITTED_LOOPS,
    KEPT_LOOPS,
    LOOPS,
    NOISE,
    OTHER,
    STEPS,
    Comparison,
    Match,
    instrument,
    matches,
    plant_response,
    synthetic,
    verification_tables,
    with_single_mass,
)
from tests.tiers import slow

RATED = STACKS["P-885.51"].values["u_rated"].value

pytestmark = pytest.mark.xdist_group("verification")


def silent(_: str) -> None:
    """Progress that nobody reads."""


@pytest.fixture(scope="module")
def shown() -> list[Comparison]:
    return synthetic("P-885.51", silent)


@pytest.fixture(scope="module")
def ringing() -> list[Match]:
    values = {name: figure.value for name, figure in STACKS["PTBS200"].values.items()}
    return matches(values, silent, ("reciprocal",), starts=2)


def test_what_is_kept_was_not_fitted() -> None:
    assert not set(FITTED_LOOPS) & set(KEPT_LOOPS)
    assert not {f for _, f in FITTED_LOOPS} & {f for _, f in KEPT_LOOPS}
    assert not {share for share, _ in FITTED_LOOPS} & {share for share, _ in KEPT_LOOPS}


@slow
def test_a_stack_is_predicted_to_its_noise(shown: list[Comparison]) -> None:
    """Where the plant is the model, what is left on records never fitted is little but noise."""
    assert [c.kind for c in shown] == [LOOPS, LOOPS, STEPS, OTHER]
    for c in shown:
        noise = NOISE * np.ptp(c.measured)
        assert 0.9 * noise < c.rms < 1.3 * noise, c.record
        assert c.largest < (1.42e-2 if c.kind == STEPS else 2.65e-2) * c.range_m
        assert c.voltage[0] == 0.0
        assert c.voltage.min() >= 0.0
        assert c.voltage.max() <= RATED


@slow
def test_only_a_wrong_number_of_masses_shows_in_a_step(ringing: list[Match]) -> None:
    """Reciprocal data: a single mass misses, the one-way cascade fits almost as well."""
    largest = {m.model: np.abs(m.step).max() for m in ringing}
    assert largest["reciprocal"] < 2e-3
    assert largest["cascade"] < 2e-3
    assert largest["single_mass"] > 1e-2
    loads = {m.model: np.sqrt(np.mean(m.load**2)) for m in ringing}
    assert loads["reciprocal"] < 1e-3
    assert loads["single_mass"] > 3.0 * loads["reciprocal"]
    assert all(m.load[-1] == 0.0 for m in ringing)
    assert next(m.mass for m in ringing if m.model == "single_mass") < 0.8


def test_the_three_plants_are_three() -> None:
    """One stiffness to a voltage or to a load for each: series, or the wafers' or the layers'."""
    p = with_single_mass({n: f.value for n, f in STACKS["WYDS0808020"].values.items()})
    time = time_grid(4.8e-3, 4e-6)
    volt, push = (steps(time, [0.0] + 1199 * [top]) for top in (50.0, 100.0))
    force, none = p["k_L"] * 50.0, np.zeros_like(time)
    soft = {"cascade": p["k"], "reciprocal": p["k_P"], "single_mass": p["k"]}
    hard = {"cascade": p["k_B"], "reciprocal": p["k"], "single_mass": p["k"]}
    for plant, stiffness in soft.items():
        x = plant_response(plant, p, time, volt, none)[-1]
        assert x == pytest.approx(force / stiffness, rel=1e-4), plant
        y = plant_response(plant, p, time, none, push)[-1]
        assert y == pytest.approx(100.0 / hard[plant], rel=1e-4), plant


@slow
def test_the_micromanipulator_is_judged_on_what_was_kept(
    measured_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PSA_CASADI_DATA", str(measured_data))
    sine, minor = instrument(silent)
    assert 0.15 < np.isfinite(sine.measured).mean() < 0.35
    assert np.isnan(minor.measured[: len(minor.time) // 10]).all()
    assert 100.0 * sine.rms / sine.range_m < 0.5
    assert 100.0 * minor.largest / minor.range_m < 6.0
    note = verification_tables([sine, minor])[0].note
    assert "measured (Y. N. Aye)" in note


def test_without_the_measured_records_their_rows_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PSA_CASADI_DATA", str(tmp_path))
    assert instrument(silent) == []
