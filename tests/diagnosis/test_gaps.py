"""A gap in time hides what the voltage did: the parts before and after it are records."""

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.records.split import gaps, without_gaps
from tests.studies.plants.base import simulate_base
from tests.studies.plants.excitations import loops
from tests.studies.plants.stack import draw_stack

T = np.arange(900) / 200.0


@pytest.fixture(scope="module")
def whole() -> psa.Record:
    """Loops of an independent plant without a hidden effect."""
    rng = np.random.default_rng(3)
    stack = draw_stack(rng)
    voltage = np.round(0.95 * stack.u_rated * np.concatenate([np.zeros(10), loops(rng, 890)]), 3)
    y = simulate_base(stack, T, voltage).displacement
    noise = 2e-4 * np.ptp(y) * rng.standard_normal(y.size)
    return psa.Record(name="r", time=T, voltage=voltage, displacement=y + noise)


def without(record: psa.Record, *ranges: tuple[int, int]) -> psa.Record:
    kept = np.ones(record.n, dtype=bool)
    for a, b in ranges:
        kept[a:b] = False
    assert record.displacement is not None
    return psa.Record(
        name="r", time=record.time[kept], voltage=record.voltage[kept],
        displacement=record.displacement[kept],
    )  # fmt: skip


def test_what_happened_in_a_gap_is_no_cause(whole: psa.Record) -> None:
    record = without(whole, (300, 500))
    result = psa.diagnose([record], effects=[psa.EFFECTS["rate_dependent_hysteresis"]])
    assert result.verdict == "adequate"
    assert {e.record.name for e in result.experiments} == {"r[0:300]", "r[300:700]"}
    assert "r: no sample for 1.005 s from 1.495 s on, while the voltage moves" in result.notes[-1]


def record(time: FloatArray, voltage: FloatArray) -> psa.Record:
    return psa.Record(name="r", time=time, voltage=voltage, displacement=1e-6 * voltage)


SINE = 50.0 * np.sin(2.0 * np.pi * T)
RAMP = 10.0 * T
NO_GAP: dict[str, psa.Record] = {
    "even": record(T, SINE),
    "logarithmic": record(np.geomspace(1e-3, 1e3, 900), SINE),
    "slower from the middle on": record(np.r_[T[:450], T[450] + 100.0 * T[:450]], SINE),
    "pairs of samples": record(np.sort(np.r_[T, T + 1e-5]), np.repeat(SINE, 2)),
    "held meanwhile": record(np.r_[T[:450], T[450:] + 60.0], np.where(T < 1.0, SINE, SINE[200])),
    "one slope": record(np.r_[T[:450], T[450:] + 60.0], np.r_[RAMP[:450], RAMP[450:] + 600.0]),
    "a few lost samples": without(record(T, SINE), (100, 105), (300, 303)),
    "at the end": without(record(T, SINE), (500, 890)),
}


@pytest.mark.parametrize("case", NO_GAP)
def test_what_is_no_gap(case: str) -> None:
    assert gaps(NO_GAP[case]) == ()
    parts, statement = without_gaps([NO_GAP[case]])
    assert parts == [NO_GAP[case]]
    assert not statement
