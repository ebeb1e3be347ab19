"""What a measured current tells: the capacitance, without the mechanics."""

from dataclasses import replace

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi import reference
from psa_casadi.identification.start.ordinary import capacitance_of
from psa_casadi.model.stacks import stack_model
from psa_casadi.records.record import Record
from psa_casadi.report.words.tables import parameter_table
from psa_casadi.units import FloatArray
from tests.tiers import slow

STACK = stack_model("P-885.51")
C_P = STACK.values["C_p"]


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
    return Record(name="r", time=t, voltage=voltage, displacement=shown, current=current + 0.003)


@pytest.fixture(scope="module")
def fast() -> Record:
    return _recorded(5e-6, (300.0, 1100.0, 2900.0, 7000.0))


def test_a_current_tells_the_capacitance(fast: Record) -> None:
    found = capacitance_of([fast])
    assert found is not None
    assert found.value == pytest.approx(C_P, abs=4.0 * found.error)
    assert found.error < 0.005 * C_P
    assert found.interval.low < found.value < found.interval.high
    assert "C_p =" in found.sentence(found.value)
    assert "keeps the 3 uF given" in found.sentence(3e-6)


@pytest.mark.parametrize("capacitance", [1e-8, 1.6e-6, 5e-5])
def test_a_slow_current_of_any_size_and_a_lossy_ceramic(capacitance: float) -> None:
    """A loss tangent of 3 % turns the current's phase; it makes no other capacitance of it."""
    t = np.linspace(0.0, 3.0, 3001)
    voltage = 50.0 - 40.0 * np.cos(2 * np.pi * t)
    omega, loss = 2 * np.pi, 0.03
    clean = capacitance * omega * 40.0 * (np.sin(omega * t) - loss * np.cos(omega * t))
    noise = 0.01 * np.std(clean) * np.random.default_rng(2).standard_normal(t.size)
    found = capacitance_of(
        [Record(name="r", time=t, voltage=voltage, displacement=None, current=clean + noise)]
    )
    assert found is not None
    assert found.value == pytest.approx(capacitance, rel=0.01)
    assert found.error < 0.01 * capacitance


@slow
def test_a_current_that_is_not_the_stack_s_tells_nothing(fast: Record) -> None:
    noise = np.random.default_rng(1).standard_normal(fast.n)
    assert fast.current is not None
    for current in (noise, np.zeros(fast.n), None, 1e6 * fast.current, -fast.current):
        assert capacitance_of([replace(fast, current=current)]) is None
    uneven = np.cumsum(np.where(np.arange(fast.n) % 2, 1.0, 3.0))
    assert capacitance_of([replace(fast, time=5e-6 * uneven)]) is None


@slow
def test_an_identified_model_has_the_measured_capacitance(fast: Record) -> None:
    """Without the current the capacitance is assumed, and the simulated current as wrong."""
    found = psa.identify([fast.slice(0, 700)])
    assert found.model.values["C_p"] == pytest.approx(C_P, rel=0.01)
    interval = found.model.provenance.intervals["C_p"]
    assert interval.low < found.model.values["C_p"] < interval.high
    assert any("measured current" in n for n in found.model.provenance.notes)
    rows = {row[0]: row for row in parameter_table(found.model, found).rows}
    assert [rows[n][4] for n in ("C_p", "k_L")] == ["current", "fit"]
    given = replace(found.model, values={**found.model.values, "C_p": 3e-6})
    noted = psa.identify([fast.slice(0, 200)], model=given).model.provenance.notes
    assert any("keeps the 3 uF given" in n for n in noted)
