"""What a measured current tells: capacitance and drive lag, without the mechanics."""

from dataclasses import replace

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi import reference
from psa_casadi.identification.start.electrical import drive_of
from psa_casadi.model.stacks import stack_model
from psa_casadi.records.record import Record
from psa_casadi.report.words.tables import parameter_table
from psa_casadi.units import FloatArray

STACK = stack_model("P-885.51")
C_P, R_S = STACK.values["C_p"], STACK.values["R_s"]


def _recorded(step: float, tones: tuple[float, ...], *, noise: float = 0.01) -> Record:
    """A record of the independent reference, whose current has noise and a zero of its own."""
    rng = np.random.default_rng(3)
    t = step * np.arange(1500.0)
    phases = rng.uniform(0.0, 6.28, len(tones))
    waves = [np.sin(2 * np.pi * f * t + p) for f, p in zip(tones, phases, strict=True)]
    voltage: FloatArray = 60.0 + 50.0 * np.sum(waves, axis=0) / len(tones)
    found = reference.simulate(
        STACK.values,
        lambda time: float(np.interp(time, t, voltage)),
        t,
        breakpoints=list(t),
        initial={"u": voltage[0]},
        rtol=1e-7,
    )
    current = found.current + noise * np.std(found.current) * rng.standard_normal(t.size)
    shown = found.displacement + 2e-9 * rng.standard_normal(t.size)
    return Record("r", t, voltage, shown, current=current + 0.003)


@pytest.fixture(scope="module")
def fast() -> Record:
    return _recorded(5e-6, (300.0, 1100.0, 2900.0, 7000.0))


def test_a_fast_current_tells_capacitance_and_lag(fast: Record) -> None:
    found = drive_of([fast])
    assert found is not None
    assert found.lag is not None
    assert found.capacitance == pytest.approx(C_P, abs=4.0 * found.capacitance_error)
    assert found.capacitance_error < 0.005 * C_P
    assert found.lag == pytest.approx(R_S * C_P, abs=4.0 * found.lag_error)
    assert found.lag_error < 0.1 * R_S * C_P
    assert "C_p =" in found.sentence
    assert "R_s C_p =" in found.sentence


def test_several_records_have_each_its_zero(fast: Record) -> None:
    assert fast.current is not None
    second = replace(fast.slice(0, 900), current=fast.current[:900] - 0.05)
    found = drive_of([fast, second])
    assert found is not None
    assert found.capacitance == pytest.approx(C_P, rel=0.005)


def test_a_slow_current_tells_the_capacitance_alone() -> None:
    found = drive_of([_recorded(1e-3, (3.0, 11.0))])
    assert found is not None
    assert found.lag is None
    assert found.capacitance == pytest.approx(C_P, rel=0.01)
    assert "R_s C_p" not in found.sentence


def test_a_current_that_is_not_the_stack_s_tells_nothing(fast: Record) -> None:
    noise = np.random.default_rng(1).standard_normal(fast.n)
    assert drive_of([replace(fast, current=noise)]) is None
    assert drive_of([replace(fast, current=np.zeros(fast.n))]) is None
    assert drive_of([replace(fast, current=None)]) is None
    assert fast.current is not None
    assert drive_of([replace(fast, current=1e6 * fast.current)]) is None
    clipped = np.clip(fast.current, -0.01, 0.01) * np.sign(np.sin(np.arange(fast.n)))
    assert drive_of([replace(fast, current=clipped)]) is None


def test_an_identified_model_has_the_measured_capacitance_and_its_current(fast: Record) -> None:
    """Without the current the capacitance is assumed, and the simulated current as wrong."""
    found = psa.identify([fast])
    assert found.model.values["C_p"] == pytest.approx(C_P, rel=0.01)
    for name, true in (("C_p", C_P), ("R_s", R_S)):
        interval = found.model.provenance.intervals[name]
        assert interval.low < found.model.values[name] < interval.high
        assert interval.low * 0.9 < true < interval.high * 1.1
    assert "R_s" not in found.fit.unknowns.names
    rows = {row[0]: row for row in parameter_table(found.model, found).rows}
    assert [rows[n][4] for n in ("C_p", "R_s", "k_L")] == ["current", "current", "fit"]
    assert any("measured current" in n for n in found.model.provenance.notes)
    simulated = psa.simulate_record(found.model, fast).outputs["current"]
    assert fast.current is not None
    later = slice(200, None)
    wrong = (simulated - fast.current)[later]
    assert np.std(wrong) < 0.05 * np.std(fast.current[later])
