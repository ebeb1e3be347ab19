"""A model that holds only where it was fitted, and what a diagnosis reports of it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.colour import OwnColour, own_colour
from psa_casadi.diagnosis.held_out import held_out_excess
from psa_casadi.diagnosis.noise import noise_floor
from psa_casadi.diagnosis.task import LIMITS
from psa_casadi.identification.fitting.fit import Fit, fit
from psa_casadi.records.split import Experiment, divided, split
from tests.studies.plants.make import make_record, play_again
from tests.tiers import slow, slow_but

SAMPLES, LEVEL = 2000, 2e-8
TIME = np.linspace(0.0, 1e-3 * (SAMPLES - 1), SAMPLES)


@pytest.fixture(scope="module")
def fitted() -> tuple[Fit, FloatArray, FloatArray]:
    """A fit, its voltage [V], and the displacement without noise [m]."""
    voltage: FloatArray = 40.0 * (1.0 - np.cos(2 * np.pi * 4.0 * TIME))
    model = psa.compose(psa.BASE)
    clean = psa.simulate(model, TIME, voltage).displacement
    record = psa.Record(name="r", time=TIME, voltage=voltage, displacement=clean)
    return fit(model, (split(record),), ["k_L"], sigma=[LEVEL]), voltage, clean


def _colour(experiments: tuple[Experiment, ...], errors: list[FloatArray]) -> OwnColour:
    """The colour of errors where no parameter can follow and no clock jitters."""
    used, held = ([getattr(e, name) for e in experiments] for name in ("used", "held_out"))
    none = np.zeros((sum(int(u.sum()) for u in used), 0))
    return own_colour(errors, used, held, none, np.zeros(0), [np.zeros(len(e)) for e in errors])


def _excess(fitted: tuple[Fit, FloatArray, FloatArray], error: FloatArray) -> float:
    """The excess that is reported for an error (n,) [m] of that model."""
    result, voltage, clean = fitted
    experiments = (
        split(psa.Record(name="r", time=TIME, voltage=voltage, displacement=clean + error)),
    )
    used = error[experiments[0].used]
    observed = replace(result, experiments=experiments, residuals=used)
    colour = _colour(experiments, [error])
    noise = noise_floor([experiments[0].record], [error])
    return held_out_excess(observed, (clean,), colour, noise, LIMITS).factor


@slow
@pytest.mark.parametrize("correlation", slow_but([0.0], [0.0, 0.7]))
def test_noise_is_no_reason_to_doubt(
    fitted: tuple[Fit, FloatArray, FloatArray], correlation: float
) -> None:
    rng = np.random.default_rng(20261122)
    draws = LEVEL * rng.standard_normal((200, SAMPLES))
    noises = lfilter([1.0], [1.0, -correlation], draws, axis=1)
    assert [_excess(fitted, noise) for noise in noises] == [1.0] * 200


@pytest.mark.parametrize("seed", range(5))
def test_larger_held_out_errors_are_reported_and_stray_readings_are_not(
    fitted: tuple[Fit, FloatArray, FloatArray], seed: int
) -> None:
    _, voltage, clean = fitted
    held = split(psa.Record(name="r", time=TIME, voltage=voltage, displacement=clean)).held_out
    noise = LEVEL * np.random.default_rng(seed).standard_normal(SAMPLES)
    assert _excess(fitted, np.where(held, 1.3 * noise, noise)) == pytest.approx(1.3, rel=0.12)
    stray = noise.copy()
    stray[np.flatnonzero(held)[[40, 300]]] = 60.0 * LEVEL
    assert _excess(fitted, stray) == 1.0


@pytest.mark.parametrize("correlation", [0.0, 0.7])
@pytest.mark.parametrize("samples", [200, 1000, SAMPLES])
def test_a_held_out_record_with_different_noise_is_no_reason_to_doubt(
    fitted: tuple[Fit, FloatArray, FloatArray], samples: int, correlation: float
) -> None:
    """A tenth of it determines its offset; its noise is three times that of the fitted one."""
    result, voltage, clean = fitted
    rng = np.random.default_rng(3)
    items = []
    for _ in range(25):
        draws = LEVEL * rng.standard_normal((2, SAMPLES)) * np.array([[1.0], [3.0]])
        errors = lfilter([1.0], [1.0, -correlation], draws, axis=1)
        records = [
            psa.Record(name=f"r{k}", time=TIME, voltage=voltage, displacement=clean + e)
            for k, e in enumerate(errors)
        ]
        experiments = divided(records[:1], [records[1].slice(0, samples)])
        lead = experiments[1].known
        offset = float(np.mean(errors[1][:samples][lead]))
        sigma = tuple(float(np.std(e)) for e in errors)
        observed = replace(result, experiments=experiments, residuals=errors[0], sigma=sigma)
        predicted = (clean, clean[:samples] + offset)
        left = [errors[0], errors[1][:samples] - offset]
        noise = noise_floor([e.record for e in experiments], left)
        colour = _colour(experiments, left)
        items.append(held_out_excess(observed, predicted, colour, noise, LIMITS).factor)
    assert items == [1.0] * 25


@slow
def test_a_model_that_fails_on_the_held_out_record_is_not_adequate(tmp_path: Path) -> None:
    """Slow loops do not show a current limit; the steps that are held out do."""
    path = tmp_path / "slow.csv"
    truth = make_record("current_limit", 7, path, visible=(2.0, 3.0))
    time = np.linspace(0.0, 2.999, 3000)
    slow: FloatArray = 0.45 * truth.stack.u_rated * (1.0 - np.cos(2 * np.pi * time))
    steps = np.where((time // 0.1) % 2 == 1, 0.9, 0.1) * truth.stack.u_rated
    steps[:400] = 0.0  # the first tenth of a held-out record finds its offset
    play_again(truth, 1, path, (time, slow))
    play_again(truth, 2, tmp_path / "steps.csv", (time, steps))
    play_again(truth, 3, tmp_path / "again.csv", (time, slow))
    loops, jumps, again = (
        psa.read_record(tmp_path / f"{n}.csv") for n in ("slow", "steps", "again")
    )
    effects = [psa.EFFECTS["current_limit"]]
    doubted = psa.diagnose([loops], holdout=[jumps], effects=effects)
    assert doubted.verdict == "unexplained"
    assert not doubted.remaining.white
    assert "held-out samples' error is" in doubted.remaining.where
    assert psa.diagnose([loops], holdout=[again], effects=effects).verdict == "adequate"
    named = psa.diagnose([loops, jumps], effects=effects)
    assert [c.effect for c in named.causes] == ["current_limit"]


@slow
def test_a_named_cause_does_not_hide_that_the_held_out_record_is_another(tmp_path: Path) -> None:
    """After its first tenth the sensor shows 0.5 % more: the creep is named, and more is left."""
    path, second = tmp_path / "creeping.csv", tmp_path / "again.csv"
    truth = make_record("slow_creep", 11, path, visible=(1.0, 2.0))
    play_again(truth, 1, second)
    record, again = psa.read_record(path), psa.read_record(second)
    effects = [psa.EFFECTS["slow_creep"]]
    same = psa.diagnose([record], holdout=[again], effects=effects)
    assert same.verdict == "cause_named"
    assert same.remaining.white
    later = again.time > again.time[0] + 0.15 * again.duration
    gain = np.where(later, 1.005, 1.0)
    scaled = replace(again, displacement=np.asarray(gain * again.displacement, dtype=np.float64))
    unlike = psa.diagnose([record], holdout=[scaled], effects=effects)
    assert unlike.verdict == "partly_explained"
    assert [c.effect for c in unlike.causes] == ["slow_creep"]
    assert "held-out samples' error is" in unlike.remaining.where
