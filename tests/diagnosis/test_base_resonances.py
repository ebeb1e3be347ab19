"""Stacks that ring within a record's band, or just above it: the base must find that itself."""

from pathlib import Path

import numpy as np
import pytest

from psa_casadi.diagnosis.base_fit import from_resonances
from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.refitting import quick_rtol
from psa_casadi.identification.search import fit_base
from psa_casadi.identification.start.ordinary import starting_model
from psa_casadi.model.effects import EFFECTS
from psa_casadi.records.read.reading import read_record
from psa_casadi.records.split import Experiment, split
from psa_casadi.simulation.simulate import simulate_record
from tests.studies.plants.excitations import ExcitationKind
from tests.studies.plants.make import Truth, make_record
from tests.tiers import slow


def _fitted(
    path: Path, kind: ExcitationKind, seed: int, samples: int | None = None
) -> tuple[Truth, tuple[Experiment, ...], Fit]:
    truth = make_record(None, seed, path, excitation=kind)
    whole = read_record(path)
    record = whole.slice(0, samples or whole.n)
    experiments = (split(record),)
    return truth, experiments, fit_base(starting_model([record], None), experiments)


def _quietly(_: str) -> None:
    pass


@slow
def test_two_resonances_within_the_band_are_fitted_to_the_noise(tmp_path: Path) -> None:
    """From the linear part's starts alone this fit ended at 1.16 times the noise."""
    truth, _, base = _fitted(tmp_path / "a.csv", "fast", 1)
    fit = from_resonances(base, _quietly)
    assert fit is not None
    assert fit.rms < 1.02 * truth.sigma
    stack, p = truth.stack, fit.model.values
    tones = sorted([np.sqrt(stack.k_p / stack.m_p), np.sqrt(stack.k_b / stack.m_b)])
    mine = sorted([np.sqrt(p["k_P"] / p["m_P"]), np.sqrt(p["k_B"] / p["m_B"])])
    assert mine[0] == pytest.approx(tones[0], rel=0.1)


@slow
def test_a_tone_at_an_image_of_the_stacks_own_resonance_is_no_cause(tmp_path: Path) -> None:
    """1.69 kHz sampled at 2 kHz, aliased to 0.33 kHz, where it decays as fast in time."""
    make_record(None, 19, tmp_path / "a.csv", excitation="short")
    result = diagnose([read_record(tmp_path / "a.csv")], effects=[EFFECTS["structural_mode"]])
    assert result.verdict == "adequate"


@slow
def test_a_missed_resonance_is_no_cause(tmp_path: Path) -> None:
    """Without a search for its ringing, this clean record has the verdict unexplained."""
    make_record(None, 118254, tmp_path / "a.csv", noise="ar")
    effects = [EFFECTS[n] for n in ("structural_mode", "sensor_delay", "sensor_lag", "drive_lag")]
    assert diagnose([read_record(tmp_path / "a.csv")], effects=effects).verdict == "adequate"


def test_quick_fits_integrate_below_the_noise(tmp_path: Path) -> None:
    """A sensor with a noise of 2e-4 of the range: at 1e-4 the stepper's error was larger."""
    path = tmp_path / "a.csv"
    make_record(None, 3, path, excitation="sines")
    record = read_record(path).slice(0, 3000)
    experiments = (split(record),)
    model = starting_model([record], None)
    range_ = float(np.ptp(np.asarray(record.displacement)))
    noise = 2e-4 * range_
    rtol = quick_rtol([noise], experiments)
    exact = simulate_record(model, record, rtol=1e-9).outputs["displacement"]
    quick = simulate_record(model, record, rtol=rtol).outputs["displacement"]
    assert float(np.std(quick - exact)) < 0.3 * noise * float(np.ptp(exact)) / range_
    assert quick_rtol([1e6 * noise], experiments) > 5.0 * rtol
