"""The benchmark `floors`: what it fits reaches the noise where the plant is of its kind."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy.signal import lfilter
from typer.testing import CliRunner

from psa_casadi.errors import InputError
from psa_casadi.records.record import Record
from psa_casadi.records.split import split
from tests.studies.__main__ import app
from tests.studies.benchmarks.floor_fit import HISTORIES, Part, floor_of, play, ridge
from tests.studies.benchmarks.floors import floor_on, run_on

FloatArray = npt.NDArray[np.float64]

#: Samples, and noise over the range's order of size.
N, NOISE = 1600, 2e-3


def triangles(rng: np.random.Generator) -> FloatArray:
    """Loops of other amplitudes, up and down in pieces of other length, with a little jitter."""
    turns = np.cumsum(rng.integers(30, 90, size=60))
    values = rng.uniform(-1.0, 1.0, size=60)
    values[5:7] = 1.0, -1.0
    return np.interp(np.arange(N), np.r_[0, turns], np.r_[0.0, values])


def plant(v: FloatArray, rng: np.random.Generator, state: float = 0.0) -> FloatArray:
    """Memory, creep and the ripple of a sensor, by none of the code that is tested."""
    memory = np.zeros(N)
    for threshold, weight in ((2 / 15, 0.2), (6 / 15, 0.15), (9 / 15, 0.1)):
        s = min(max(state, v[0] - threshold), v[0] + threshold)
        for k in range(N):
            s = min(max(s, v[k] - threshold), v[k] + threshold)
            memory[k] += weight * (s + 0.2 * s**2)
    creep = lfilter([1 / 300.0], [1.0, 1 / 300.0 - 1.0], v - v[0])
    x = v + memory + 0.1 * creep
    shown: FloatArray = x + 0.01 * np.sin(8.0 * x) + NOISE * rng.standard_normal(N)
    return shown


def test_a_play_follows_behind_its_threshold_and_remembers_what_was_before() -> None:
    v = np.array([0.0, 1.0, 0.5, -1.0])
    np.testing.assert_allclose(play(v, 0.2, ()), [0.0, 0.8, 0.7, -0.8])
    np.testing.assert_allclose(play(v, 0.2, (1.0,)), [0.2, 0.8, 0.7, -0.8])


def test_prior_sizes_tell_what_acts_from_what_does_not() -> None:
    rng = np.random.default_rng(3)
    features = rng.standard_normal((300, 64))
    kinds = np.r_[0, np.ones(3, dtype=int), np.full(60, 2)]
    truth = np.r_[5.0, 1.0, -2.0, 0.5, np.zeros(60)]
    y = features @ truth + 0.3 * rng.standard_normal(300)
    found = ridge(features, kinds, y)
    assert found.sigma == pytest.approx(0.3, rel=0.1)
    np.testing.assert_allclose(found.weights[:4], truth[:4], atol=0.1)
    plain = np.linalg.lstsq(features, y, rcond=None)[0]
    assert np.sum((found.weights - truth) ** 2) < 0.3 * np.sum((plain - truth) ** 2)
    without = ridge(features[:, :3], kinds[:3], y)
    assert found.evidence > without.evidence + 10.0


def test_the_floor_of_a_plant_of_its_kind_is_the_noise() -> None:
    rng = np.random.default_rng(11)
    v = triangles(rng)
    record = Record(
        name="own",
        time=np.linspace(0.0, 1e-3 * (N - 1), N),
        voltage=40.0 + 30.0 * v,
        displacement=1e-6 * plant(v, rng),
    )
    experiments = [split(record)]
    errors = floor_on(experiments, lambda _: None)[1]
    assert errors.holdout_rms_m < 1.5e-6 * NOISE
    # a straight line of the voltage errs fifty times more: the record does hold what is found
    x, shown = record.voltage, np.asarray(record.displacement)
    line = np.polyval(np.polyfit(x, shown, 1), x)
    assert np.std((shown - line)[experiments[0].held_out]) > 30.0 * errors.holdout_rms_m


@pytest.mark.slow
def test_modes_are_found_in_a_broadband_record() -> None:
    rng = np.random.default_rng(2)
    v = np.clip(0.25 * rng.standard_normal(700), -1.0, 1.0)
    truth, damping, x = (0.11, 0.23), 0.03, 0.3 * v
    for f in truth:
        w = 2 * np.pi * f
        poles = [1.0, -2 * np.exp(-damping * w) * np.cos(w), np.exp(-2 * damping * w)]
        x += lfilter([0.0, 0.05], poles, v)
    noise = 0.01 * np.std(x)
    y = x + noise * rng.standard_normal(len(v))
    held = np.arange(len(v)) % 100 >= 75
    found = floor_of([Part(v, y, ~held)])
    for f in truth:
        mode = min(found.modes, key=lambda m: abs(m.frequency - f))
        assert mode.frequency == pytest.approx(f, rel=0.003)
        assert mode.damping == pytest.approx(damping, rel=0.1)
    assert np.std((y - found.predicted[0])[held]) < 1.4 * noise


@pytest.mark.slow
def test_a_line_of_the_mains_is_found_and_noise_is_none() -> None:
    rng = np.random.default_rng(8)
    v, k = triangles(rng), np.arange(N)
    held = k % 100 >= 75
    noise = 0.01 * rng.standard_normal(N)
    hum = 0.02 * np.sin(2 * np.pi * 0.2531 * k + 1.0)
    found = floor_of([Part(v, v + hum + noise, ~held)])
    (line,) = [m for m in found.modes if m.damping == 0.0]
    assert line.frequency == pytest.approx(0.2531, abs=1e-5)
    assert np.std((v + hum + noise - found.predicted[0])[held]) < 1.1 * np.std(noise)
    assert not floor_of([Part(v, v + noise, ~held)]).modes


@pytest.mark.slow
def test_where_a_record_comes_from_is_found() -> None:
    rng = np.random.default_rng(5)
    v = 0.4 * triangles(rng)
    part = Part(v, plant(v, rng, state=1.0), np.arange(N) % 100 < 75)
    found = floor_of([part]).histories[0]
    assert found in HISTORIES
    assert found[-1] == 1.0


def test_a_folder_is_for_a_benchmark_that_takes_one(tmp_path: Path) -> None:
    said = CliRunner().invoke(app, ["identify", "--folder", str(tmp_path)])
    assert said.exit_code == 2
    assert "--folder: 'identify' takes none" in said.stderr.replace("\n", " ")
    with pytest.raises(InputError, match="holds no CSV file"):
        run_on(lambda _: None, tmp_path)
