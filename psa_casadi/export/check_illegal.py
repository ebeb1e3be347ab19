"""Calls that FMI does not allow: each must be refused with a message, and do no harm."""

import math
from collections.abc import Callable, Iterator, Mapping
from ctypes import byref, c_double, c_int, c_size_t, c_uint

from psa_casadi.export.fmu_calls import (
    CO_SIMULATION,
    ERROR,
    MODEL_EXCHANGE,
    OK,
    FmuError,
    Instance,
)
from psa_casadi.export.fmu_instance import Fmu

#: Makes an illegal call; returns its status, or raises FmuError, which has it.
Call = Callable[[Instance], object]
#: By name: interface, whether to initialise first, the call.
Calls = Mapping[str, tuple[int, bool, Call]]


def _common(fmu: Fmu) -> Calls:
    """Return what is illegal in both versions."""
    one, many = c_size_t(1), (c_double * 64)()
    beyond = (c_uint * 1)(max(fmu.references.values()) + 1)
    co, me = CO_SIMULATION, MODEL_EXCHANGE
    moved = (fmu.names("input") or fmu.names("parameter"))[0]
    state, output = (*fmu.states(), *fmu.sampled())[0], fmu.names("output")[0]
    wide = len(fmu.states()) + 1
    return {
        "a step before initialization": (co, False, lambda i: i.step(0.0, 1.0)),
        "ExitInitializationMode before entering": (
            co, False, lambda i: i.call("ExitInitializationMode")),
        "Terminate before initialization": (co, False, lambda i: i.call("Terminate")),
        "reading before initialization": (co, False, lambda i: i.get([output])),
        "initializing twice": (co, True, lambda i: i.setup()),
        "a step of negative size": (co, True, lambda i: i.step(0.0, -1.0)),
        "a step from another communication point": (co, True, lambda i: i.step(5.0, 1e-3)),
        "a step of size NaN": (co, True, lambda i: i.step(0.0, math.nan)),
        "an unknown value reference": (co, True, lambda i: i.get_references(beyond)),
        "setting an output": (co, True, lambda i: i.set({output: 0.0})),
        "setting a state between steps": (co, True, lambda i: i.set({state: 0.0})),
        "setting an input to NaN": (co, True, lambda i: i.set({moved: math.nan})),
        "an output derivative of order 2": (co, True, lambda i: i.output_rates([output], 2)),
        "EnterEventMode where there is none": (co, True, lambda i: i.call("EnterEventMode")),
        "null pointers": (
            co, True, lambda i: i.call(i.get_function, None, one, None, *i.counted(1))),
        "model exchange in co-simulation": (
            co, True, lambda i: i.vector(i.derivatives_function, wide - 1)),
        "a step in model exchange": (me, True, lambda i: i.step(0.0, 1.0)),
        "SetTime before initialization": (me, False, lambda i: i.call("SetTime", 1.0)),
        "a time that is NaN": (me, True, lambda i: i.call("SetTime", math.nan)),
        "an event update in continuous-time mode": (
            me, True, lambda i: i.update_discrete_states()),
        "a state vector of wrong length": (
            me, True, lambda i: i.vector(i.derivatives_function, wide)),
        "event indicators of wrong number": (
            me, True, lambda i: i.call("GetEventIndicators", many, c_size_t(len(many)))),
        "the derivative of an input": (
            me, True, lambda i: i.directional([moved], [state], [1.0])),
        "a derivative by an output": (
            me, True, lambda i: i.directional([output], [output], [1.0])),
    }  # fmt: skip


def _of_version_2(fmu: Fmu) -> Calls:
    one, co = c_size_t(1), CO_SIMULATION
    moved = (fmu.names("input") or fmu.names("parameter"))[0]
    return {
        "SetupExperiment after initialization": (
            co, True, lambda i: i.call("SetupExperiment", 0, 0.0, 0.0, 0, 0.0)),
        "an input derivative of order 2": (co, True, lambda i: i.set_rates({moved: 0.0}, 2)),
        "an Integer variable": (
            co, True, lambda i: i.call("GetInteger", i.references([moved]), one, (c_int * 1)())),
        "CancelStep": (co, True, lambda i: i.call("CancelStep")),
    }  # fmt: skip


def _of_version_3(fmu: Fmu) -> Calls:
    one, two, value = c_size_t(1), c_size_t(2), (c_double * 2)()
    moved = (fmu.names("input") or fmu.names("parameter"))[0]
    return {
        "two values of a scalar": (
            CO_SIMULATION, True,
            lambda i: i.call("GetFloat64", i.references([moved]), one, value, two)),
        "an Int32 variable": (
            CO_SIMULATION, True,
            lambda i: i.call("GetInt32", i.references([moved]), one, (c_int * 1)(), one)),
        "EnterStepMode in step mode": (
            CO_SIMULATION, True, lambda i: i.call("EnterStepMode")),
        "EnterStepMode in model exchange": (
            MODEL_EXCHANGE, True, lambda i: i.call("EnterStepMode")),
        "EnterConfigurationMode": (
            CO_SIMULATION, False, lambda i: i.call("EnterConfigurationMode")),
        "a clock": (
            CO_SIMULATION, True,
            lambda i: i.call("GetClock", i.references([moved]), one, byref(value))),
        "ActivateModelPartition": (
            CO_SIMULATION, True, lambda i: i.call("ActivateModelPartition", 0, 0.0)),
    }  # fmt: skip


def _status(call: Call, instance: Instance) -> int:
    """Return the status of a call."""
    try:
        returned = call(instance)
    except FmuError as error:
        return error.status
    return returned if isinstance(returned, int) else OK


def illegal_calls(fmu: Fmu) -> Iterator[str]:
    """Illegal calls return an error with a message, and the instance can be used afterwards."""
    more = _of_version_2(fmu) if fmu.version == 2 else _of_version_3(fmu)
    for what, (interface, initialise, call) in {**_common(fmu), **more}.items():
        with fmu.start(interface) if initialise else fmu.open(interface) as instance:
            status = _status(call, instance)
            if status != ERROR:
                yield f"{what} returns status {status}, not an error"
            elif not instance.messages:
                yield f"{what} is refused without a message"
            if initialise and interface == CO_SIMULATION:
                instance.step(0.0, fmu.step_size)
