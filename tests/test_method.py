"""The parts of the method that its negative controls leave out, and how controls are counted."""

from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np
import pytest

from psa_casadi.components import BASE
from psa_casadi.diagnosis.search.fits import to_end, with_cause
from psa_casadi.diagnosis.search.hypothesis import (
    Hypothesis,
    Scale,
    View,
    examine,
    held_out_confirms,
    hypothesis,
    in_character,
    scale_of,
)
from psa_casadi.diagnosis.search.known import Known
from psa_casadi.diagnosis.task import STEPS, Method, Task, Thresholds, thresholds, using
from psa_casadi.effects import EFFECTS
from psa_casadi.identification.fitting.fit import Fit, fit
from psa_casadi.model.compose import compose
from psa_casadi.records import Record
from psa_casadi.records.split import Experiment, judging, split
from psa_casadi.simulation.side_by_side import VARIABLE, side_by_side
from psa_casadi.simulation.simulate import simulate
from tests.benchmarks.ablation import (
    ablation_table,
    moved_constants,
    several_table,
    without_steps,
)
from tests.benchmarks.hidden_cases import Case, Found

NAMES = ("slow_creep", "current_limit", "sensor_nonlinearity")


@pytest.fixture(scope="module")
def fitted() -> tuple[Fit, tuple[Experiment, ...]]:
    """A short record with a drift that the base lacks."""
    time = np.linspace(0.0, 2.0, 600)
    voltage = 40.0 * (1.0 - np.cos(2 * np.pi * time))
    model = compose(BASE)
    clean = simulate(model, time, voltage).displacement
    noise = 2e-3 * np.ptp(clean) * np.random.default_rng(4).standard_normal(time.size)
    bent = 0.02 * np.ptp(clean) * (time / time[-1]) ** 2
    experiments = (
        split(Record(name="r", time=time, voltage=voltage, displacement=clean + bent + noise)),
    )
    return fit(model, experiments, ["k_L"], sigma=[float(np.std(noise))]), experiments


def _seen(
    fitted: tuple[Fit, tuple[Experiment, ...]],
    method: Method | None = None,
    names: Sequence[str] = NAMES,
) -> View:
    found, experiments = fitted
    table = tuple(EFFECTS[n] for n in names)
    plain = hypothesis((), found, experiments)
    assert plain is not None
    return examine(plain, Task(experiments, table, method or Method()))


def _scores(fitted: tuple[Fit, tuple[Experiment, ...]], *without: str) -> dict[str, float]:
    seen = _seen(fitted, Method(frozenset(without)))
    scores = {n: s.decrease for n, s in seen.screening.best_by_effect().items()}
    return {**scores, "correlation": float(np.sum(seen.screening.colour.autoregression[0]))}


@pytest.fixture(scope="module")
def creeping(
    fitted: tuple[Fit, tuple[Experiment, ...]],
) -> tuple[Hypothesis, Hypothesis, Scale, tuple[Experiment, ...]]:
    """The base, a slow creep beside it, the scale of their scores."""
    _, experiments = fitted
    seen = _seen(fitted, names=("slow_creep",))
    quick = with_cause(seen.of, experiments, seen.starts_of("slow_creep"))
    assert quick is not None
    return (
        seen.of,
        to_end(quick, experiments),
        scale_of(seen.of, seen.screening.colour, 8.0, experiments),
        experiments,
    )


Creeping = tuple[Hypothesis, Hypothesis, Scale, tuple[Experiment, ...]]


def test_the_score_is_the_evidence_less_the_price_of_the_causes(creeping: Creeping) -> None:
    plain, creep, scale, _ = creeping
    assert scale.score(plain) == pytest.approx(0.0)
    n = len(plain.fit.residuals)
    sums = [np.sum(scale.colour.whiten(h.fit.residuals) ** 2) for h in (plain, creep)]
    gained = 0.5 * n * float(np.log(sums[0] / sums[1]))
    assert 0.0 < scale.evidence(creep) < gained
    held = scale.held / scale.colour.inflation * np.log(plain.holdout_rms / creep.holdout_rms)
    assert held > 0.0
    assert scale.held_out(creep, plain) == pytest.approx(held)
    assert scale.score(creep) == pytest.approx(scale.evidence(creep) - 8.0 + held)
    for fitted_alone in (replace(scale, held=0), replace(scale, judge_only=True)):
        assert fitted_alone.score(creep) == pytest.approx(scale.of_fitted(creep))
        assert fitted_alone.score(creep) == pytest.approx(scale.evidence(creep) - 8.0)


def test_a_fit_that_will_stay_above_the_goal_is_not_final(
    fitted: tuple[Fit, tuple[Experiment, ...]], creeping: Creeping
) -> None:
    """It may be taken up again, and ends where it would have ended."""
    _, creep, _, experiments = creeping
    seen = _seen(fitted, names=("slow_creep",))
    quick = with_cause(seen.of, experiments, seen.starts_of("slow_creep"))
    assert quick is not None
    assert creep.final
    assert to_end(quick, experiments, 1.01 * creep.fit.cost).final
    behind = to_end(quick, experiments, 0.5 * creep.fit.cost)
    assert not behind.final
    assert to_end(behind, experiments).fit.cost == pytest.approx(creep.fit.cost, rel=1e-3)


def test_records_that_are_held_out_whole_judge_and_do_not_choose(creeping: Creeping) -> None:
    plain, _, scale, experiments = creeping
    whole = judging(experiments[0].record)
    assert not scale.judge_only
    assert scale_of(plain, scale.colour, 8.0, [*experiments, whole]).judge_only


def test_held_out_data_speak_against_what_they_do_not_show(creeping: Creeping) -> None:
    """They must show what they can show, and all samples together must favour a cause."""
    plain, creep, scale, experiments = creeping
    assert held_out_confirms(creep, plain, experiments, scale)
    worse = replace(creep, holdout_rms=1.02 * plain.holdout_rms)
    assert not held_out_confirms(worse, plain, experiments, scale)
    faint = [p + 0.01 * (c - p) for p, c in zip(plain.predicted, creep.predicted, strict=True)]
    hardly = replace(creep, predicted=tuple(faint), holdout_rms=plain.holdout_rms)
    assert held_out_confirms(hardly, plain, experiments, scale)
    dear = replace(scale, price=scale.evidence(creep))
    assert held_out_confirms(creep, plain, experiments, dear)
    assert not held_out_confirms(hardly, plain, experiments, dear)


def test_what_held_out_data_reject_is_not_the_answer_but_may_lack_a_cause(
    creeping: Creeping,
) -> None:
    plain, creep, _, experiments = creeping
    known = Known(plain.fit, Task(experiments, (EFFECTS["slow_creep"],)))
    assert known.rejected() == []
    known.note(creep)
    assert known.best().names == creep.names
    assert known.rejected() == []
    known.found[creep.names] = worse = replace(creep, holdout_rms=1.02 * plain.holdout_rms)
    assert known.best().names == plain.names
    assert known.rejected() == [worse]


def test_held_out_data_choose_where_fitted_ones_cannot(creeping: Creeping) -> None:
    """They count as the fitted ones do, in what ranks first and between minima of one set."""
    plain, creep, _, experiments = creeping
    known = Known(plain.fit, Task(experiments, (EFFECTS["slow_creep"],)))
    other = replace(creep, causes=(EFFECTS["ageing"],), holdout_rms=1.1 * creep.holdout_rms)
    known.note(other)
    known.note(creep)
    assert known.scale.of_fitted(creep) == known.scale.of_fitted(other)
    assert [h.names for h in known.ranked()][:2] == [creep.names, other.names]
    known.note(replace(creep, holdout_rms=0.9 * creep.holdout_rms))
    kept = known.get(creep.names)
    assert kept is not None  # the same minimum
    assert kept.holdout_rms == creep.holdout_rms
    worse = replace(plain, causes=creep.causes)
    assert known.replaces(creep, worse)
    assert not known.replaces(worse, creep)
    samples = known.scale.held / known.scale.colour.inflation
    factor = float(np.exp(1.1 * known.scale.evidence(creep) / samples))
    assert not known.replaces(replace(creep, holdout_rms=factor * plain.holdout_rms), worse)


def test_a_parameter_at_its_bound_is_out_of_character(creeping: Creeping) -> None:
    _, creep, _, experiments = creeping
    (cause,) = creep.causes
    assert in_character(creep.fit, cause, experiments)
    low, _ = creep.fit.model.parameter("creep_time").bounds
    model = creep.fit.model.with_values({"creep_time": low})
    assert not in_character(replace(creep.fit, model=model), cause, experiments)


def test_an_end_that_is_a_limit_of_the_law_is_in_character(creeping: Creeping) -> None:
    """One pole of a lag, a sharp jump, a thermometer on the ceramic: lower ends, not upper ones."""
    _, creep, _, experiments = creeping
    limits = {("drive_lag", "drive_lag_shape"), ("sensor_jump", "jump_width")}
    limits |= {("temperature", "temperature_lag")}
    assert {(e.name, p.name) for e in EFFECTS.values() for p in e.parameters if p.limit} == limits
    for name, parameter in limits:
        effect = EFFECTS[name]
        extended = creep.fit.model.with_effect(effect)
        for end, fits in zip(extended.parameter(parameter).bounds, (True, False), strict=True):
            model = extended.with_values({parameter: end})
            assert in_character(replace(creep.fit, model=model), effect, experiments) is fits


def test_a_hum_where_the_stack_rings_is_out_of_character(creeping: Creeping) -> None:
    """Within the width of a sharp resonance, 2 % of its frequency on each side at a ratio of 0.01;
    a damped one hides no line of the mains.
    """
    _, creep, _, experiments = creeping
    hum, omega = EFFECTS["mains_hum"], 2.0 * np.pi * 1600.0
    stiffness = creep.fit.model.values["k_P"]
    for ratio, frequency, fits in (
        (0.01, 1601.0, False), (0.01, 1625.0, False), (0.01, 1640.0, True), (0.2, 1601.0, True),
    ):  # fmt: skip
        ringing = {"m_P": stiffness / omega**2, "c_P": 2.0 * ratio * stiffness / omega}
        model = creep.fit.model.with_values(ringing)
        model = model.with_effect(hum, {"hum_gain": 1e-9, "hum_frequency": frequency})
        assert in_character(replace(creep.fit, model=model), hum, experiments) is fits


def test_a_ripple_that_hardly_repeats_is_out_of_character(creeping: Creeping) -> None:
    """With less than two periods over the displacement it is a bent curve."""
    _, creep, _, experiments = creeping
    ripple = EFFECTS["sensor_ripple"]
    widest = max(e.record.range_m for e in experiments)
    for periods, fits in ((1.5, False), (3.0, True)):
        values = {"ripple_gain": 1e-9, "ripple_period": widest / periods}
        model = creep.fit.model.with_effect(ripple, values)
        assert in_character(replace(creep.fit, model=model), ripple, experiments) is fits


def test_without_finite_steps_an_effect_with_a_threshold_is_not_seen(
    fitted: tuple[Fit, tuple[Experiment, ...]],
) -> None:
    assert "current_limit" in _scores(fitted)
    assert "current_limit" not in _scores(fitted, "finite steps")


def test_the_residual_alone_takes_what_is_missing_for_the_colour_of_noise(
    fitted: tuple[Fit, tuple[Experiment, ...]],
) -> None:
    own, alone = _scores(fitted), _scores(fitted, "remainder")
    assert alone["correlation"] > own["correlation"] + 0.3
    assert alone["slow_creep"] < 0.5 * own["slow_creep"]


def _found(effect: str, named: tuple[str, ...], kind: str = "known", seed: int = 1) -> Found:
    case = Case(kind, effect, seed)  # type: ignore[arg-type]  # the kinds below are those it knows
    return Found(
        case,
        1.0,
        "cause_named" if named else "unexplained",
        named,
        named,
        (),
        0.9,
        {},
        {},
        1.0,
        1.0,
    )


def test_what_a_step_is_good_for_shows_in_the_ablation() -> None:
    """Without the finite steps all three effects are taken for backlash; nothing else changes."""
    whole = [_found(n, (n,)) for n in NAMES]
    whole.append(replace(_found("dry_friction", (), "foreign", 9), patched=0.75))
    worse = [replace(f, named=("backlash",), within=("backlash",)) for f in whole[:3]]
    asked: list[Method] = []

    def diagnosed(_: Sequence[Case], method: Method) -> list[Found]:
        asked.append(method)
        return [*worse, whole[3]] if "finite steps" in method.without else whole

    table = ablation_table("", without_steps(), whole, diagnosed).table
    rows = {row[0]: row[1:] for row in table.rows}
    assert asked == [Method(frozenset({step})) for step in STEPS]
    right = ("3 of 3", "3 of 3", "0 of 4", "0 of 0", "75 % of 1", "1.0")
    assert rows["the method"] == (*right, "")
    for step in STEPS:
        if step != "finite steps":
            assert rows[f"without {step}"] == (*right, "0 of 4")
    wrong = ("0 of 3", "0 of 3", "3 of 4", "0 of 0", "75 % of 1", "1.0", "3 of 4")
    assert rows["without finite steps"] == wrong


def test_what_sets_of_causes_are_good_for_shows_in_the_ablation() -> None:
    """Cases that do not show their causes do not count."""
    case = Case("two", NAMES[0], 1, (1.0, 3.0), (NAMES[1],))
    both = replace(_found(NAMES[0], NAMES[:2]), case=case, rho=2.0)
    one = replace(both, named=NAMES[:1], within=NAMES[:1], ratio=2.0)

    def diagnosed(_: Sequence[Case], method: Method) -> list[Found]:
        return [both, one if method.without else both, replace(both, rho=0.5, ratio=9.0)]

    rows = [row[1:] for row in several_table([], diagnosed).table.rows]
    every = ("100 % (2 of 2)", "100 % (2 of 2)", "1.000, 1.00", "1")
    assert rows == [every, ("50 % (1 of 2)", "50 % (1 of 2)", "1.500, 2.00", "1")]


def test_every_constant_is_moved_and_a_diagnosis_uses_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    moved = moved_constants()
    assert {name.split(" = ")[0] for name in moved} == {f.name for f in fields(Thresholds)}
    assert len(fields(Thresholds)) <= 25
    assert moved["price = 16"].thresholds.price == 16.0
    assert thresholds() == Thresholds()
    for threads in ("1", "2"):
        monkeypatch.setenv(VARIABLE, threads)
        with using(Thresholds(price=3.0)):
            assert side_by_side(lambda _: thresholds().price, range(4)) == [3.0] * 4
    assert thresholds().price == 8.0
