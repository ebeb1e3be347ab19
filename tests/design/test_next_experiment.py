"""From ambiguous to named: a designed record, played on the hidden plant, tells the cause."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.cli import diagnose as command
from psa_casadi.cli import diagnosis_files as files
from psa_casadi.design.experiment import experiment
from psa_casadi.design.experiment.criteria import noise_of_fit, rival_of_fit
from psa_casadi.design.experiment.experiment import Separated, resolving_experiment
from psa_casadi.design.experiment.limits import excess
from psa_casadi.design.experiment.search import Effort
from psa_casadi.diagnosis.diagnose import diagnose
from tests.studies.plants.again import play_again
from tests.studies.plants.make import make_record
from tests.tiers import slow

#: The loop from record to name is run once: with pytest-xdist by one process.
pytestmark = pytest.mark.xdist_group("next-experiment")

#: A gain that bends with the field, hidden in a triangle, where a bent sensor looks the same.
HIDDEN, RIVAL, SEED = "field_dependent_gain", "sensor_nonlinearity", 7003
SAMPLES = 2000


@dataclass(frozen=True, eq=False)
class Loop:
    first: psa.Record
    ambiguous: psa.Diagnosis
    design: Separated
    named: psa.Diagnosis


@pytest.fixture(scope="module")
def loop(tmp_path_factory: pytest.TempPathFactory) -> Loop:
    folder = tmp_path_factory.mktemp("loop")
    effects = [psa.EFFECTS[HIDDEN], psa.EFFECTS[RIVAL]]
    path = folder / "first.csv"
    truth = make_record(HIDDEN, SEED, path, excitation="triangle", visible=(0.3, 2.0))
    first = psa.read_record(path).slice(0, SAMPLES)
    ambiguous = diagnose([first], effects=effects)
    design = resolving_experiment(ambiguous, effort=Effort(draws=3, starts=1, steps=3))
    played = folder / "next.csv"
    play_again(truth, SEED, played, (design.record.time, design.record.voltage))
    named = diagnose([first, psa.read_record(played)], effects=effects)
    return Loop(first, ambiguous, design, named)


@slow
def test_the_first_record_leaves_two_causes_open(loop: Loop) -> None:
    d = loop.ambiguous
    assert d.verdict == "ambiguous"
    assert {c.effect for c in d.contenders} == {HIDDEN, RIVAL}
    assert set(d.next_experiment.separates) == {HIDDEN, RIVAL}
    known = {c.effect: c.evidence for c in d.candidates}
    for contender in d.contenders:
        assert contender.evidence == pytest.approx(known[contender.effect])
        assert contender.effect in {c.name for c in contender.fit.model.effects}


@slow
def test_a_rival_that_is_the_truth_has_a_standard_error_less_of_its_effect(loop: Loop) -> None:
    d = loop.ambiguous
    best = min(d.contenders, key=lambda c: c.fit.rms).fit
    _, colour = noise_of_fit(best, d.experiments)
    for contender in d.contenders:
        rival = rival_of_fit(contender.effect, contender.fit, colour)
        gain = psa.EFFECTS[contender.effect].gain or ""
        model, start = rival.moved(rival.truth)
        fitted = rival.model.values[gain]
        assert 0.2 < model.values[gain] / fitted < 1.0
        assert not any(start.values())
        assert rival.less is not None
        # as likely as the data at hand make one standard error
        assert 0.0 < rival.less @ rival.known @ rival.less < 1.001
    base = rival_of_fit("base", d.base_fit, colour)
    assert not np.any(base.truth)


@slow
def test_the_designed_record_is_like_the_first_and_tells_more_than_a_sine(loop: Loop) -> None:
    design, first = loop.design, loop.first
    assert design.record.n == first.n
    assert design.record.sample_time == pytest.approx(first.sample_time)
    assert excess(design.record, design.limits, None) == ()
    assert design.record.voltage.min() >= first.voltage.min() - 1e-9
    assert design.record.voltage.max() <= first.voltage.max() + 1e-9
    assert design.factor("sine") > 2.0
    assert design.factor("triangle") > 2.0
    assert min(design.chance.values()) > 0.9


@slow
def test_with_the_designed_record_the_cause_is_named(loop: Loop) -> None:
    d = loop.named
    assert d.verdict in ("cause_named", "partly_explained")
    assert d.causes[0].effect == HIDDEN
    assert d.causes[0].cannot_be_told_from == ()
    with pytest.raises(psa.InputError, match="nothing to tell apart"):
        resolving_experiment(d)


@slow
def test_the_command_writes_the_record_and_says_so(
    loop: Loop, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The design itself is the one above: here only what becomes of it."""
    monkeypatch.setattr(experiment, "resolving_experiment", lambda d, **_: loop.design)
    path = command._beside(tmp_path / "diagnosis.json")
    assert path == tmp_path / "diagnosis_next.csv"
    d = files.with_next(loop.ambiguous, path, lambda _: None)
    said = json.loads(d.to_json())["next_experiment"]
    assert said["voltage_csv"] == str(path)
    assert set(said["separates"]) == set(said["chance"]) == {HIDDEN, RIVAL}
    assert str(path) in " ".join(psa.story(d, width=400).split())
    record = psa.read_record(path, need_displacement=False)
    np.testing.assert_array_equal(record.voltage, loop.design.record.voltage)
    assert files.with_next(loop.named, path, lambda _: None) is loop.named
    assert files.with_next(loop.ambiguous, None, lambda _: None) is loop.ambiguous
