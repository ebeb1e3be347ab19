"""Block averages keep what a fit could use, and are not taken where they would not."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from psa_casadi.common.errors import InputError
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.identification import prepare
from psa_casadi.identification.identify import identify
from psa_casadi.model.effects import EFFECTS
from psa_casadi.records import Record, sine, split, time_grid
from psa_casadi.records.decimate import decimated
from psa_casadi.records.split import LEAST, MOST, PARTS, excerpts
from tests.studies.plants.base import simulate_base
from tests.studies.plants.stack import draw_stack
from tests.tiers import slow
from tests.voltages import steps

SLOPE, NOISE = 1e-7, 1e-8
N = 250_000
T = time_grid(25.0, 1e-4)


def white(seed: int, n: int = N) -> FloatArray:
    return np.random.default_rng(seed).standard_normal(n)


def curve(u: FloatArray) -> FloatArray:
    """Return the displacement of a bent loop without memory, for voltages of 0 to 100 V."""
    return np.asarray(SLOPE * (0.8 * u + 0.002 * u**2), dtype=float)


def loop(t: FloatArray = T, seed: int = 1, noise: float = NOISE) -> Record:
    u = sine(t, 0.0, 100.0, 0.05)
    y = curve(u) + noise * white(seed, t.size)
    return Record(name="loop", time=t, voltage=u, displacement=y)


def test_a_million_slow_samples_shrink_and_keep_their_content() -> None:
    record = loop(time_grid(100.0, 1e-4))
    small, q = decimated(record, NOISE, SLOPE)
    assert 32 <= q <= 500
    assert (record.n, small.n) == (1_000_000, 1_000_000 // q)
    middles = np.mean(record.time[: small.n * q].reshape(-1, q), axis=1)
    np.testing.assert_allclose(small.time, middles)
    exact = sine(small.time, 0.0, 100.0, 0.05)
    residual = np.asarray(small.displacement) - curve(exact)
    assert np.std(residual) == pytest.approx(NOISE / np.sqrt(q), rel=0.05)
    assert abs(np.mean(residual)) < 4 * NOISE / np.sqrt(record.n)
    assert np.max(np.abs(small.voltage - exact)) < 0.1 * NOISE / SLOPE
    short = np.polyfit(small.voltage, np.asarray(small.displacement), 2)
    full = np.polyfit(record.voltage, np.asarray(record.displacement), 2)
    spread = NOISE / np.sqrt(record.n) / np.array([30.0**2, 30.0, 1.0])
    assert np.all(np.abs(short - full) < 3 * spread)
    assert (small.name, small.source, small.sha256) == (record.name, record.source, record.sha256)


def test_a_ringing_step_is_not_touched() -> None:
    u = steps(T, [0.0, 100.0, 0.0, 100.0])
    for period in (10, 100, 1000):
        w, d = 2 * np.pi / period, 0.02
        a = [1.0, -2 * np.exp(-d * w) * np.cos(w), np.exp(-2 * d * w)]
        y = lfilter([sum(a)], a, SLOPE * u) + NOISE * white(3)
        small, q = decimated(Record(name="step", time=T, voltage=u, displacement=y), NOISE, SLOPE)
        assert q == 1
        assert small.n == N


@pytest.mark.parametrize("frequency", [1234.5, 100.0, 3700.0])
def test_a_tone_below_the_noise_is_kept(frequency: float) -> None:
    base = loop()
    y = np.array(base.displacement) + 0.05 * NOISE * np.sin(2 * np.pi * frequency * T)
    small, q = decimated(replace(base, displacement=y), NOISE, SLOPE)
    assert frequency < 0.5 / small.sample_time
    assert q < decimated(base, NOISE, SLOPE)[1]


def test_white_noise_of_the_voltage_is_no_reason_to_stop_and_fast_motion_is_none_to_go_on() -> None:
    base = loop()
    noisy = replace(base, voltage=base.voltage + 0.3 * white(8))
    assert decimated(noisy, NOISE, SLOPE)[1] == decimated(base, NOISE, SLOPE)[1]
    fast = sine(T, 0.0, 100.0, 500.0)
    record = Record(name="fast", time=T, voltage=fast, displacement=curve(fast) + NOISE * white(9))
    assert decimated(record, NOISE, SLOPE)[1] == 1


def test_missing_samples_move_nothing_and_stay_missing() -> None:
    base = loop()
    y, draw = np.array(base.displacement), np.random.default_rng(10)
    y[draw.random(N) < 0.2] = np.nan
    y[100_000:110_000] = np.nan
    small, q = decimated(replace(base, displacement=y), NOISE, SLOPE)
    assert q >= 16
    inside = (small.time > T[100_000] + q * 1e-4) & (small.time < T[110_000] - q * 1e-4)
    assert not small.mask[inside].any()
    assert small.mask[~inside].mean() > 0.99
    exact = curve(sine(small.time, 0.0, 100.0, 0.05))
    residual = (np.asarray(small.displacement) - exact)[small.mask]
    assert abs(np.mean(residual)) < 4 * NOISE / np.sqrt(0.8 * N)
    assert np.std(residual) == pytest.approx(NOISE / np.sqrt(0.8 * q), rel=0.1)


def test_short_uneven_and_planned_records() -> None:
    short = loop(time_grid(0.3999, 1e-4))
    assert short.n == 3999
    assert decimated(short, NOISE, SLOPE) == (short, 1)
    jitter = T + 2e-5 * np.random.default_rng(11).random(N)
    assert decimated(loop(jitter), NOISE, SLOPE)[1] == 1
    planned = Record(name="planned", time=T, voltage=sine(T, 0.0, 100.0, 0.05))
    small, q = decimated(planned, NOISE, SLOPE)
    assert q > 1
    assert small.displacement is None


def test_other_columns_are_averaged_and_a_sudden_load_is_kept() -> None:
    base = loop()
    wide = replace(base, current=1e-3 + 0.0 * T, temperature=293.0 + T, load_force=0.0 * T + 5.0)
    small, q = decimated(wide, NOISE, SLOPE)
    assert q > 1
    assert small.temperature is not None
    assert small.load_force is not None
    np.testing.assert_allclose(small.temperature, 293.0 + small.time, rtol=1e-12)
    np.testing.assert_allclose(small.load_force, 5.0)
    kicked = replace(base, load_force=np.where(T < 12.50005, 0.0, 5.0))
    assert decimated(kicked, NOISE, SLOPE)[1] == 1


def test_a_noise_or_slope_of_nothing_is_refused() -> None:
    for noise, slope in ((0.0, 1e-7), (-1.0, 1e-7), (np.nan, 1e-7), (1e-8, 0.0)):
        with pytest.raises(InputError, match="expected a positive number"):
            decimated(loop(time_grid(1.0, 1e-4)), noise, slope)
    record = loop(time_grid(100.0, 1e-3))
    assert decimated(record, NOISE, -SLOPE)[1] == decimated(record, NOISE, SLOPE)[1]


def night(n: int, rate: float = 100.0) -> Record:
    """Slow loops with one minute of fast ones, and one of steps, late in a record."""
    t = np.arange(n) / rate
    v = 50.0 - 50.0 * np.cos(2.0 * np.pi * 0.05 * t)
    fast, stepped = (t > 0.63 * t[-1]) & (t < 0.65 * t[-1]), (t > 0.83 * t[-1]) & (t < 0.85 * t[-1])
    v[fast] = 50.0 - 30.0 * np.cos(2.0 * np.pi * 5.0 * t[fast])
    v[stepped] = np.where(t[stepped] % 4.0 < 2.0, 20.0, 80.0)
    return Record(name="night", time=t, voltage=v, displacement=curve(v) + NOISE * white(3, n))


def test_parts_of_a_long_record_show_every_motion() -> None:
    record = night(1_000_000)
    parts, statement = excerpts([record])
    assert [p.n for p in parts] == [MOST // PARTS] * PARTS
    assert parts[0].time[0] == record.time[0]
    assert all(p.time[-1] < q.time[0] for p, q in pairwise(parts))
    rates = [np.max(np.abs(np.diff(p.voltage) / np.diff(p.time))) for p in parts]
    assert np.sum(np.array(rates) > 3000.0) == 1  # the steps
    assert np.sum((np.array(rates) > 500.0) & (np.array(rates) < 3000.0)) == 1  # the fast loops
    assert {p.sha256 for p in parts} == {record.sha256}
    assert "of 1000000 samples 4 parts of 50000 are used" in statement[0]
    assert f"{parts[1].time[0]:.4g} s" in statement[0]


def test_short_records_stay_whole_next_to_a_long_one() -> None:
    short, long = night(30_000), night(500_000)
    parts, statement = excerpts([long, short])
    assert parts[-1] is short
    assert sum(p.n for p in parts) <= MOST
    assert sum(p.n for p in parts[:-1]) > MOST - short.n - PARTS
    assert len(statement) == 1
    assert excerpts([short]) == ([short], [])
    many = [night(LEAST + k) for k in range(12)]
    assert [p.n for p in excerpts(many)[0][:2]] == [LEAST, LEAST // PARTS]


@slow
@pytest.mark.parametrize("command", [identify, partial(diagnose, effects=[EFFECTS["slow_creep"]])])
def test_parts_give_the_answer_of_the_whole_record(
    command: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The estimate from all samples is within the interval from the parts."""
    n, rng = 24_000, np.random.default_rng(5)
    t = np.arange(n) / 100.0
    v = np.interp(t, np.linspace(0, t[-1], 40), rng.uniform(20, 50, 40)) * (1 - np.cos(1.3 * t))
    stack = draw_stack(rng)
    v *= 0.9 * stack.u_rated / np.max(v)
    y = simulate_base(stack, t, v).displacement
    y += 5e-4 * np.ptp(y) * rng.standard_normal(n)
    record = Record(name="night", time=t, voltage=v, displacement=y)
    whole = command([record])
    monkeypatch.setattr(split, "MOST", 6_000)
    monkeypatch.setattr(split, "LEAST", 0)
    monkeypatch.setattr(prepare, "MOST", 6_000)
    parts = command([record])
    statement = parts.sentences if command is identify else parts.notes
    assert any("parts of 1500 are used" in s for s in statement)
    output = parts.model.provenance.intervals
    assert {"k_L", "A", "n"} <= set(output)
    for name in ("k_L", "A", "beta", "n"):
        assert output[name].low <= whole.model.values[name] <= output[name].high, name
