"""Two clocks: their saw tooth is detected in NumPy records, undone, and shows nowhere else."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from psa_casadi import two_clocks
from psa_casadi.common.notes import texts
from psa_casadi.common.units import FloatArray
from psa_casadi.identification.prepare import prepared
from psa_casadi.records import Record, read_record
from tests.studies.plants.base import Run, simulate_base
from tests.studies.plants.sensor import held
from tests.studies.plants.stack import draw_stack

#: Sampling time [s], samples, renewals in one of them, and loops in the record.
STEP, SAMPLES, RENEWALS, LOOPS = 5e-3, 3000, 4, 40


def played(size: FloatArray) -> Run:
    """Play loops whose size (n,) goes over half of the rated voltage."""
    stack, time = draw_stack(np.random.default_rng(11)), np.arange(SAMPLES, dtype=float) * STEP
    turn = 2.0 * np.pi * LOOPS * np.arange(SAMPLES) / SAMPLES
    voltage = np.round(stack.u_rated * size * (1.0 - np.cos(turn)), 3).astype(float)
    return simulate_base(stack, time, voltage)


@pytest.fixture(scope="module")
def run() -> Run:
    return played(0.45 - 0.2 * np.arange(SAMPLES) / SAMPLES)


def record(run: Run, displacement: FloatArray, noise: float = 0.0, seed: int = 5) -> Record:
    """Return a record with white noise, in m."""
    displayed = displacement + noise * np.random.default_rng(seed).standard_normal(SAMPLES)
    return Record(name="r", time=run.times, voltage=run.command, displacement=displayed)


def two_clocked(run: Run, beats: float) -> tuple[FloatArray, FloatArray]:
    """Return what two clocks read, (n,) [m], and what of it is more than a constant delay."""
    reading = held(run, RENEWALS, beats / SAMPLES / RENEWALS, 0.3)
    added, rate = reading - run.displacement, np.gradient(run.displacement, run.times)
    even: FloatArray = added - rate * (added @ rate) / (rate @ rate)
    return reading, even


@pytest.mark.parametrize("beats", [-4.3, 2.8, 3.6])
def test_the_saw_tooth_is_found_and_undone(run: Run, beats: float) -> None:
    """Period within 1 %, height within 10 %, under noise twice the saw tooth."""
    reading, even = two_clocked(run, beats)
    inputs = record(run, reading, 2.0 * float(np.std(even)))
    result = two_clocks(inputs)
    assert result is not None
    assert result.period == pytest.approx(STEP * SAMPLES / abs(beats), rel=0.01)
    assert result.height == pytest.approx(STEP / RENEWALS, rel=0.1)
    assert result.falling == (beats < 0)
    assert np.std(result.moved - even) < 0.25 * np.std(even)
    there = result.undone(inputs)
    assert two_clocks(there) is None
    assert there.sha256 != inputs.sha256


def test_the_finding_is_told_and_repeats(run: Run) -> None:
    """In the sentences of a fit; the same within 1 % when the data change by 1 % of their noise."""
    reading, even = two_clocked(run, -3.3)
    noise = 2.0 * float(np.std(even))
    inputs = record(run, reading, noise)
    result, gaps = two_clocks(inputs), np.asarray(inputs.displacement).copy()
    assert result is not None
    again = two_clocks(record(run, np.asarray(inputs.displacement), 0.01 * noise, seed=6))
    assert again is not None
    assert again.period == pytest.approx(result.period, rel=0.01)
    assert again.height == pytest.approx(result.height, rel=0.01)
    ready, statement = prepared(inputs)
    assert any("sampled by two clocks" in s for s in texts(statement))
    assert two_clocks(ready) is None
    assert (ready.name, ready.sha256) == (inputs.name, inputs.sha256)
    gaps[100:110] = np.nan
    with_gaps = two_clocks(replace(inputs, displacement=gaps))
    assert with_gaps is not None
    assert with_gaps.period == pytest.approx(result.period, rel=0.01)
    assert np.isnan(with_gaps.moved[100:110]).all()


def test_the_measured_sine_has_two_clocks(measured_data: Path) -> None:
    """As docs/evidence.md states it; the minor loops show too little of it."""
    sine, loops = (
        read_record(measured_data / "micromanipulator" / f"{name}.csv")
        for name in ("sine_1hz", "minor_loops")
    )
    result = two_clocks(sine)
    assert result is not None
    output = result.sentence(sine).split(": ", 1)[1].split(". ")[0]
    page = (Path(__file__).parents[2] / "docs" / "evidence.md").read_text(encoding="utf-8")
    text = " ".join(page.split())
    assert output.split(": ")[1] in text
    assert two_clocks(loops) is None


def test_nothing_else_is_taken_for_two_clocks(run: Run) -> None:
    """Noise, delays, their drift, a hum, a slow wave of the delay, one jump of it, uneven steps."""
    x, rate = run.displacement, np.gradient(run.displacement, run.times)
    along, noise = run.times / run.times[-1], 1e-3 * float(np.ptp(run.displacement))
    delays = {
        "none": 0.0 * along,
        "constant": 1e-3 + 0.0 * along,
        "drifting": 2e-3 * along,
        "wave": 1e-3 * np.sin(2.0 * np.pi * 2.7 * along),
        "triangle": 1e-3 * np.abs((2.7 * along) % 1.0 - 0.5),
        "jump": 1e-3 * (along > 0.4),
    }
    for name, delay in delays.items():
        assert two_clocks(record(run, x - delay * rate, noise)) is None, name
    assert two_clocks(record(run, x + noise * np.sin(300.0 * run.times), noise)) is None
    saw = two_clocks(record(run, x - 1e-3 * ((2.7 * along) % 1.0) * rate, noise))
    assert saw is not None
    still = Record(name="still", time=run.times, voltage=0.0 * x, displacement=noise * along)
    assert two_clocks(still) is None
