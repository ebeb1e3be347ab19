"""The base's hysteresis as a spectrum of elements in the place of Bouc-Wen's."""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import psa_casadi as psa
from psa_casadi.components import BASE, COMPONENTS
from psa_casadi.export.check.check import check_fmu
from psa_casadi.export.fmu.archive import export_fmu
from psa_casadi.export.modelica.package import modelica_text
from psa_casadi.identification.start.ordinary import forms_of
from psa_casadi.model.compose import Model, compose
from tests.modelica_runs import right_side_error
from tests.plants.make import make_record
from tests.tiers import slow

FloatArray = npt.NDArray[np.float64]

_STROKE, _RATED, _NOISE = 20e-6, 100.0, 20e-9


def _plays(v: FloatArray, radii: FloatArray) -> FloatArray:
    """Ideal play operators (n, k), from rest at 0 V."""
    found = np.empty((v.size, radii.size))
    state = np.zeros(radii.size)
    for k, value in enumerate(v):
        state = np.clip(state, value - radii, value + radii)
        found[k] = state
    return found


def _loops() -> dict[str, FloatArray]:
    """Loops of rising and falling amplitude of a generalised Prandtl-Ishlinskii stack."""
    t = np.arange(3000) * 2e-3
    swing = 0.5 * _RATED * np.interp(t, [0.0, 3.0, 6.0], [0.1, 1.0, 0.3])
    v = swing * (1.0 - np.cos(2.0 * np.pi * 1.5 * t))
    radii = _RATED * np.array([0.015, 0.04, 0.08, 0.13, 0.2, 0.3])
    plays = _plays(v, radii) / _RATED
    weights = np.array([0.04, 0.035, 0.03, 0.03, 0.025, 0.02])
    x = 0.75 * v / _RATED + plays @ weights + plays**2 @ (0.6 * weights[::-1])
    noise = np.random.default_rng(7).normal(0.0, _NOISE, t.size)
    return {"time [s]": t, "voltage [V]": v, "displacement [m]": _STROKE * x / x.max() + noise}


def _with_spectrum(**values: Any) -> Model:
    own = [COMPONENTS["memory_spectrum"] if c.name == "bouc_wen" else c for c in BASE]
    return compose(own, {"u_rated": 120.0, "play_0": -0.05, "square_0": 0.02, **values})


@slow
def test_loops_of_plays_and_squares_prefer_the_spectrum(tmp_path: Path) -> None:
    record = psa.record_from(_loops())
    bouc_wen = psa.identify(record)
    best = psa.identify(record, hysteresis="best")
    assert "memory_spectrum" in [c.name for c in best.model.components]
    assert any("a spectrum of elements" in s for s in best.sentences)
    assert bouc_wen.fit.rms > 3.0 * _NOISE
    assert best.fit.rms < 1.3 * _NOISE
    psa.save_model(best.model, tmp_path / "model.json")
    again = psa.load_model(tmp_path / "model.json")
    assert again.values == best.model.values
    x = psa.simulate(again, record.time, record.voltage).outputs["displacement"]
    assert np.ptp(x) == pytest.approx(record.range_m, rel=0.03)


@slow
def test_loops_of_bouc_wen_keep_it(tmp_path: Path) -> None:
    make_record(None, 3, tmp_path / "record.csv")
    record = psa.read_record(tmp_path / "record.csv").slice(0, 1000)
    found = psa.identify(record, hysteresis="best")
    assert "bouc_wen" in [c.name for c in found.model.components]
    assert any(s.startswith("hysteresis: Bouc-Wen") for s in found.sentences)


@slow
def test_a_diagnosis_begins_with_the_spectrum() -> None:
    effects = [psa.EFFECTS[n] for n in ("hysteresis_memory", "backlash", "load_stiffness")]
    d = psa.diagnose(psa.record_from(_loops()), hysteresis="spectrum", effects=effects)
    assert "memory_spectrum" in [c.name for c in d.model.components]
    assert d.base_errors.holdout_rms_m < 1.5 * _NOISE
    assert {c.effect for c in d.causes} <= {"hysteresis_memory"}


def test_a_model_without_hysteresis_has_no_other_form() -> None:
    bare = compose([c for c in BASE if c.name != "bouc_wen"])
    with pytest.raises(psa.InputError, match="no hysteresis of its own"):
        forms_of(bare, "spectrum")


def test_modelica_has_the_equations_of_the_model() -> None:
    model = _with_spectrum()
    assert right_side_error(model, modelica_text(model, include_sensor=True)) < 1e-12


@slow
def test_an_fmu_with_the_spectrum_passes_its_check(tmp_path: Path) -> None:
    report = check_fmu(export_fmu(_with_spectrum(), tmp_path / "spectrum.fmu"))
    assert report.passed, report
