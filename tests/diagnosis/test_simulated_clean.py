"""The package's own simulations are adequate: nothing is missing, and nothing is said to be."""

import numpy as np
import pytest

from psa_casadi.diagnosis.noise import knowable, known_colour, noise_floor
from psa_casadi.diagnosis.task import LIMITS
from psa_casadi.records.noise import last_place_of
from tests.studies.benchmarks.simulated import Case, all_cases, judged, record_of
from tests.tiers import slow

QUICK = (
    Case("P-885.51", "sine", "none"),
    Case("demo", "triangle", "1e-4"),
    Case("WYDS0808020", "sine", "1 nm"),
)


@pytest.mark.parametrize(
    "case",
    [*QUICK, *(pytest.param(c, marks=slow) for c in all_cases()[::6] if c not in QUICK)],
    ids=lambda c: f"{c.stack} {c.voltage} {c.noise}",
)
def test_what_the_package_simulates_is_adequate(case: Case) -> None:
    said = judged(case)
    assert (said.verdict, said.named, said.failure) == ("adequate", (), "")


@pytest.mark.parametrize("step", [1e-6, 1e-9, 1e-10])
def test_the_last_place_of_a_file_is_seen(step: float) -> None:
    x = 1e-5 * np.sin(np.linspace(0.0, 20.0, 3000))
    assert last_place_of(step * np.round(x / step)) == pytest.approx(step)
    assert last_place_of(x) == 0.0
    assert last_place_of(np.zeros(10)) == 0.0


def test_what_can_be_known_holds_rounding_error_and_form() -> None:
    record = record_of(Case("P-885.51", "sine", "1 nm"))
    whole = float(np.ptp(record.displacement)) if record.displacement is not None else np.nan
    rounding, error = 1e-9 / np.sqrt(12.0), 2e-10
    rest = float(np.hypot(error, LIMITS.form_of_range * whole))
    signs = np.where(np.arange(record.n) % 2, 1.0, -1.0)
    small, large = rounding * signs, 2.0 * rounding * signs
    assert knowable(record, error, small) == pytest.approx(float(np.hypot(rest, rounding)))
    assert knowable(record, error, large) == pytest.approx(rest)  # noise has made it white


def test_what_a_first_loop_leaves_behind_is_no_noise() -> None:
    """Repeats of a triangle that begins at rest differ by the first loop and by creep."""
    record = record_of(Case("demo", "triangle", "1e-4"))
    assert record.displacement is not None
    level = 1e-4 * float(np.ptp(record.displacement))
    residual = level * np.random.default_rng(0).standard_normal(record.n)
    (by_repeats,) = noise_floor([record], [100.0 * residual])
    assert by_repeats.source == "repeats"
    assert by_repeats.level > 1.5 * level
    (floor,) = noise_floor([record], [residual])
    assert floor.source == "fast part"
    assert floor.level == pytest.approx(level, rel=0.1)
    assert known_colour(record, residual) is None
    assert known_colour(record, 100.0 * residual) is not None
