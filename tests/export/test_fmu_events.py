"""The voltage's reversal as an event: located by an importer, harmless where nobody looks."""

from ctypes import c_double, c_size_t

import fmpy
import numpy as np
import numpy.typing as npt
import pytest
from scipy.integrate import solve_ivp

from psa_casadi.export.common.variable_table import variable_table
from psa_casadi.export.importer.fmu import ERROR, MODEL_EXCHANGE, OK, Fmu
from tests.export import fmi3_instances as fmi3
from tests.export.fmu_models import exported, model_named
from tests.tiers import slow

FloatArray = npt.NDArray[np.float64]

STACK = "P-885.51"
(SWITCH,) = [v.name for v in variable_table(model_named(STACK)) if v.kind == "indicator"]
#: Corners of a triangle of 100 Hz, 0 V to 50 V [s], [V]
CORNERS = np.array([0.0, 5e-3, 10e-3, 15e-3, 20e-3])
VOLTS = np.array([0.0, 50.0, 0.0, 50.0, 0.0])


def _rate(u: float, voltage: float) -> float:
    """Return u' of the drive stage (V - u) / (R_s C_p)."""
    values = model_named(STACK).values
    return (voltage - u) / (values["R_s"] * values["C_p"])


def _margin(tolerance: float = 1e-5) -> float:
    """Return 5 tolerances of what the voltage's nominal value moves its rate by [V/s]."""
    values = model_named(STACK).values
    nominal = next(v.nominal for v in variable_table(model_named(STACK)) if v.name == "u")
    return 5.0 * tolerance * float(nominal or 0.0) / (values["R_s"] * values["C_p"])


def test_indicator_is_the_rate_of_the_voltage_in_fmi_2() -> None:
    with Fmu(exported(STACK)) as fmu, fmu.start(MODEL_EXCHANGE) as instance:
        assert fmu.description.numberOfEventIndicators == 1
        z = (c_double * 2)()
        for u, voltage in ((30.0, 50.0), (50.0, 30.0)):
            instance.set({"u": u, "voltage": voltage})
            instance.require("GetEventIndicators", z, c_size_t(1))
            assert z[0] == pytest.approx(_rate(u, voltage) + _margin(), rel=1e-12)
            assert instance.get([SWITCH])[0] == z[0]
        assert instance.call("GetEventIndicators", z, c_size_t(2)) == ERROR
        assert "1 event indicators" in instance.messages[-1]
        assert instance.call("GetEventIndicators", None, c_size_t(1)) == ERROR
        assert instance.call("EnterEventMode") == OK


def test_indicator_faces_the_other_way_after_an_event_and_noise_makes_none() -> None:
    """Beyond the margin an event update turns it round; within the margin it does not."""
    values = model_named(STACK).values
    step = 2.0 * _margin() * values["R_s"] * values["C_p"]  # [V], two margins of the rate
    with fmi3.Instance3(fmi3.loaded(STACK), MODEL_EXCHANGE) as instance:
        instance.start({"u": 50.0, "voltage": 50.0})
        for share, facing in ((0.2, 1.0), (1.0, -1.0), (-0.2, -1.0), (-1.0, 1.0)):
            instance.require("EnterEventMode")
            instance.set({"voltage": 50.0 - share * step})
            assert instance.update_discrete_states() == [False] * 5
            instance.require("EnterContinuousTimeMode")
            expected = facing * _rate(50.0, 50.0 - share * step) + _margin()
            assert instance.vector("GetEventIndicators", 1)[0] == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_held_voltage_makes_no_events(fmi: int) -> None:
    signal = np.array(
        [(0.0, 0.0, 0.0), (1e-3, 50.0, 0.0), (5e-2, 50.0, 0.0)],
        dtype=[("time", "f8"), ("voltage", "f8"), ("load_force", "f8")],
    )
    path = fmpy.simulate_fmu(
        str(exported(STACK, fmi)), fmi_type="ModelExchange", input=signal, output=["displacement"],
        stop_time=5e-2, output_interval=1e-4, relative_tolerance=1e-5,
    )  # fmt: skip
    assert np.count_nonzero(np.diff(path["time"]) == 0.0) <= 4


@slow
@pytest.mark.parametrize("fmi", [2, 3])
def test_importer_locates_reversals_where_they_are(fmi: int) -> None:
    """After a corner of a triangle, u turns R_s C_p ln 2 later: the drive is of first order."""
    events: list[float] = []
    with Fmu(exported(STACK, fmi)) as fmu, fmu.start(MODEL_EXCHANGE, tolerance=1e-6) as instance:
        nominal = np.array([fmu.nominals[n] for n in fmu.states()])

        def slope(time: float, x: FloatArray) -> FloatArray:
            return instance.derivatives(
                time, x, {"voltage": float(np.interp(time, CORNERS, VOLTS))}
            )

        def indicator(time: float, x: FloatArray) -> float:
            slope(time, x)
            return float(instance.vector("GetEventIndicators", 1)[0])

        indicator.terminal = True  # type: ignore[attr-defined]  # as scipy asks for it
        time, x = 0.0, np.zeros(len(nominal))
        while time < CORNERS[-1]:
            solved = solve_ivp(
                slope, (time, float(CORNERS[-1])), x, "Radau", events=indicator,
                rtol=1e-6, atol=1e-6 * nominal, max_step=1e-4,
            )  # fmt: skip
            time, x = float(solved.t[-1]), solved.y[:, -1]
            if time < CORNERS[-1]:
                events.append(time)
                instance.require("EnterEventMode")
                instance.update_discrete_states()
                instance.require("EnterContinuousTimeMode")
    values = model_named(STACK).values
    turns = CORNERS[1:-1] + values["R_s"] * values["C_p"] * np.log(2.0)
    assert len(events) == len(turns) == 3
    assert np.abs(events - turns).max() < 0.01 * values["R_s"] * values["C_p"]
