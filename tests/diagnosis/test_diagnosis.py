"""The parts of a diagnosis: noise colour, omnibus, drive harmonics, choice, blind spots, JSON."""

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.held_out import Compared
from psa_casadi.records.drive import is_tone_separable
from psa_casadi.records.record import Record
from psa_casadi.records.split import Experiment
from tests.studies.plants.make import make_record

N = 4000


def grid(step: float) -> FloatArray:
    return np.linspace(0.0, (N - 1) * step, N)


def test_a_mains_line_between_the_harmonics_of_a_drive_is_told_from_them() -> None:
    time = np.linspace(0.0, 4.999, 5000)
    triangle, fifth = (
        Record(name="triangle", time=time, voltage=np.arcsin(np.sin(2.0 * np.pi * f * time)))
        for f in (4.0, 5.0)
    )
    assert is_tone_separable(49.97, triangle, hum=True)
    assert not is_tone_separable(49.97, triangle, hum=False)
    assert not is_tone_separable(47.0, triangle, hum=True)
    assert not is_tone_separable(49.97, fifth, hum=True)  # the drive's tenth harmonic
    assert is_tone_separable(60.02, triangle, hum=False)  # above its twelfth
    noise = Record(name="noise", time=time, voltage=np.random.default_rng(0).standard_normal(5000))
    assert is_tone_separable(60.02, noise, hum=False)


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
    gain = Compared([experiment], [base], [truth]).gain
    assert gain.holdout_rms_reduction_percent == pytest.approx(90, abs=1.5)
    assert gain.interval[0] < gain.holdout_rms_reduction_percent < gain.interval[1]
    assert gain.held_out_records == 0
    assert Compared([experiment] * 4, [base] * 4, [truth] * 4).gain.held_out_records == 4


def test_what_the_other_parts_lose_is_counted_without_the_one_that_gains_most() -> None:
    """Eight parts of 125: one falls from 10 to 1, the others rise by a tenth or stay."""
    time = grid(1e-3)
    record = Record(name="r", time=time, voltage=time, displacement=np.zeros(N))
    held = np.arange(N) >= N - 1000
    experiment = Experiment(record, ~held, held)
    first = np.arange(N) < N - 1000 + 125
    base, after = np.where(first, 10.0, 1.0), np.where(first, 1.0, 1.1)
    lost = Compared([experiment], [base], [after]).lost_elsewhere(2.0)
    assert lost == pytest.approx(875 / 2.0 * np.log(1.1))
    none = Compared([experiment], [base], [np.ones(N)]).lost_elsewhere(2.0)
    assert none == pytest.approx(0.0, abs=1e-9)


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
    result = psa.diagnose([Record(name="slow", time=time, voltage=voltage, displacement=noisy)])
    assert record.n > 0
    assert "sensor_delay" in {b.effect for b in result.blind_to}
    assert result.verdict in ("adequate", "ambiguous")
