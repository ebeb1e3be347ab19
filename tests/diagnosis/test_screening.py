"""The parts of screening: noise with a colour, spans of weights, trial sizes of effects."""

import numpy as np
import pytest
from scipy.stats import chi2

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.colour import Colour, OwnColour, colour_of, left_correlation, own_colour
from psa_casadi.diagnosis.noise import omnibus
from psa_casadi.diagnosis.probes import Span, residual_jumps
from psa_casadi.diagnosis.task import LIMITS
from psa_casadi.identification.fitting.fit import fit
from psa_casadi.records.noise import first_order_noise, uncertain
from psa_casadi.records.split import whole
from tests.studies.plants.noise import coloured
from tests.tiers import slow_but

N = 6000
TIME = np.linspace(0.0, 6.0, N, endpoint=False)
VOLTAGE = 50.0 * (1.0 - np.cos(2.0 * np.pi * TIME))


def noise(correlation: float, seed: int = 4) -> FloatArray:
    return coloured(np.random.default_rng(seed).standard_normal(N), correlation)


def test_white_noise_stays_white_whatever_is_slow_in_it() -> None:
    triangle = 2.0 * np.abs((TIME / 0.15) % 2.0 - 1.0)
    steps = np.sign(np.sin(2.0 * np.pi * 1.4 * TIME))
    tone = np.sin(2.0 * np.pi * 157.0 * TIME)
    for misfit in (0.0 * TIME, triangle, steps, tone):
        for seed in range(4):
            rms, result = first_order_noise(noise(0.0, seed) + misfit)
            assert result == 0.0
            assert rms == pytest.approx(1.0, rel=0.06)


@pytest.mark.parametrize("correlation", slow_but([0.0, 0.6], [0.0, 0.3, 0.6, 0.85]))
def test_a_colour_survives_the_projection_of_slow_directions(correlation: float) -> None:
    """A hundred slow waves taken out of 3,000 samples leave 0.54 of a correlation of 0.6."""
    n, rng = 3000, np.random.default_rng(6)
    waves = np.cos(np.pi * np.outer(np.linspace(0.0, 1.0, n), np.arange(100)))
    basis = np.linalg.qr(waves)[0]
    result, plain = [], []
    for _ in range(10):
        e = coloured(rng.standard_normal(n + 200), correlation)[200:]
        left = e - basis @ (basis.T @ e)
        plain.append(float(left[1:] @ left[:-1] / (left @ left)))
        result.append(float(np.sum(colour_of(left, [n // 2] * 2, None, basis).autoregression[0])))
    assert np.mean(result) == pytest.approx(correlation, abs=0.015)
    assert np.mean(plain) < correlation - 0.03
    halves = list(np.split(basis, 2))
    assert left_correlation(correlation, halves) == pytest.approx(np.mean(plain), abs=0.015)


def test_directions_taken_out_of_few_samples_do_not_lower_the_noise() -> None:
    n, rng = 150, np.random.default_rng(7)
    basis = np.linalg.qr(rng.standard_normal((n, 100)))[0]
    drawn = [rng.standard_normal(n) for _ in range(40)]
    levels = [colour_of(e - basis @ (basis.T @ e), [n], [np.zeros(0)], basis).level for e in drawn]
    assert np.mean(levels) == pytest.approx(1.0, abs=0.06)


@pytest.mark.parametrize(("correlation", "n"), [(0.0, 4000), (0.6, 5000), (0.75, 3000)])
def test_the_power_of_noise_is_as_uncertain_as_draws_of_it_show(correlation: float, n: int) -> None:
    rng = np.random.default_rng(8)
    drawn = [coloured(rng.standard_normal(n + 200), correlation)[200:] for _ in range(60)]
    powers = [first_order_noise(e)[0] ** 2 for e in drawn]  # capped by what the draw really has
    statement = float(np.median([uncertain(e) for e in drawn]))
    assert 0.5 * statement < float(np.std(powers)) < 1.5 * statement


def _size_test(
    residual: FloatArray, *, residual_colour: bool = False, lengths: tuple[int, ...] = (N,)
) -> float:
    colour = Colour(tuple(np.zeros(0) for _ in lengths), 1.0, lengths)
    return omnibus(
        residual,
        VOLTAGE,
        TIME,
        colour,
        1.0,
        lengths=lengths,
        detection_limit=0.0,
        from_residual=residual_colour,
        alarms_below=1e-3,
    ).p_value


def test_noise_of_one_size_is_no_misfit_and_noise_after_reversals_only_is() -> None:
    """Noise whose size follows the reversals is significant unless the colour is the residual's."""
    quiet = [_size_test(noise(0.0, seed)) for seed in range(20)]
    assert min(quiet) > 1e-3
    after = 1.0 + np.exp(-((TIME % 0.5) / 0.05))
    assert _size_test(after * noise(0.0)) < 1e-6
    assert _size_test(after * noise(0.0), residual_colour=True) > 1e-3


def _colour(error: FloatArray, columns: FloatArray, rate: FloatArray) -> OwnColour:
    """The colour of an error with a gap, of which the last fifth is held out."""
    used, held = np.arange(N) < 0.8 * N, np.arange(N) >= 0.8 * N
    used[1000:1010] = False
    prior = np.full(columns.shape[1], np.inf)
    return own_colour([error], [used], [held], columns[used], prior, [rate])


@pytest.mark.parametrize("correlation", [0.0, 0.6, 0.95])
def test_a_residual_has_the_colour_that_made_it(correlation: float) -> None:
    result = _colour(noise(correlation), np.zeros((N, 0)), np.zeros(N))
    assert result.runs == (1000, 3790)
    assert result.level == pytest.approx(np.sqrt(1.0 - correlation**2), rel=0.04)
    assert np.std(result.ahead) == pytest.approx(result.level, rel=0.06)
    assert float(np.sum(result.autoregression)) == pytest.approx(correlation, abs=0.05)
    assert result.colour.whiten(result.residuals).std() == pytest.approx(result.level, rel=0.02)


def test_slow_waves_are_no_evidence_next_to_a_random_walk() -> None:
    """With white noise the evidence for them would be hundreds of nats."""
    walk = np.cumsum(np.random.default_rng(3).standard_normal(N))
    waves = np.cos(np.pi * np.outer(np.linspace(0.0, 1.0, N), np.arange(8)))
    left = [walk - w @ np.linalg.lstsq(w, walk, rcond=None)[0] for w in (waves[:, :4], waves)]
    few, more = (
        _colour(e, w, np.zeros(N)) for e, w in zip(left, (waves[:, :4], waves), strict=True)
    )
    assert few.level == pytest.approx(1.0, rel=0.03)
    assert more.nats() - few.nats() < 12.0
    assert 0.5 * N * np.log(np.var(left[0]) / np.var(left[1])) > 250.0


def test_the_noise_of_a_clock_that_jitters_grows_with_the_rate() -> None:
    rng, rate = np.random.default_rng(5), np.abs(np.gradient(VOLTAGE))
    rate = rate / np.sqrt(np.mean(rate**2))
    error = rng.standard_normal(N) + 3.0 * rate * rng.standard_normal(N)
    result = _colour(error, np.zeros((N, 0)), rate)
    assert result.spread is not None
    assert result.nats() > _colour(error, np.zeros((N, 0)), np.ones(N)).nats() + 300.0
    white = result.colour.whiten(result.residuals)
    fast = rate[np.r_[0:1000, 1010 : int(0.8 * N)]] > 1.0
    assert white[fast].std() == pytest.approx(white[~fast].std(), rel=0.08)
    even = [_colour(noise(0.0, k), np.zeros((N, 0)), rate).spread for k in range(20)]
    assert even == [None] * 20


def test_noise_passes_the_threshold_no_more_often_than_along_one_direction() -> None:
    """In 0.5 % of 40,000 draws, of any number of weights; hardly visible ones do not count."""
    rng = np.random.default_rng(3)
    level = chi2.isf(LIMITS.false_alarm, 1)
    for size in (1, 3, 9):
        unit, _ = np.linalg.qr(rng.standard_normal((50, size)))
        for norms in (np.full(size, 30.0), np.geomspace(30.0, 1e-3, size)):
            span = Span(unit.T @ unit, norms, LIMITS.false_alarm)
            drawn = span.decrease(rng.standard_normal((40_000, 50)) @ unit)
            assert np.mean(drawn > level) < 0.0065
        assert np.mean(Span(unit.T @ unit, np.full(size, 30.0), LIMITS.false_alarm).decrease(
            rng.standard_normal((40_000, 50)) @ unit) > level) > 0.0035  # fmt: skip


def _loops() -> tuple[FloatArray, FloatArray]:
    t = np.linspace(0.0, 4.0, 4001)
    return t, 50.0 - 40.0 * np.cos(2 * np.pi * t) * (1.0 - 0.15 * t)


@pytest.mark.parametrize("share", [0.2, 0.5, 0.85])
def test_the_place_of_a_jump_is_read_off_the_residual(share: float) -> None:
    """Under noise as large as half the jump; in the model's displacement, whatever the offset."""
    model = psa.compose(psa.BASE)
    t, voltage = _loops()
    x = psa.simulate(model, t, voltage).displacement
    noise = 1e-8 * np.random.default_rng(4).standard_normal(t.size)
    place = float(x.min() + share * np.ptp(x))
    reading = x + 2e-8 * (x > place) + noise + 3e-6
    experiments = (whole(psa.Record(name="r", time=t, voltage=voltage, displacement=reading)),)
    places = residual_jumps(fit(model, experiments, ["k_L", "A"], sigma=[2e-8]))
    assert min(abs(p - place) for p in places) < 0.01 * np.ptp(x)
