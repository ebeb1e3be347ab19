"""Inputs that move in model exchange, where an importer does not set them at every evaluation."""

from functools import cache

import numpy as np
import pytest
from fmpy import simulate_fmu

from psa_casadi.export.importer.fmu import MODEL_EXCHANGE, Fmu
from psa_casadi.simulation.simulate import simulate
from psa_casadi.units import FloatArray
from tests.fmu_models import exported, model_named
from tests.tiers import slow_but

STACK = "P-885.51"


@cache
def fmu(fmi: int) -> Fmu:
    return Fmu(exported(STACK, fmi))


def played(name: str, fmi: int, times: list[float], shares: list[float], interval: float,
           tolerance: float | None = None) -> dict[str, float]:  # fmt: skip
    """Return the largest errors of fmpy's CVode over the range of an output, on a bent line."""
    model = model_named(name)
    volts = model.values["u_rated"] * np.array(shares)
    signal = np.array(list(zip(times, volts, strict=True)), [("time", float), ("voltage", float)])
    found = simulate_fmu(
        str(exported(name, fmi)), fmi_type="ModelExchange", stop_time=times[-1],
        output_interval=interval, input=signal, relative_tolerance=tolerance, record_events=False,
        output=["displacement", "velocity"], solver="CVode",
    )  # fmt: skip
    grid = np.union1d(found["time"], times)
    true = simulate(model.plant(), grid, np.interp(grid, times, volts), rtol=1e-9, as_exported=True)
    at = np.searchsorted(grid, found["time"])
    return {
        n: float(np.max(np.abs(found[n] - true.outputs[n][at])) / np.ptp(true.outputs[n]))
        for n in ("displacement", "velocity")
    }


@pytest.mark.parametrize(
    ("name", "fmi", "interval"),
    slow_but(
        [(STACK, 2, 0.02), ("demo", 3, 0.002)],
        [(n, f, i) for n in (STACK, "PTBS200", "WYDS0808020", "demo", "slow_creep")
         for f in (2, 3) for i in (0.02, 0.002)],
    ),
)  # fmt: skip
def test_a_ramp_in_fmpy_at_its_default_tolerance(name: str, fmi: int, interval: float) -> None:
    """Each step of CVode was a jump to it: it gave up, or the velocity erred by its range."""
    found = played(name, fmi, [0.0, 0.1, 0.2], [0.0, 0.8, 0.0], interval)
    assert found["displacement"] < 3e-4
    assert found["velocity"] < 0.03


@pytest.mark.parametrize("name", slow_but(["demo"], [STACK, "PTBS200", "demo", "slow_creep"]))
def test_a_jump_in_fmpy_at_its_default_tolerance(name: str) -> None:
    """The tolerance of a velocity is a tenth of what it was, and 33 % of its range were wrong."""
    times, shares = [0.0, 2e-3, 2e-3, 0.02], [0.0, 0.0, 0.8, 0.8]
    model = model_named(name)
    volts = model.values["u_rated"] * np.array(shares)
    signal = np.array(list(zip(times, volts, strict=True)), [("time", float), ("voltage", float)])
    found = simulate_fmu(
        str(exported(name, 2)), fmi_type="ModelExchange", stop_time=0.02, output_interval=1e-4,
        input=signal, record_events=False, output=["displacement", "velocity"],
    )  # fmt: skip
    t = found["time"]
    grid = np.sort(np.append(t, 2e-3 - 1e-12))
    true = simulate(
        model.plant(), grid, np.where(grid < 2e-3 - 1e-13, 0.0, volts[-1]),
        rtol=1e-9, as_exported=True, hold="zero",
    )  # fmt: skip
    at = np.searchsorted(grid, t)
    for output, limit in (("displacement", 1e-3), ("velocity", 0.05)):
        expected = true.outputs[output][at]
        assert np.max(np.abs(found[output] - expected)) < limit * np.ptp(expected), output


def rates(fmi: int, asked: str, *, jump: bool = False, last: float | None = None) -> FloatArray:
    """Return the derivatives at 2 ms of an importer that gave 10 V at 0 and 30 V at 1 ms.

    Where it gave them it `asked` for the "indicators", the "rates" or both; `jump` is an event at
    1 ms, `last` is what it gives at 2 ms.
    """
    rate = "GetDerivatives" if fmi == 2 else "GetContinuousStateDerivatives"
    with fmu(fmi).start(MODEL_EXCHANGE) as instance:
        for time, volts in ((0.0, 10.0), (1e-3, 30.0)):
            instance.require("SetTime", time)
            if jump and time > 0.0:
                instance.require("EnterEventMode")
            instance.set({"voltage": volts})
            if jump and time > 0.0:
                instance.require("EnterContinuousTimeMode")
            for what in asked.split(" and "):
                if what == "rates":
                    instance.vector(rate, len(fmu(fmi).states()))
                elif what == "indicators":
                    instance.vector("GetEventIndicators", 1)
        instance.require("SetTime", 2e-3)
        if last is not None:
            instance.set({"voltage": last})
        return instance.vector(rate, len(fmu(fmi).states()))


@pytest.mark.parametrize("fmi", [2, 3])
def test_who_asks_for_rates_where_inputs_are_given_has_them_held(fmi: int) -> None:
    """CasADi, Euler's method, masters that hold inputs: values are what they were set to."""
    held, moved = (rates(fmi, "rates", last=v) for v in (30.0, 50.0))
    assert not np.array_equal(held, moved)
    for asked in ("rates", "indicators and rates", "rates and indicators", "nothing"):
        assert np.array_equal(rates(fmi, asked), held), asked
    assert np.array_equal(rates(fmi, "indicators", jump=True), held)
    assert np.array_equal(rates(fmi, "indicators", last=30.0), held)
    np.testing.assert_allclose(rates(fmi, "indicators"), moved, rtol=1e-12)
