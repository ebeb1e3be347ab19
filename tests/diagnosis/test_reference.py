"""What has changed since a reference is named despite another hysteresis, and nothing else is."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.cli.diagnosis_files import cases
from psa_casadi.common.notes import Note
from psa_casadi.diagnosis.reference import Healthy
from psa_casadi.identification.fitting.fit import fit
from psa_casadi.records.split import whole
from psa_casadi.report.words.verdict_words import verdict_sentence
from tests.any_model.own_models import oven
from tests.studies.exam.play import play
from tests.studies.exam.records import RECORDS

#: A Prandtl-Ishlinskii stack on a staircase that creeps by a power of time, and a Coleman-Hodgdon
#: one at random reversals.
CREEPS, CLEAN = (next(r for r in RECORDS if r.name.startswith(name)) for name in ("k02", "c07"))


def recorded(name: str, *, noise: int, gain: float = 1.0, sound: bool = False) -> psa.Record:
    """Return a record of the exam with new noise; if `sound`, without its hidden effect."""
    inputs = next(r for r in RECORDS if r.name.startswith(name))
    played = play(replace(inputs, hidden={}) if sound else inputs)
    sigma = 1e-2 * inputs.test.noise * float(np.ptp(played.clean))
    displayed = gain * played.clean + sigma * np.random.default_rng(noise).standard_normal(
        played.clean.size
    )
    return psa.Record(
        name=f"{name} {noise}",
        time=played.times,
        voltage=played.voltage,
        displacement=1e-6 * displayed,
    )


def codes(d: psa.StackDiagnosis) -> dict[str, Note]:
    return {n.code: n for n in d.remarks if not isinstance(n, str)}


@pytest.fixture(scope="module")
def sound() -> psa.Record:
    return recorded("c07", noise=1)


def test_an_effect_is_named_next_to_a_hysteresis_that_the_base_lacks() -> None:
    good, new = recorded("k02", noise=1, sound=True), recorded("k02", noise=2)
    d = psa.diagnose(new, reference=good)
    assert [c.effect for c in d.causes] == ["slow_creep"]
    assert codes(d)["since"].values["places"] == 1
    # the plant's form, not the package's, was added: its size is recovered as well
    more = 1e-6 * (play(CREEPS).clean - play(replace(CREEPS, hidden={})).clean)
    left = d.experiments[0].record.measured - d.base[0]
    assert np.corrcoef(more, left)[0, 1] > 0.9


def test_nothing_has_changed_in_the_same_test_of_a_healthy_device(sound: psa.Record) -> None:
    d = psa.diagnose(recorded("c07", noise=2), reference=sound)
    assert d.verdict == "adequate"
    notes = codes(d)
    assert "since_moved" not in notes
    # the base lacks the hysteresis: what is taken off is far above the noise
    assert notes["since"].values["removed"][0] > 2.0 * d.noise_floor_rms_m
    assert "Nothing has changed since the reference" in verdict_sentence(d)


def test_a_gain_that_has_changed_is_reported_as_a_parameter() -> None:
    new, good = (recorded("c02", noise=k, gain=g).slice(0, 2000) for k, g in ((3, 0.97), (1, 1.0)))
    d = psa.diagnose(new, reference=good)
    assert d.verdict == "adequate"
    moved = codes(d)["since_moved"].values
    assert moved["alone"]
    assert moved["name"] == "k_P"
    assert moved["values"][1] > moved["values"][0]  # stiffer: less displacement
    assert "k_P has changed" in cases(d, ("adequate",), None)[0].failure
    assert "since the reference" in " ".join(d.notes)
    assert "Of the base model k_P has changed" in verdict_sentence(d)


def test_what_the_device_adds_is_predicted_where_the_voltage_is_another() -> None:
    rng, time = np.random.default_rng(4), np.linspace(0.0, 8.0, 3001)
    values = [50.0 + 45.0 * np.sin(2.0 * np.pi * time + p) * np.cos(0.4 * time) for p in (0.0, 1.0)]
    model, records, adds = psa.stack_model("demo"), [], []
    for v in values:
        clean = psa.simulate(model, time, v).displacement
        adds.append(2e-7 * (np.cos(0.09 * v) + np.tanh(np.gradient(v, time) / 20.0)))
        displayed = clean + adds[-1] + 1e-8 * rng.standard_normal(time.size)
        records.append(psa.Record(name="r", time=time, voltage=v, displacement=displayed))
    experiments = (whole(records[0]),)
    held = fit(model, experiments, (), sigma=[1e-7])
    healthy = Healthy(held)
    (added,), places = healthy.adds(records[1:])
    observed = healthy.shows(records[1])
    assert places == 0
    assert np.mean(observed) > 0.25
    assert np.corrcoef(added[observed], adds[1][observed])[0, 1] > 0.9
    (again,), places = healthy.adds(records[:1])
    assert places == 1
    assert np.corrcoef(again, adds[0])[0, 1] > 0.95


def test_a_voltage_that_the_reference_does_not_show_is_refused(sound: psa.Record) -> None:
    twice = psa.Record(
        name="wide", time=sound.time, voltage=3.0 * sound.voltage,
        displacement=np.asarray(sound.displacement) * 3.0,
    )  # fmt: skip
    with pytest.raises(psa.InputError, match="wide: the voltage is as in the reference"):
        psa.diagnose(twice, reference=sound)


def test_a_user_model_takes_no_reference(sound: psa.Record) -> None:
    words: Any = {"reference": sound}
    with pytest.raises(psa.InputError, match="'reference' is not among the arguments for"):
        psa.diagnose(oven(), [sound], **words)
