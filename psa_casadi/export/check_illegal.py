"""Calls that FMI 2.0 does not allow: each must be refused with a message, and do no harm."""

import math
from collections.abc import Callable, Iterator, Mapping
from ctypes import byref, c_double, c_int, c_size_t, c_uint

from psa_casadi.export.fmu_instance import CO_SIMULATION, ERROR, MODEL_EXCHANGE, Fmu, Instance

Call = Callable[[Instance], int]


def _illegal(fmu: Fmu) -> Mapping[str, tuple[int, bool, Call]]:
    """Return illegal calls by name: interface, whether to initialise first, the call."""
    one, value, order = c_size_t(1), (c_double * 1)(0.0), (c_int * 1)(2)
    beyond = (c_uint * 1)(max(fmu.references.values()) + 1)

    def reals(function: str, name: str, number: float) -> Call:
        return lambda i: i.call(function, i.references([name]), one, (c_double * 1)(number))

    co, me = CO_SIMULATION, MODEL_EXCHANGE
    first_input = (fmu.names("input") or fmu.names("parameter"))[0]
    state, output = fmu.states()[0], fmu.names("output")[0]
    return {
        "fmi2DoStep before initialization": (co, False, lambda i: i.call("DoStep", 0.0, 1.0, 1)),
        "fmi2ExitInitializationMode before entering": (
            co, False, lambda i: i.call("ExitInitializationMode")),
        "fmi2Terminate before initialization": (co, False, lambda i: i.call("Terminate")),
        "fmi2GetReal before initialization": (co, False, reals("GetReal", output, 0.0)),
        "fmi2SetupExperiment after initialization": (
            co, True, lambda i: i.call("SetupExperiment", 0, 0.0, 0.0, 0, 0.0)),
        "fmi2EnterInitializationMode twice": (
            co, True, lambda i: i.call("EnterInitializationMode")),
        "a step of negative size": (co, True, lambda i: i.call("DoStep", 0.0, -1.0, 1)),
        "a step from another communication point": (
            co, True, lambda i: i.call("DoStep", 5.0, 1e-3, 1)),
        "a step of size NaN": (co, True, lambda i: i.call("DoStep", 0.0, math.nan, 1)),
        "an unknown value reference": (co, True, lambda i: i.call("GetReal", beyond, one, value)),
        "setting an output": (co, True, reals("SetReal", output, 0.0)),
        "setting a state between steps": (co, True, reals("SetReal", state, 0.0)),
        "setting an input to NaN": (co, True, reals("SetReal", first_input, math.nan)),
        "an input derivative of order 2": (
            co, True, lambda i: i.call("SetRealInputDerivatives", i.references([first_input]), one,
                                       order, value)),
        "an Integer variable": (
            co, True, lambda i: i.call("GetInteger", beyond, one, (c_int * 1)())),
        "fmi2CancelStep": (co, True, lambda i: i.call("CancelStep")),
        "fmi2EnterEventMode in co-simulation": (co, True, lambda i: i.call("EnterEventMode")),
        "null pointers": (co, True, lambda i: i.call("GetReal", None, one, None)),
        "fmi2DoStep in model exchange": (me, True, lambda i: i.call("DoStep", 0.0, 1.0, 1)),
        "fmi2SetTime before initialization": (me, False, lambda i: i.call("SetTime", 1.0)),
        "fmi2NewDiscreteStates in continuous-time mode": (
            me, True, lambda i: i.call("NewDiscreteStates", byref(value))),
        "a state vector of wrong length": (
            me, True, lambda i: i.call("GetDerivatives", value, c_size_t(len(fmu.states()) + 1))),
    }  # fmt: skip


def illegal_calls(fmu: Fmu) -> Iterator[str]:
    """Illegal calls return fmi2Error with a message, and the instance can be used afterwards."""
    for what, (interface, initialise, call) in _illegal(fmu).items():
        with fmu.start(interface) if initialise else fmu.open(interface) as instance:
            status = call(instance)
            if status != ERROR:
                yield f"{what} returns status {status}, not fmi2Error"
            elif not instance.messages:
                yield f"{what} is refused without a message"
            if initialise and interface == CO_SIMULATION:
                instance.step(0.0, fmu.step_size)
