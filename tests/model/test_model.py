"""Composition, values, and MODEL.json."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.model.evidence import Evidence
from psa_casadi.model.model_file import dumps, loads
from psa_casadi.model.variables import Interval
from psa_casadi.records.split import divided
from tests.model.evidence_models import NOISE, OFFSET, evident_model, noisy_record

CREEP, DRIFT = psa.EFFECTS["slow_creep"], psa.EFFECTS["offset_drift"]


def component(equations: Callable[[psa.Symbols], psa.Equations], **declared: Any) -> psa.Component:
    return psa.Component("extra", "for a test", "none", equations, **declared)


def message(build: Callable[[], object]) -> str:
    with pytest.raises(psa.InputError) as caught:
        build()
    return str(caught.value)


def gain_of(name: str, value: float = 0.0) -> psa.Parameter:
    return psa.Parameter(name, value, "1", (0.0, 1.0), "a gain")


def test_a_loop_of_balances_is_named() -> None:
    loop = component(lambda s: psa.Equations(add={"drive_voltage": 0.1 * s.stack_current}))
    text = message(lambda: psa.compose((*psa.BASE, loop)))
    loop_names = text.split(":")[1].split(";")[0].strip().split(" -> ")
    assert loop_names[0] == loop_names[-1]
    assert set(loop_names) == {"drive_voltage", "drive_current", "stack_current"}
    itself = component(lambda s: psa.Equations(add={"tip_force": 2 * s.tip_force}))
    assert "tip_force -> tip_force;" in message(lambda: psa.compose((*psa.BASE, itself)))


def test_a_component_gives_what_it_declares_and_nothing_else() -> None:
    state = psa.State("z", "m", "a state", 1.0)
    bare = component(
        lambda _: psa.Equations(), states=(state,), outputs=(psa.Output("w", "m", "an output"),)
    )
    text = message(lambda: psa.compose((*psa.BASE, bare)))
    assert "lacks the derivative of the state 'z'" in text
    assert "lacks the equation of the output 'w'" in text
    foreign = component(lambda s: psa.Equations(der={"x": s.v_x}, out={"displacement": s.x}))
    text = message(lambda: psa.compose((*psa.BASE, foreign)))
    assert "derivative of the state 'x', which it does not declare" in text
    assert "equation of the output 'displacement', which it does not declare" in text
    nowhere = component(lambda s: psa.Equations(add={"weight": s.x}))
    assert "adds to 'weight', which is no balance" in message(
        lambda: psa.compose((*psa.BASE, nowhere))
    )


@pytest.mark.parametrize("name", ["k_L", "x", "voltage"])
def test_a_name_belongs_to_one_component(name: str) -> None:
    twice = component(lambda _: psa.Equations(), parameters=(gain_of(name),))
    assert f"Two components declare '{name}'" in message(lambda: psa.compose((*psa.BASE, twice)))


def test_every_bad_value_is_named_at_once() -> None:
    text = message(lambda: psa.compose(psa.BASE, {"k_l": 1.0, "n": 0.5, "m_P": float("nan")}))
    assert "no parameter 'k_l'" in text
    assert "'n' is 0.5 1, outside its bounds [1, 4]" in text
    assert "'m_P' is nan" in text
    model = psa.compose(psa.BASE)
    assert "'tau' is -1 s" in message(lambda: model.with_values({"tau": -1.0}))
    assert "no parameter 'creep_gain'" in message(lambda: model.with_values({"creep_gain": 0.1}))
    assert "no parameter 'tua'" in message(lambda: model.parameter("tua"))
    assert model.with_values({"tau": 2e-4}).values["tau"] == 2e-4
    assert model.values["tau"] == 1e-4


def test_effects_come_and_go_without_a_trace() -> None:
    base = psa.compose(psa.BASE, {"k_L": 12.0})
    extended = base.with_effect(CREEP, {"creep_gain": 0.02}).with_effect(DRIFT)
    assert [e.name for e in extended.effects] == ["slow_creep", "offset_drift"]
    assert extended.values["k_L"] == 12.0
    assert extended.values["drift_rate"] == 0.0
    again = extended.with_effect(CREEP, {"creep_gain": 0.03})
    assert again.structure is extended.structure
    assert (again.values["creep_gain"], extended.values["creep_gain"]) == (0.03, 0.02)
    back = extended.without(["slow_creep", "offset_drift"])
    assert back.structure is base.structure
    assert back.values == base.values


def evidence_in(model: psa.Model) -> Evidence:
    assert model.evidence is not None
    return model.evidence


def test_it_has_the_ranges_of_the_record_and_the_errors_of_the_model() -> None:
    record, evidence = noisy_record(), evidence_in(evident_model())
    rates = np.abs(np.diff(record.voltage) / np.diff(record.time))
    assert evidence.seen.voltage == Interval(record.voltage.min(), record.voltage.max())
    assert evidence.seen.rate == pytest.approx(rates.max())
    assert evidence.seen.duration == record.duration
    assert evidence.seen.temperature is None
    held = evidence.held_out
    assert held is not None
    assert held.interval_m.low < NOISE < held.interval_m.high
    assert held.rms_m == pytest.approx(NOISE, rel=0.15)
    (played,) = evidence.runs
    assert (played.sha256, played.samples, played.averaged) == (record.sha256, 640, 1)
    assert played.offset_m == pytest.approx(OFFSET, abs=1e-8)
    (split,) = divided([record], ())
    held_out = [k for first, stop in played.held_out for k in range(first, stop)]
    assert held_out == np.flatnonzero(split.held_out).tolist()


def test_the_covariance_is_that_of_the_intervals() -> None:
    model = evident_model()
    covariance, known = evidence_in(model).covariance, model.provenance.intervals
    assert covariance.names == ("k_L", "A", "tau")
    for k, name in enumerate(covariance.names):
        half = 0.5 * (known[name].high - known[name].low)
        assert 1.96 * covariance.matrix[k][k] ** 0.5 == pytest.approx(half, rel=0.02), name


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
    evidence = evidence_in(model)
    names = ("k_L", gain)
    wider = replace(evidence.covariance, names=names, matrix=((4.0, 1.0), (1.0, 9.0)))
    both = replace(
        model.with_effect(drift),
        evidence=replace(evidence, covariance=wider, outside=(drift.name,)),
    )
    plant = loads(dumps(both)).plant()
    assert evidence_in(plant).covariance.names == ("k_L",)
    assert evidence_in(plant).covariance.matrix == ((4.0,),)
    assert loads(dumps(plant)).evidence == plant.evidence
