"""Effects that are linear in weights are looked for with all of their weights at once."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.stats import chi2

from psa_casadi.components import BASE
from psa_casadi.diagnosis.colour import Colour
from psa_casadi.diagnosis.probes import Direction, Span, combined, directions, spans
from psa_casadi.diagnosis.screening import Score, Screening, screen
from psa_casadi.diagnosis.task import thresholds
from psa_casadi.effects import EFFECTS
from psa_casadi.identification.fitting.fit import Fit, fit
from psa_casadi.model.compose import compose
from psa_casadi.records.record import Record
from psa_casadi.records.split import whole
from psa_casadi.simulation.simulate import simulate
from psa_casadi.units import FloatArray

MEMORY = EFFECTS["hysteresis_memory"]
WEIGHTS = MEMORY.linear
SAMPLES, NOISE = 800, 0.1
COLOUR = Colour((np.array([0.3]),), NOISE, (SAMPLES,))
#: Standard deviation of a weight's prior, in ordinary sizes.
WIDTH = 10.0


def _sizes() -> dict[str, float]:
    return {
        n: cast("float", next(p.scale for p in MEMORY.parameters if p.name == n)) for n in WEIGHTS
    }


def _case(seed: int) -> tuple[Fit, list[Direction], FloatArray, FloatArray]:
    """A base of two columns; a span at two thresholds and a creep, drawn at random."""
    rng = np.random.default_rng(seed)
    base = rng.standard_normal((SAMPLES, 2))
    columns = rng.standard_normal((SAMPLES, 2 * len(WEIGHTS) + 1))
    columns[:, 3] = columns[:, 1] + 1e-3 * columns[:, 3]  # two weights that hardly differ
    sizes, own = _sizes(), []
    for k, threshold in enumerate((0.015, 0.12)):
        for j, name in enumerate(WEIGHTS):
            column = columns[:, k * len(WEIGHTS) + j]
            values = {"memory_threshold": threshold, name: sizes[name]}
            own.append(Direction(MEMORY, values, ({},), 1.0, column, False, False, (), name))
    own.append(Direction(EFFECTS["slow_creep"], {}, ({},), 0.03, columns[:, -1], False, False))
    residual = columns[:, 1] - 2.0 * columns[:, 7] + 3.0 * columns[:, -1] + base @ [4.0, -1.0]
    residual = residual + NOISE * rng.standard_normal(SAMPLES)
    of = cast("Fit", cast("Any", SimpleNamespace(jacobian=base, residuals=residual, further=())))
    return of, own, base, residual


def _ridge(base: FloatArray, columns: FloatArray, residual: FloatArray) -> tuple[FloatArray, float]:
    """Least squares with rows for the prior, and the decrease of the sum over the noise's power."""
    w = COLOUR.whiten(np.column_stack([base, columns])) / NOISE
    r = COLOUR.whiten(residual) / NOISE
    m, n = base.shape[1], columns.shape[1]
    prior = np.hstack([np.zeros((n, m)), np.eye(n) / WIDTH])
    rows, right = np.vstack([w, prior]), np.concatenate([r, np.zeros(n)])
    theta = np.linalg.lstsq(rows, right, rcond=None)[0]
    start = np.linalg.lstsq(w[:, :m], r, rcond=None)[0]
    left = np.sum((right - rows @ theta) ** 2)
    return theta[m:], float(np.sum((r - w[:, :m] @ start) ** 2) - left)


def _of_memory(found: Screening) -> list[Score]:
    return [s for s in found.scores if s.direction.effect is MEMORY]


def test_a_span_is_scored_at_the_weights_that_fit_best() -> None:
    of, own, base, residual = _case(1)
    assert [len(p) for p in spans(own)] == [len(WEIGHTS), len(WEIGHTS), 1]
    scores = _of_memory(screen(of, own, [SAMPLES], colour=COLOUR))
    assert len(scores) == 2
    for score in scores:
        span = [
            d
            for d in own[:-1]
            if d.values["memory_threshold"] == score.direction.values["memory_threshold"]
        ]
        gains, decrease = _ridge(base, np.column_stack([d.column for d in span]), residual)
        weights = [score.direction.values[n] for n in WEIGHTS]
        assert np.array(weights) == pytest.approx(
            gains * list(_sizes().values()), rel=1e-5, abs=1e-6
        )
        assert score.start == 1.0
        surplus = chi2.isf(thresholds().false_alarm, 9) - chi2.isf(thresholds().false_alarm, 1)
        assert score.decrease == pytest.approx(decrease - surplus, rel=1e-3)
        shown = np.column_stack([d.column for d in span]) @ gains
        assert score.direction.column == pytest.approx(shown, rel=1e-5, abs=1e-6)


def test_noise_passes_the_threshold_no_more_often_than_along_one_direction() -> None:
    """In 0.5 % of 40,000 draws, of any number of weights; hardly visible ones do not count."""
    rng = np.random.default_rng(3)
    level = chi2.isf(thresholds().false_alarm, 1)
    for size in (1, 3, 9):
        unit, _ = np.linalg.qr(rng.standard_normal((50, size)))
        for norms in (np.full(size, 30.0), np.geomspace(30.0, 1e-3, size)):
            span = Span(unit.T @ unit, norms)
            drawn = span.decrease(rng.standard_normal((40_000, 50)) @ unit)
            assert np.mean(drawn > level) < 0.0065
        assert np.mean(Span(unit.T @ unit, np.full(size, 30.0)).decrease(
            rng.standard_normal((40_000, 50)) @ unit) > level) > 0.0035  # fmt: skip


def test_directions_of_weights_are_what_the_weights_add() -> None:
    """A span's columns, against the difference of two simulations at weights of ordinary size."""
    model = compose(BASE)
    t = np.linspace(0.0, 2.0, 1001)
    voltage = 50.0 - 45.0 * np.cos(2 * np.pi * 2.0 * t) * (1.0 - 0.3 * t)
    x = simulate(model, t, voltage).displacement
    experiments = (whole(Record(name="r", time=t, voltage=voltage, displacement=x)),)
    base = fit(model, experiments, ["k_L"], sigma=[1e-8])
    own = directions(base, experiments, [MEMORY])
    assert [len(p) for p in spans(own)] == [len(WEIGHTS)] * 2
    clean = simulate(base.model, t, voltage).displacement
    rng = np.random.default_rng(5)
    for places in spans(own):
        span = combined([own[k] for k in places], rng.uniform(-1.0, 1.0, len(places)))
        moved = base.model.with_effect(MEMORY, MEMORY.at_gain(span.unit_gain, span.values))
        added = simulate(moved, t, voltage).displacement - clean
        assert span.column == pytest.approx(added, abs=2e-3 * float(np.ptp(added)))
