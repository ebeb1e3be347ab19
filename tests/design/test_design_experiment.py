"""Designed experiments: within their limits, with right gradients, and better than a sine."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

import psa_casadi as psa
from psa_casadi import reference
from psa_casadi.cli import diagnose as command
from psa_casadi.cli import diagnosis_files as files
from psa_casadi.common.units import FloatArray
from psa_casadi.design.experiment import experiment
from psa_casadi.design.experiment.criteria import (
    Criterion,
    Information,
    Optimality,
    Rival,
    SensorNoise,
    Separation,
    noise_of_fit,
    rival_of_fit,
    rival_of_model,
)
from psa_casadi.design.experiment.experiment import (
    Separated,
    informative_experiment,
    naming_probability,
    plays_of,
    resolving_experiment,
    rival_of_effect,
    separating_experiment,
    usual_records,
)
from psa_casadi.design.experiment.limits import KINDS, Kind, Limits, draw, rest_of
from psa_casadi.design.experiment.search import Effort
from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.report.words.design_words import sentences
from tests.contract.helpers import done, refused
from tests.studies.plants.make import make_record, play_again
from tests.tiers import slow

STACK = "P-885.51"
FREE = ("k_L", "A", "delta", "tau", "R_s")
LIMITS = Limits(0.0, 100.0, 1.0, 200)
NOISE = SensorNoise(20e-9)
BRIEF = Effort(draws=2, starts=1, steps=3)


def rivals(share: float = 0.2, bent: str = "sensor_nonlinearity") -> list[Rival]:
    """A bent sensor (or another effect) and creep, each of a share of its ordinary size."""
    items = []
    for effect in (psa.EFFECTS[n] for n in (bent, "slow_creep")):
        model = psa.stack_model(STACK).with_effect(effect)
        size = share * model.parameter(effect.gain or "").typical(model.values)
        items.append(rival_of_effect(model.with_values({effect.gain or "": size}), effect, FREE))
    return items


def excess(record: psa.Signals, limits: Limits, capacitance: float | None) -> list[str]:
    """Return the limits that a record exceeds."""
    v, margin = record.columns["voltage"], 1e-9 * limits.span
    slope = np.max(np.abs(np.diff(v) / np.diff(record.time)))
    beyond = v.min() < limits.low - margin or v.max() > limits.high + margin
    steep = slope > limits.steepest(capacitance) * (1.0 + 1e-6)
    return [name for name, wrong in (("range", beyond), ("rate", steep)) if wrong]


def planned(kind: Kind, limits: Limits = LIMITS, seed: int = 3) -> psa.Record:
    wave = draw(kind, limits, limits.steepest(None), np.random.default_rng(seed))
    time = limits.grid()
    return psa.Record(name=kind, time=time, voltage=wave.values(wave.start, time))


def test_all_that_is_wrong_with_limits_is_reported_at_once() -> None:
    with pytest.raises(psa.InputError) as caught:
        Limits(5.0, 5.0, -1.0, 3, rate=0.0)
    assert len(caught.value.problems) == 4
    with pytest.raises(psa.InputError, match="no whole cycle"):
        Limits(0.0, 100.0, 1.0, 100, bandwidth=0.5)
    with pytest.raises(psa.InputError, match="cannot be resolved"):
        Limits(0.0, 100.0, 1.0, 100, bandwidth=80.0)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(4))
def test_voltages_keep_every_limit(kind: Kind, seed: int) -> None:
    capacitance = 1.5e-6
    limits = Limits(-20.0, 100.0, 2.0, 1000, rate=5e3, current=1.5e-3, bandwidth=10.0)
    steepest = limits.steepest(capacitance)
    assert steepest == pytest.approx(1e3)  # the current asks for less than the rate
    rng = np.random.default_rng(seed)
    wave, time = draw(kind, limits, steepest, rng), limits.grid()
    voltage = wave.values(wave.start, time)
    assert excess(psa.Record(name=kind, time=time, voltage=voltage), limits, capacitance) == []
    np.testing.assert_allclose(voltage[time <= rest_of(limits)], limits.low, atol=1e-9)
    assert np.ptp(voltage) > 0.1 * limits.span
    assert np.all(wave.slack(wave.start) >= -1e-9)
    quiet = Limits(-20.0, 100.0, 2.0, 1000, rate=1e2)
    assert excess(psa.Record(name=kind, time=time, voltage=voltage), quiet, None) != []
    tones = np.abs(np.fft.rfft((voltage - voltage.mean()) * np.hanning(len(time)))) ** 2
    above = np.fft.rfftfreq(len(time), time[1]) > 4.0 * limits.band
    assert tones[above].sum() < 0.02 * tones.sum()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("which", ["separation", "D", "E", "A"])
def test_the_frozen_function_has_the_gradient_of_the_value(kind: Kind, which: str) -> None:
    """Against differences of the value itself, each of which fits and simulates again."""
    criterion: Criterion
    if which == "separation":
        noise = [NOISE.on_grid(LIMITS, LIMITS.samples)]
        # rivals whose fits again stay in one minimum while this voltage moves
        bent = "rate_independent_asymmetry" if kind == "multisine" else "sensor_nonlinearity"
        criterion = Separation(tuple(rivals(bent=bent)), noise, evaluations=60)
    else:
        optimality: Optimality = "D" if which == "D" else "E" if which == "E" else "A"
        colour = SensorNoise(20e-9, 0.4).on_grid(LIMITS, LIMITS.samples)
        criterion = Information(rivals()[1], ("k_L", "A"), optimality, [colour])
    wave = draw(kind, LIMITS, np.inf, np.random.default_rng(5))
    time = LIMITS.grid()
    step = 6e-3 if which == "separation" else 3e-3  # above the jumps of the stepper's steps
    rng = np.random.default_rng(1)
    way = rng.standard_normal(len(wave.start)) / np.sqrt(len(wave.start))
    if kind == "steps":  # an edge that moves over a sample makes a kink: change the levels only
        way[len(way) // 2 :] = 0.0
    p = np.clip(wave.start, wave.lower + 0.02, wave.upper - 0.02)

    def at(share: float) -> psa.Record:
        return psa.Record(name=kind, time=time, voltage=wave.values(p + share * way, time))

    frozen = criterion.at(at(0.0)).frozen
    output = (frozen(at(step)) - frozen(at(-step))) / (2.0 * step)
    observed = (criterion.at(at(step)).value - criterion.at(at(-step)).value) / (2.0 * step)
    assert output == pytest.approx(observed, rel=0.15, abs=0.02)


def test_standard_errors_are_those_of_the_papers_equations_in_plain_numpy() -> None:
    """Differences of the independent reference give the same covariance as exact sensitivities."""
    names, limits = ("k_L", "A", "delta"), Limits(0.0, 100.0, 1.0, 60)
    model, record = psa.stack_model(STACK), planned("triangles", limits)
    rival = rival_of_model("base", model, names)
    criterion = Information(rival, names, "D", [NOISE.on_grid(limits, limits.samples)])
    values = criterion.standard_errors(record)
    columns = [_slope(model, record, n, 1e-3 * abs(model.values[n])) for n in names]
    columns += [_slope(model, record, "f_H", 1e-3 * model.values["h_ref"]), np.ones(record.n)]
    jacobian = np.column_stack(columns) / NOISE.rms
    size = np.linalg.norm(jacobian, axis=0)
    covariance = np.linalg.inv((jacobian / size).T @ (jacobian / size))
    observed = np.sqrt(np.diag(covariance)) / size
    np.testing.assert_allclose([values[n] for n in names], observed[: len(names)], rtol=0.02)


def _slope(model: psa.Model, record: psa.Record, name: str, step: float) -> FloatArray:
    def at(change: float) -> FloatArray:
        values = {**model.values}
        force = 0.0
        if name == "f_H":
            force = change
        else:
            values[name] += change
        y = force / values["k_P"]
        start = {"f_H": force, "f_out": force, "y": y, "x": y + force / values["k_B"]}
        signal = reference.from_samples(record.time, record.voltage)
        return reference.simulate(
            values, signal, record.time, initial=start, breakpoints=record.time.tolist(), rtol=1e-8
        ).displacement

    return (at(step) - at(-step)) / (2.0 * step)


def test_the_distance_is_what_an_independent_optimiser_leaves() -> None:
    other, one = rivals(1.0)
    record, noise = planned("steps"), [NOISE.on_grid(LIMITS, LIMITS.samples)]
    values = Separation((one, other), noise).distances(record)
    target = one.predict(record, np.zeros(one.size))
    root = np.linalg.cholesky(other.information + 1e-12 * np.eye(other.size)).T

    def rest(delta: FloatArray) -> FloatArray:
        gap = (target - other.predict(record, delta))[:, 0] / NOISE.rms
        return np.concatenate([gap, root @ delta])

    best = least_squares(rest, np.zeros(other.size), x_scale="jac", method="lm")
    assert values[one.name, other.name] == pytest.approx(2.0 * best.cost, rel=0.05)


def test_what_is_known_of_a_rival_holds_it_back() -> None:
    """The better the data at hand know a rival, the less it can follow the other."""
    one, other = rivals()
    record, noise = planned("steps"), [NOISE.on_grid(LIMITS, LIMITS.samples)]
    sure = replace(other, known=1e6 * other.known)
    loose = Separation((one, other), noise).distance(one, other, record)
    tight = Separation((one, sure), noise).distance(one, sure, record)
    assert tight > 1.05 * loose


def test_naming_is_as_sure_as_the_evidence() -> None:
    one, other = rivals()
    pair = (one.name, other.name)
    small, large = ({pair: t} for t in (4.0, 60.0))
    assert naming_probability(one, [other], small, 0.0) < 0.05
    assert naming_probability(one, [other], large, 0.0) > 0.99
    # evidence over the base raises what a diagnosis asks for
    assert naming_probability(one, [other], large, 4e4) < 0.01


def test_coloured_noise_reveals_less_of_slow_voltages() -> None:
    rival = rival_of_model("base", psa.stack_model(STACK), FREE)
    record = planned("triangles")
    errors = []
    for correlation in (0.0, 0.8):
        noise = [SensorNoise(20e-9, correlation).on_grid(LIMITS, LIMITS.samples)]
        errors.append(Information(rival, FREE, "D", noise).standard_errors(record)["k_L"])
    assert 2.0 < errors[1] / errors[0] < 4.0  # sqrt((1 + r)/(1 - r)) = 3 for constant signals


def test_a_design_is_better_than_the_usual_voltages_and_within_its_limits() -> None:
    limits = Limits(0.0, 80.0, 1.0, 200, rate=2e3)
    kinds: tuple[Kind, ...] = ("steps", "multisine")
    separated = separating_experiment(rivals(), NOISE, limits, kinds=kinds, effort=BRIEF)
    assert separated.record.n == limits.samples
    assert excess(separated.record, limits, None) == []
    assert separated.factor("sine") > 1.0
    assert separated.factor("triangle") > 1.0
    assert "plays" not in " ".join(sentences(separated))
    assert "3 runs, each from rest" in " ".join(sentences(replace(separated, plays=3)))
    assert "look alike" in " ".join(sentences(replace(separated, plays=None)))
    rival = rival_of_model("base", psa.stack_model(STACK), FREE)
    sharp = informative_experiment(rival, NOISE, limits, optimality="A", kinds=kinds, effort=BRIEF)
    assert excess(sharp.record, limits, None) == []
    assert min(sharp.factor.values()) > 1.1
    for name in FREE:
        before, after = (np.diff(i[name])[0] for i in (sharp.before, sharp.intervals))
        assert 0.0 < after < before


def test_the_more_noise_the_more_plays() -> None:
    pair, record = tuple(rivals()), planned("triangles")
    numbers: list[float] = []
    for noise in (1e-10, 2e-9, 2e-6):
        criterion = Separation(pair, [SensorNoise(noise).on_grid(LIMITS, LIMITS.samples)])
        distances = criterion.distances(record)
        chance = {r.name: naming_probability(r, [o], distances, 0.0)
                  for r, o in (pair, pair[::-1])}  # fmt: skip
        numbers.append(plays_of(criterion, record, chance) or np.inf)
    assert numbers[0] == 1
    assert 1 < numbers[1] <= 5
    assert numbers[-1] == np.inf


def test_the_usual_voltages_slow_down_where_the_rate_asks() -> None:
    limits = Limits(0.0, 100.0, 1.0, 200, rate=500.0)
    for record in usual_records(limits, 500.0).values():
        assert excess(record, limits, None) == []
        assert np.ptp(record.voltage) > 0.9 * limits.span


def test_a_parameter_that_is_not_free_is_named() -> None:
    rival = rival_of_model("base", psa.stack_model(STACK), FREE)
    with pytest.raises(psa.InputError, match="stiffnes"):
        Information(rival, ("stiffnes",), "D", [NOISE.on_grid(LIMITS, 200)])


@slow
def test_the_command_fits_the_rivals_to_the_records_at_hand(tmp_path: Path) -> None:
    effect = psa.EFFECTS["sensor_nonlinearity"]
    model = psa.stack_model(STACK).with_effect(effect)
    gain = effect.gain or ""
    model = model.with_values({gain: 0.3 * model.parameter(gain).typical(model.values)})
    plan = usual_records(Limits(0.0, 70.0, 0.8, 80), np.inf)["triangle"]
    read = psa.simulate(model, plan.time, plan.voltage).outputs["displacement"]
    read = read + 5e-9 * np.random.default_rng(2).standard_normal(plan.n)
    measured, output = tmp_path / "measured.csv", tmp_path / "voltage.csv"
    columns = {"time [s]": plan.time, "voltage [V]": plan.voltage}
    psa.write_record(measured, {**columns, "displacement [um]": 1e6 * read})
    done(
        "design", "experiment", "--stack", STACK, "--record", measured, "--family", "steps",
        "--starts", "1", "--separate", "sensor_nonlinearity", "slow_creep", "-o", output,
    )  # fmt: skip
    record = psa.read_record(output, need_displacement=False)
    assert (record.n, record.time[-1]) == (plan.n, pytest.approx(plan.time[-1]))
    assert plan.voltage.min() - 1e-9 <= record.voltage.min()
    assert record.voltage.max() <= plan.voltage.max() + 1e-9


def test_the_command_reports_all_mistakes_at_once(tmp_path: Path) -> None:
    output = refused(
        "design", "experiment", "--separate", "creeping", "--noise", "-1", "--starts", "0",
        "-o", tmp_path / "no" / "where.csv",
    )  # fmt: skip
    for part in ("creeping", "--noise", "--starts", "does not exist", "The model is missing"):
        assert part in output


#: The loop from record to name is run once: with pytest-xdist by one process.
pytestmark = pytest.mark.xdist_group("next-experiment")

#: A gain that bends with the field, hidden in a triangle, where a bent sensor looks the same.
HIDDEN, RIVAL, SEED = "field_dependent_gain", "sensor_nonlinearity", 7003
SAMPLES = 2000


@dataclass(frozen=True, eq=False)
class Loop:
    first: psa.Record
    ambiguous: psa.StackDiagnosis
    design: Separated
    named: psa.StackDiagnosis


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
    play_again(truth, SEED, played, (design.record.time, design.record.columns["voltage"]))
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
    _, colours = noise_of_fit(best)
    for contender in d.contenders:
        rival = rival_of_fit(contender.effect, contender.fit, colours)
        gain = psa.EFFECTS[contender.effect].gain or ""
        model, start = rival.moved(rival.truth)
        fitted = rival.model.values[gain]
        assert 0.2 < model.values[gain] / fitted < 1.0
        assert not any(start.values())
        assert rival.less is not None
        # as likely as the data at hand make one standard error
        assert 0.0 < rival.less @ rival.known @ rival.less < 1.001
    base = rival_of_fit("base", d.base_fit, colours)
    assert not np.any(base.truth)


@slow
def test_the_designed_record_is_like_the_first_and_reveals_more_than_a_sine(loop: Loop) -> None:
    design, first = loop.design, loop.first
    assert design.record.n == first.n
    assert design.record.sample_time == pytest.approx(first.sample_time)
    assert excess(design.record, design.limits["voltage"], None) == []
    assert design.record.columns["voltage"].min() >= first.voltage.min() - 1e-9
    assert design.record.columns["voltage"].max() <= first.voltage.max() + 1e-9
    assert design.factor("sine") > 2.0
    assert design.factor("triangle") > 2.0
    assert min(design.chance.values()) > 0.9


@slow
def test_with_the_designed_record_the_cause_is_named(loop: Loop) -> None:
    d = loop.named
    assert d.verdict in ("cause_named", "partly_explained")
    assert d.causes[0].effect == HIDDEN
    assert d.causes[0].cannot_be_told_from == ()
    with pytest.raises(psa.InputError, match="nothing to separate"):
        resolving_experiment(d)


@slow
def test_the_command_writes_the_record_and_reports_it(
    loop: Loop, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The design itself is the one above: here only what becomes of it."""
    monkeypatch.setattr(experiment, "resolving_experiment", lambda d, **_: loop.design)
    path = command.next_voltage(tmp_path / "diagnosis.json")
    assert path == tmp_path / "diagnosis_next.csv"
    d = files.with_next(loop.ambiguous, path, lambda _: None)
    statement = json.loads(d.to_json())["next_experiment"]
    assert statement["voltage_csv"] == str(path)
    assert set(statement["separates"]) == set(statement["chance"]) == {HIDDEN, RIVAL}
    assert str(path) in " ".join(psa.story(d, width=400).split())
    record = psa.read_record(path, need_displacement=False)
    np.testing.assert_array_equal(record.voltage, loop.design.record.columns["voltage"])
    assert files.with_next(loop.named, path, lambda _: None) is loop.named
    assert files.with_next(loop.ambiguous, None, lambda _: None) is loop.ambiguous
