"""Two clocks that are not synchronous: read off a residual, named, and absent from clean data."""

from dataclasses import replace

import numpy as np
import pytest

from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.diagnosis.screening.beats import beat_of
from psa_casadi.effects import EFFECTS
from psa_casadi.records.record import Record
from psa_casadi.units import FloatArray
from tests.plants.base import Run, simulate_base
from tests.plants.stack import draw_stack
from tests.plants.two_clocks import held
from tests.tiers import slow

TABLE = [
    EFFECTS[n]
    for n in ("unsynchronised_sampling", "sensor_delay", "offset_drift", "sensor_jump", "ageing")
]
#: Sampling time [s], samples, renewals in one of them, and loops in the record.
STEP, SAMPLES, RENEWALS, LOOPS = 5e-3, 3000, 4, 24


@pytest.fixture(scope="module")
def run() -> Run:
    rng = np.random.default_rng(11)
    stack, time = draw_stack(rng), np.arange(SAMPLES, dtype=float) * STEP
    turn = 2.0 * np.pi * LOOPS * np.arange(SAMPLES) / SAMPLES
    size = 0.45 - 0.2 * np.arange(SAMPLES) / SAMPLES
    voltage = np.round(stack.u_rated * size * (1.0 - np.cos(turn)), 3).astype(float)
    return simulate_base(stack, time, voltage)


def noise(run: Run, share: float) -> FloatArray:
    return share * np.ptp(run.displacement) * np.random.default_rng(5).standard_normal(SAMPLES)


@pytest.mark.parametrize("beats", [-3.3, -1.4, 1.6, 2.7])
def test_the_beat_is_read_off_the_residual(run: Run, beats: float) -> None:
    """Age, rate and phase, under noise twice what the clocks add."""
    reading = held(run, RENEWALS, beats / SAMPLES / RENEWALS, 0.3)
    added = reading - run.displacement
    err = noise(run, 2.0 * float(np.std(added) / np.ptp(run.displacement)))
    beat = beat_of(run.times, run.displacement, added + err)
    assert beat is not None
    assert beat.rate * run.times[-1] == pytest.approx(beats, abs=0.15)
    assert beat.age == pytest.approx(STEP / RENEWALS, rel=0.15)
    late = beat.age * ((beat.phase + beat.rate * run.times) % 1.0)
    told = -late * np.gradient(run.displacement, run.times)
    assert np.std(told - added) < 0.4 * np.std(added)


def test_no_beat_is_read_off_noise_delay_or_trend(run: Run) -> None:
    rate = np.gradient(run.displacement, run.times)
    along = run.times / run.times[-1]
    err = noise(run, 3e-3)
    for residual in (err, err - 1e-3 * rate, err - 2e-3 * along * rate, err + 1e-7 * along):
        assert beat_of(run.times, run.displacement, residual) is None
    assert beat_of(run.times, np.zeros(SAMPLES), err) is None
    assert beat_of(run.times[:100], run.displacement[:100], err[:100]) is None


@slow
def test_two_clocks_are_named(run: Run) -> None:
    reading = held(run, RENEWALS, -2.4 / SAMPLES / RENEWALS, 0.6)
    added = float(np.std(reading - run.displacement))
    sigma = 1.2 * added
    reading = reading + noise(run, sigma / float(np.ptp(run.displacement)))
    record = Record(name="r", time=run.times, voltage=run.command, displacement=reading)
    found = diagnose([record], effects=TABLE)
    assert [c.effect for c in found.causes] == ["unsynchronised_sampling"]
    assert found.causes[0].cannot_be_told_from == ()
    low, high = found.causes[0].parameters["sampling_age"].interval
    assert low < STEP / RENEWALS < high < 1.3 * STEP / RENEWALS
    assert found.extended_errors.holdout_rms_m < 1.05 * sigma
    clean = replace(record, displacement=run.displacement + noise(run, 1e-3))
    assert diagnose([clean], effects=TABLE).causes == ()
