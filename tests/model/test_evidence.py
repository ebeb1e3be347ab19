"""What stands behind a model's values is kept with it, in MODEL.json, and only while it is true."""

from dataclasses import replace

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.model.evidence import Evidence
from psa_casadi.model.model_file import dumps, loads
from psa_casadi.records.split import divided
from psa_casadi.simulation.simulate import record_inputs
from psa_casadi.variables import Interval
from tests.model.evidence_models import NOISE, OFFSET, evident_model, noisy_record


def evidence_in(model: psa.Model) -> Evidence:
    assert model.evidence is not None
    return model.evidence


def test_it_says_what_the_record_has_shown_and_what_the_model_errs_by() -> None:
    record, told = noisy_record(), evidence_in(evident_model())
    rates = np.abs(np.diff(record.voltage) / np.diff(record.time))
    assert told.seen.voltage == Interval(record.voltage.min(), record.voltage.max())
    assert told.seen.rate == pytest.approx(rates.max())
    assert told.seen.duration == record.duration
    assert told.seen.temperature is None
    held = told.held_out
    assert held is not None
    assert held.interval_m.low < NOISE < held.interval_m.high
    assert held.rms_m == pytest.approx(NOISE, rel=0.15)
    (played,) = told.runs
    assert (played.sha256, played.samples, played.averaged) == (record.sha256, 640, 1)
    assert played.offset_m == pytest.approx(OFFSET, abs=1e-8)
    (split,) = divided([record], ())
    held_out = [k for first, stop in played.held_out for k in range(first, stop)]
    assert held_out == np.flatnonzero(split.held_out).tolist()


def test_the_covariance_is_that_of_the_intervals() -> None:
    model = evident_model()
    told, known = evidence_in(model).covariance, model.provenance.intervals
    assert told.names == ("k_L", "A", "tau")
    for k, name in enumerate(told.names):
        half = 0.5 * (known[name].high - known[name].low)
        assert 1.96 * told.matrix[k][k] ** 0.5 == pytest.approx(half, rel=0.02), name


def test_a_record_is_played_again_from_what_is_said_of_it() -> None:
    """The start, the offset and the stretches are enough to find the held-out error again."""
    model, record = evident_model(), noisy_record()
    (said,) = evidence_in(model).runs
    x0 = np.array([said.start[n] for n in model.state_names])
    inputs = record_inputs(model, record, record.n)
    y = psa.run(model, record.time - record.time[0], inputs, x0, rtol=1e-9).y
    found = y[:, model.output_names.index("measured_displacement")] + said.offset_m
    error = np.concatenate([(measured(record) - found)[a:b] for a, b in said.held_out])
    assert np.sqrt(np.mean(error**2)) == pytest.approx(said.held_out_m, rel=1e-4)


def test_a_file_keeps_it_exactly() -> None:
    model = evident_model()
    again = loads(dumps(model))
    assert again.evidence == model.evidence
    assert dumps(again) == dumps(model)
    assert max(len(line) for line in dumps(model).splitlines()) > 1000  # a list on one line
    assert loads(dumps(replace(model, evidence=None))).evidence is None


def test_other_values_or_physics_have_no_evidence() -> None:
    model = evident_model()
    same = model.with_values({"k_L": model.values["k_L"]})
    assert same.evidence is model.evidence
    assert model.with_values({"k_L": 1.01 * model.values["k_L"]}).evidence is None
    assert model.with_effect(psa.EFFECTS["slow_creep"]).evidence is None
    assert model.without(["creep_lag"]).evidence is None
    assert model.with_starts({"u": 1.0}).evidence is model.evidence


def test_a_plant_keeps_it_with_the_covariance_of_its_own_parameters() -> None:
    model = evident_model()
    drift = psa.EFFECTS["offset_drift"]
    gain = drift.gain or ""
    told = evidence_in(model)
    names = ("k_L", gain)
    wider = replace(told.covariance, names=names, matrix=((4.0, 1.0), (1.0, 9.0)))
    both = replace(
        model.with_effect(drift), evidence=replace(told, covariance=wider, outside=(drift.name,))
    )
    plant = loads(dumps(both)).plant()
    assert evidence_in(plant).covariance.names == ("k_L",)
    assert evidence_in(plant).covariance.matrix == ((4.0,),)
    assert loads(dumps(plant)).evidence == plant.evidence
