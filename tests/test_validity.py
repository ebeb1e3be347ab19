"""What an FMU says outside of what the records behind its model have shown."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.components.outputs import OUTPUT
from psa_casadi.effects import EFFECTS
from psa_casadi.errors import InputError
from psa_casadi.export.fmu import evidence
from psa_casadi.export.fmu.archive import export_fmu
from psa_casadi.export.fmu.evidence import seen_inputs, with_validity
from psa_casadi.export.importer.archive import Archive
from psa_casadi.export.importer.fmu import CO_SIMULATION, MODEL_EXCHANGE, Fmu
from psa_casadi.export.importer.masters import Signals, communicate
from psa_casadi.variables import Interval
from tests.evidence_models import evident_fmu, evident_model
from tests.tiers import slow, slow_but

_SAID = "From here on the results are extrapolated."


def messages(
    fmi: int, peak: float, duration: float, *, start: float = 0.0, steps: int = 100
) -> tuple[list[str], np.ndarray]:
    """Return what an FMU says of a triangle, and the output, in co-simulation."""
    times = start + np.linspace(0.0, duration, steps + 1)
    volts = peak * (1.0 - np.abs(np.linspace(-1.0, 1.0, steps + 1)))
    inputs = Signals(("voltage",), times, volts[:, None])
    with Fmu(evident_fmu(fmi)) as fmu, fmu.start(CO_SIMULATION, start_time=start) as instance:
        found = communicate(instance, times, inputs, [OUTPUT])
        return [m for m in instance.messages if _SAID in m], found[:, 0]


@pytest.mark.parametrize("fmi", slow_but([2], [2, 3]))
def test_inside_nothing_is_said(fmi: int) -> None:
    said, outside = messages(fmi, 75.0, 0.5, start=1e3)
    assert said == []
    assert np.all(outside == 0.0)


@pytest.mark.parametrize("fmi", [2, 3])
def test_leaving_the_voltage_is_said_once(fmi: int) -> None:
    said, outside = messages(fmi, 120.0, 0.6)
    (line,) = said
    assert line.startswith("voltage is 7")
    seen = evident_model().evidence
    assert seen is not None
    high = seen.seen.voltage.high
    assert f"from {seen.seen.voltage.low:.6g} to {high:.6g}." in line
    beyond = (120.0 - high) / (high - seen.seen.voltage.low) - 0.01
    assert np.max(outside) == pytest.approx(beyond, abs=2e-3)
    assert outside[0] == outside[-1] == 0.0


@slow
@pytest.mark.parametrize("fmi", slow_but([3], [2, 3]))
def test_a_rate_and_a_time_that_no_record_has_are_said(fmi: int) -> None:
    said, outside = messages(fmi, 75.0, 0.01)
    assert len(said) == 1
    assert said[0].startswith("The rate per second of voltage is 1")
    assert np.max(outside) > 1.0
    said, outside = messages(fmi, 75.0, 0.8)
    assert len(said) == 1
    assert said[0].startswith("The time since the start is 0.64")
    assert np.all(outside == 0.0)


@pytest.mark.parametrize("fmi", [2, 3])
def test_model_exchange_says_it_too(fmi: int) -> None:
    with Fmu(evident_fmu(fmi)) as fmu, fmu.start(MODEL_EXCHANGE) as instance:
        rest = instance.get(fmu.states())
        for volts in (50.0, 100.0, 120.0):
            instance.derivatives(0.1, rest, {"voltage": volts})
        assert sum(_SAID in m for m in instance.messages) == 1


def test_a_temperature_beyond_the_records_counts_where_the_model_has_one() -> None:
    model = evident_model()
    assert model.evidence is not None
    seen = replace(model.evidence.seen, temperature=Interval(290.0, 300.0))
    told = replace(model.evidence, seen=seen)
    assert "seen_temperature_low" not in with_validity(replace(model, evidence=told)).values
    warm = replace(model.with_effect(EFFECTS["temperature"]), evidence=told)
    watched = with_validity(warm)
    column = watched.output_names.index(OUTPUT)
    x = [q.start for q in watched.structure.states]
    for kelvins, outside in ((295.0, 0.0), (300.05, 0.0), (310.0, 0.99), (285.0, 0.49)):
        u = [kelvins if n == "temperature" else 0.0 for n in watched.input_names]
        y = watched.structure.f(0.0, x, u, watched.parameter_vector())[1]
        assert float(y[column]) == pytest.approx(outside, abs=1e-12)
    assert seen_inputs(watched)[watched.input_names.index("temperature")] == (290.0, 300.0, np.inf)


def test_the_output_is_there_on_request_only() -> None:
    model = evident_model()
    assert OUTPUT not in evidence.evidence_texts(model.plant(), 0)[evidence.INPUTS]
    with Archive(evident_fmu()) as archive:
        assert OUTPUT in archive.names("output")
    with pytest.raises(InputError, match="does not say what its records have shown"):
        export_fmu(psa.stack_model("demo"), Path("never.fmu"), validity_output=True)
