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
    scale_of,
)
from psa_casadi.diagnosis.task import STEPS, Method, Task, Thresholds, thresholds, using
from psa_casadi.effects import EFFECTS
from psa_casadi.identification.fitting.fit import Fit, fit
from psa_casadi.model.compose import compose
from psa_casadi.records import Record
from psa_casadi.records.split import Experiment, split
from psa_casadi.simulation.side_by_side import VARIABLE, side_by_side
from psa_casadi.simulation.simulate import simulate
from tests.studies.benchmarks.ablation import (
    ablation_table,
    moved_constants,
    without_steps,
)
from tests.studies.benchmarks.hidden_cases import Case, Found

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


def test_without_finite_steps_an_effect_with_a_threshold_is_not_seen(
    fitted: tuple[Fit, tuple[Experiment, ...]],
) -> None:
    assert "current_limit" in _scores(fitted)
    assert "current_limit" not in _scores(fitted, "finite steps")


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
