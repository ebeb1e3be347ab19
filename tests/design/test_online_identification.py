"""The online identification: stream, NumPy, simulated model, FMU 2 and 3, Modelica agree."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.examples.linearisation_trial import Drive, driven, off_values
from psa_casadi.export.importer.fmu import CO_SIMULATION, Fmu
from psa_casadi.export.modelica.package import modelica_text
from tests.design.online_numpy import TRACKED, NumpyIdentification
from tests.export.modelica_runs import simulated
from tests.tiers import slow_but

STACK, PERIOD, NOISE = "P-885.51", 5e-4, 2e-8


@cache
def record() -> Drive:
    """Return a plain run of 0.4 s on the plant."""
    model = psa.stack_model(STACK)
    return driven(model, "none", model, np.arange(0.0, 0.4, PERIOD))


def test_recursion_is_recursive_least_squares_on_the_prediction() -> None:
    """The streaming object does what matrices and finite differences in NumPy do."""
    values = dict(
        psa.identifier_for(off_values(psa.stack_model(STACK), 0.1, 0), PERIOD, noise=NOISE).values
    )
    d = record()
    online = psa.OnlineIdentification(values)
    expected, rows = NumpyIdentification(values), []
    for u, x in zip(d.voltage.tolist(), d.displacement.tolist(), strict=True):
        force = online.step(u, x)
        expected.step(u, x)
        found = online.estimate.parameters
        mine = [*(found[name] for name in TRACKED), force]
        rows.append([mine, [*expected.estimates, expected.f]])
    both = np.array(rows)
    sizes = np.abs(both[:, 1]).max(axis=0)
    assert (np.abs(both[:, 0] - both[:, 1]) / sizes).max() < 1e-4
    assert np.ptp(both[:, 0, 0]) > 0.1  # A has moved


def test_standstill_teaches_nothing_and_winds_nothing_up() -> None:
    model = psa.stack_model(STACK)
    tuned = psa.identifier_for(model, PERIOD, noise=NOISE, memory=0.05)
    online, d = psa.OnlineIdentification(tuned.values), record()
    for u, x in zip(d.voltage.tolist(), d.displacement.tolist(), strict=True):
        online.step(u, x)
    before = online.estimate
    held, draw = d.voltage[-1], np.random.default_rng(1)
    for error in draw.normal(size=4000):
        online.step(float(held), float(d.displacement[-1] + 1e-7 * error))
    after = online.estimate
    assert after.parameters == before.parameters
    assert after.uncertainty == before.uncertainty


@pytest.mark.parametrize("fmi", slow_but([3], [2, 3]))
def test_fmu_gives_what_the_stream_gives(fmi: int, tmp_path: Path) -> None:
    model = psa.identifier_for(off_values(psa.stack_model(STACK), 0.1, 0), PERIOD, noise=NOISE)
    d, online = record(), psa.OnlineIdentification(model.values)
    names = [f"{name}_hat" for name in TRACKED] + ["hysteresis_force"]
    with (
        Fmu(psa.export_fmu(model, tmp_path / "online.fmu", fmi=fmi)) as fmu,
        fmu.start(CO_SIMULATION) as instance,
    ):
        for k in range(200):
            u, x = float(d.voltage[k]), float(d.displacement[k])
            force = online.step(u, x)
            instance.set({"voltage": u, "position": x})
            instance.step(k * PERIOD, PERIOD)
            found = online.estimate.parameters
            expected = [*(found[name] for name in TRACKED), force]
            assert instance.get(names) == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_modelica_block_gives_what_the_stream_gives() -> None:
    """Another compiler runs the exported block on a drive of its own."""
    model = psa.identifier_for(off_values(psa.stack_model(STACK), 0.1, 0), PERIOD, noise=NOISE)
    wave = "60*(1 - cos(62.83185307179586*({})))"
    harness = f"""
    model Driven
      PiezoStack.Signal rls;
    equation
      rls.voltage = {wave.format("time")};
      rls.position = 1.4e-7*{wave.format("time - 1e-3")};
    end Driven;
    """
    found = simulated(modelica_text(model) + harness, "Driven", 0.03)
    online = psa.OnlineIdentification(model.values)
    for t in PERIOD * np.arange(61):
        u, x = (60.0 * (1.0 - np.cos(62.83185307179586 * (t - d))) for d in (0.0, 1e-3))
        force = online.step(float(u), 1.4e-7 * float(x))
    assert found["rls.hysteresis_force"][-1] == pytest.approx(force, rel=1e-8)
    for name, value in online.estimate.parameters.items():
        assert found[f"rls.{name}_hat"][-1] == pytest.approx(value, rel=1e-7), name
