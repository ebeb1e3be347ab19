"""The search: exchanges, interruption, records of different kinds at once, warnings."""

import threading
import time
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.signal import lfilter

from psa_casadi.common.units import FloatArray
from psa_casadi.identification.fitting import fit as fitting
from psa_casadi.identification.identify import StackIdentification, identify
from psa_casadi.identification.mechanics import exchanges
from psa_casadi.identification.search import fit_base
from psa_casadi.identification.start.ordinary import starting_model
from psa_casadi.records import Record
from psa_casadi.records.split import split
from tests.model.stack_models import stack_values
from tests.studies.benchmarks.coverage import one_run
from tests.studies.benchmarks.records import clean_loops, with_noise
from tests.tiers import slow

pytestmark = pytest.mark.xdist_group("search")


@slow
def test_a_stack_is_identified_from_its_records_alone() -> None:
    """Step, loops and multisine of the reference with 0.1 % noise, without a start."""
    run = one_run("PTBS200", 3)
    assert run.converged
    assert run.rms_ratio == pytest.approx(1.0, abs=0.05)
    assert all(run.white)
    table = {q.name: q for q in run.determined}
    assert {"k_L", "A", "beta", "gamma", "delta", "n"} <= set(table)
    for name_of, limit in {"k_L": 0.01, "A": 0.01, "n": 0.05, "beta": 0.05}.items():
        assert table[name_of].value == pytest.approx(table[name_of].truth, rel=limit), name_of
    assert sum(not q.covered for q in table.values()) <= 2
    assert all(q.errors_off < 4.5 for q in table.values())


def test_no_resonance_beyond_a_record_follows_its_creep() -> None:
    """Steps at 1 kHz, creep that the base lacks: masses free at 16 kHz, they ended at 1.0 kHz."""
    time = 1e-3 * np.arange(3000.0)
    voltage = np.where(time < 1.5, 60.0 * (1.0 - np.cos(4.0 * np.pi * time)), 80.0)
    voltage[time > 2.2] = 30.0
    hysteresis = [0.0]
    for change in np.diff(voltage):
        h = hysteresis[-1]
        hysteresis.append(h + 0.25 * change - 0.02 * abs(change) * h - 0.005 * change * abs(h))
    x = 9.5e-8 * (voltage - hysteresis)
    decays = np.exp(-1e-3 / np.array([0.05, 0.2, 0.8, 3.2]))
    x += 0.02 * sum(lfilter([1.0 - q], [1.0, -q], x) for q in decays)
    x += 8e-9 * np.random.default_rng(0).standard_normal(x.size)
    record = Record(name="steps", time=time, voltage=voltage, displacement=x)
    base = fit_base(starting_model([record], None), (split(record),))
    assert not {"m_P", "m_B"} & set(base.unknowns.names)


def test_exchanging_twice_changes_nothing() -> None:
    p = stack_values("P-885.51")
    again = {}
    for what, values in exchanges(p):
        moved = {**p, **values}
        again[what] = {**moved, **dict(exchanges(moved)).get(what, {})}
    assert len(again) == 6  # two lags and two overdamped oscillators
    for what in ("drive lag and creep lag", "wafers and bonding layers"):
        for name, value in p.items():
            assert again[what][name] == pytest.approx(value, rel=1e-12), name
    assert len(list(exchanges(stack_values("PTBS200")))) == 2  # a ringing oscillator is no lag
    single = {k: v for k, v in p.items() if k not in ("k_P", "k_B")}
    assert [what for what, _ in exchanges(single)] == ["drive lag and creep lag"]


def _response(p: dict[str, float], frequency: FloatArray) -> FloatArray:
    """Displacement over force of creep lag, wafers and bonding layers, real and imaginary [m/N]."""
    s = 2j * np.pi * frequency
    parts = [1.0 / (p[f"k_{q}"] + p[f"c_{q}"] * s + p[f"m_{q}"] * s**2) for q in "PB"]
    both = (parts[0] + parts[1]) / (1.0 + p["tau"] * s)
    return np.concatenate([both.real, both.imag])


@pytest.mark.parametrize(("part", "other"), ["PB", "BP"])
def test_a_slow_pole_next_to_a_cancelled_zero_may_be_the_creep_lag(part: str, other: str) -> None:
    """With a creep lag that cancels the zero, the oscillator's slow pole is all that shows."""
    p = stack_values("demo")
    p |= {f"k_{part}": 3e8, f"c_{part}": 1e-3 * 3e8, f"m_{part}": 0.1, f"k_{other}": 5e7}
    slow, what = {**p, "tau": 1e-3 * 3e8 / 3.5e8}, {"P": "wafers", "B": "bonding layers"}[part]
    result = dict(exchanges(slow))[f"creep lag for the slow pole of the {what}"]
    moved = {**slow, **result}
    observed, f = _response(slow, np.zeros(1))[0], np.geomspace(1.0, 2e3, 50)
    np.testing.assert_allclose(
        _response(moved, f), _response(slow, f), rtol=0, atol=0.02 * observed
    )
    assert moved["tau"] == pytest.approx(1e-3)
    apart = {**slow, "tau": 1.2 * slow["tau"]}
    assert not [w for w, _ in exchanges(apart) if "slow pole" in w]


@cache
def loops() -> list[Record]:
    return with_noise(clean_loops(stack_values("P-885.51"))[2:4], 1e-3, seed=4)


@pytest.fixture(scope="module")
def identification() -> StackIdentification:
    return identify(loops())


def test_every_record_has_a_separate_noise_level() -> None:
    quiet, loud = with_noise(loops()[:1], 2e-3, 1)[0], loops()[1]
    result = identify([quiet, loud])
    first, second = (float(np.std(result.fit.residuals[result.fit.parts[r]])) for r in (0, 1))
    assert first > 1.5 * second
    assert result.fit.sigma == pytest.approx((first, second), rel=0.1)


def test_what_loops_leave_open_is_reported_in_words(identification: StackIdentification) -> None:
    assert identification.fit.converged
    lags = {"tau", "R_s", "c_P", "c_B"}
    assert lags & set(identification.determinacy.undetermined)
    assert any("determined by these records" in w for w in identification.warnings)
    assert any(lags & set(c.parameters) for c in identification.combinations)
    assert any("step" in a.sentence or "multisine" in a.sentence for a in identification.advice)
    assert any(s.agrees for s in identification.starts)


def test_an_interrupt_keeps_the_best_fit_so_far(monkeypatch: pytest.MonkeyPatch) -> None:
    objective, count = fitting.Objective, [0]

    def interrupted(*arguments):  # type: ignore[no-untyped-def]
        evaluate = objective(*arguments)

        def wrapped(theta):  # type: ignore[no-untyped-def]
            count[0] += 1
            if count[0] == 8:
                raise KeyboardInterrupt
            return evaluate(theta)

        return wrapped

    monkeypatch.setattr(fitting, "Objective", interrupted)
    begin = time.perf_counter()
    result = identify(loops()[:1])
    assert count[0] == 8  # nothing was evaluated after the interrupt
    assert result.fit.interrupted
    assert not result.fit.converged
    assert result.warnings[0].startswith("The search was interrupted")
    assert result.fit.rms < 0.2 * loops()[0].range_m
    assert time.perf_counter() - begin < 60.0
    assert threading.active_count() < 20


def test_drop_outs_and_outliers_do_not_move_the_fit(identification: StackIdentification) -> None:
    spoiled = []
    for k, r in enumerate(loops()):
        y = np.array(r.displacement)
        draw = np.random.default_rng(k)
        y[100 + draw.choice(r.n - 200, 12, replace=False)] += 0.2 * r.range_m
        y[300:340] = y[300]
        spoiled.append(replace(r, displacement=y))
    again = identify(spoiled)
    assert any("masked" in s for s in again.sentences)
    for name in ("k_L", "A", "n"):
        error = identification.determinacy.standard_errors[name]
        assert abs(again.model.values[name] - identification.model.values[name]) < 3.0 * error
    assert again.fit.rms == pytest.approx(identification.fit.rms, rel=0.05)
