"""The parts of a diagnosis: noise colour, omnibus, drive harmonics, choice, blind spots, JSON."""

from collections.abc import Callable

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.diagnosis.colour import colour_of, omnibus
from psa_casadi.diagnosis.held_out import gain_of, lost_elsewhere
from psa_casadi.records.drive import tells_tone
from psa_casadi.records.record import Record
from psa_casadi.records.split import Experiment
from psa_casadi.units import FloatArray
from tests.studies.plants.make import make_record
from tests.tiers import slow, slow_but

N = 4000


def grid(step: float) -> FloatArray:
    return np.linspace(0.0, (N - 1) * step, N)


def ar1(correlation: float, rng: np.random.Generator) -> FloatArray:
    white = rng.standard_normal(N)
    out = np.zeros(N)
    for k in range(1, N):
        out[k] = correlation * out[k - 1] + white[k]
    return out


def _test(residual: FloatArray) -> float:
    time = grid(1e-3)
    voltage = 50 * (1 - np.cos(2 * np.pi * time))
    colour = colour_of(residual, [N])
    return omnibus(residual, voltage, time, colour, 1.0, knowable=0.0, even=False).p_value


@pytest.mark.parametrize("correlation", [0.0, 0.7])
def test_omnibus_is_quiet_on_noise(correlation: float) -> None:
    values = [_test(ar1(correlation, np.random.default_rng(s))) for s in range(20)]
    assert min(values) > 1e-4
    assert np.median(values) > 0.1


@pytest.mark.parametrize(
    "structure",
    [
        lambda t: 0.3 * np.sin(2 * np.pi * 57.9 * t),
        lambda t: 0.5 * t / t[-1],
        lambda t: 0.3 * np.cos(2 * np.pi * t) ** 2,
    ],
    ids=["tone", "drift", "function of voltage"],
)
def test_omnibus_sees_structure(structure: Callable[[FloatArray], FloatArray]) -> None:
    time = grid(1e-3)
    assert _test(np.random.default_rng(1).standard_normal(N) + structure(time)) < 1e-3


def test_a_mains_line_between_the_harmonics_of_a_drive_is_told_from_them() -> None:
    time = np.linspace(0.0, 4.999, 5000)
    triangle, fifth = (
        Record(name="triangle", time=time, voltage=np.arcsin(np.sin(2.0 * np.pi * f * time)))
        for f in (4.0, 5.0)
    )
    assert tells_tone(49.97, triangle, hum=True)
    assert not tells_tone(49.97, triangle, hum=False)
    assert not tells_tone(47.0, triangle, hum=True)
    assert not tells_tone(49.97, fifth, hum=True)  # the drive's tenth harmonic
    assert tells_tone(60.02, triangle, hum=False)  # above its twelfth
    noise = Record(name="noise", time=time, voltage=np.random.default_rng(0).standard_normal(5000))
    assert tells_tone(60.02, noise, hum=False)


@slow
@pytest.mark.parametrize("hum", slow_but([49.97], [49.97, 47.0]))
def test_a_hum_between_the_harmonics_of_a_periodic_drive_is_named(hum: float) -> None:
    """47 Hz is nobody's mains, and may be distortion of the drive."""
    time = np.linspace(0.0, 4.998, 2500)
    voltage = 50.0 + 50.0 * np.interp(time, [0, 5], [0.4, 1.0]) * np.sin(2 * np.pi * 4.0 * time)
    stack = psa.stack_model("P-885.51")
    still = psa.simulate(stack, time, voltage).outputs["displacement"]
    rng = np.random.default_rng(3)
    noise = 2e-3 * np.ptp(still) * rng.standard_normal(time.size)
    line = 3e-3 * np.ptp(still) * np.sin(2.0 * np.pi * hum * time + 0.7)
    record = Record(name="hum", time=time, voltage=voltage, displacement=still + noise + line)
    effects = [psa.EFFECTS["mains_hum"], psa.EFFECTS["slow_creep"], psa.EFFECTS["structural_mode"]]
    found = psa.diagnose([record], effects=effects)
    assert [c.effect for c in found.causes] == (["mains_hum"] if hum > 48.0 else [])


def test_gain_is_the_reduction_of_the_held_out_rms() -> None:
    time = grid(1e-3)
    rng = np.random.default_rng(5)
    truth = np.sin(2 * np.pi * time)
    held = np.arange(N) >= 3000
    record = Record(
        name="r", time=time, voltage=truth, displacement=truth + 0.01 * rng.standard_normal(N)
    )
    experiment = Experiment(record, ~held, held)
    base = truth + 0.1 * rng.standard_normal(N)
    gain = gain_of([experiment], [base], [truth])
    assert gain.holdout_rms_reduction_percent == pytest.approx(90, abs=1.5)
    assert gain.interval[0] < gain.holdout_rms_reduction_percent < gain.interval[1]
    assert gain.held_out_records == 0
    assert gain_of([experiment] * 4, [base] * 4, [truth] * 4).held_out_records == 4


def test_what_the_other_parts_lose_is_counted_without_the_one_that_gains_most() -> None:
    """Eight parts of 125: one falls from 10 to 1, the others rise by a tenth or stay."""
    time = grid(1e-3)
    record = Record(name="r", time=time, voltage=time, displacement=np.zeros(N))
    held = np.arange(N) >= N - 1000
    experiment = Experiment(record, ~held, held)
    first = np.arange(N) < N - 1000 + 125
    base, after = np.where(first, 10.0, 1.0), np.where(first, 1.0, 1.1)
    lost = lost_elsewhere([experiment], [base], [after], 2.0)
    assert lost == pytest.approx(875 / 2.0 * np.log(1.1))
    assert lost_elsewhere([experiment], [base], [np.ones(N)], 2.0) == pytest.approx(0.0, abs=1e-9)


def test_a_single_slow_triangle_is_said_to_be_blind_to_fast_effects(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    path = tmp_path_factory.mktemp("blind") / "r.csv"
    truth = make_record(None, 3, path)
    record = psa.read_record(path)
    time = np.linspace(0.0, 1499 * 0.02, 1500)
    voltage = 40 * (1 - np.abs(1 - (time / 15) % 2))
    slow = psa.simulate(psa.stack_model("demo"), time, voltage).displacement
    noisy = slow + truth.sigma * np.random.default_rng(0).standard_normal(len(slow))
    found = psa.diagnose([Record(name="slow", time=time, voltage=voltage, displacement=noisy)])
    assert record.n > 0
    assert "sensor_delay" in {b.effect for b in found.blind_to}
    assert found.verdict in ("adequate", "ambiguous")
