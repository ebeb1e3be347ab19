"""Calls that FMI does not allow: each must be refused with a message, and do no harm."""

import math
from collections.abc import Callable, Iterator, Mapping
from ctypes import byref, c_double, c_int, c_size_t, c_uint

from psa_casadi.export.fmu.sources import fixed_step_of
from psa_casadi.export.importer.calls import (
    CO_SIMULATION,
    ERROR,
    MODEL_EXCHANGE,
    OK,
    FmuError,
    Instance,
)
from psa_casadi.export.importer.fmu import Fmu

#: Makes an illegal call; returns its status, or raises FmuError, which has it.
Call = Callable[[Instance], object]
#: By name: interface, whether to initialise first, the call.
Calls = Mapping[str, tuple[int, bool, Call]]


def _common(fmu: Fmu) -> Calls:
    """Return what is illegal in both versions."""
    one, many = c_size_t(1), (c_double * 64)()
    beyond = (c_uint * 1)(max(fmu.references.values()) + 1)
    co, me = CO_SIMULATION, MODEL_EXCHANGE
    state, wide = _state(fmu), len(fmu.states()) + 1
    return {
        "a step before initialization": (co, False, lambda i: i.step(0.0, 1.0)),
        "ExitInitializationMode before entering": (
            co, False, lambda i: i.call("ExitInitializationMode")),
        "Terminate before initialization": (co, False, lambda i: i.call("Terminate")),
        "initializing twice": (co, True, lambda i: i.setup()),
        "a step of negative size": (co, True, lambda i: i.step(0.0, -1.0)),
        "a step from another communication point": (co, True, lambda i: i.step(5.0, 1e-3)),
        "a step of size NaN": (co, True, lambda i: i.step(0.0, math.nan)),
        "an unknown value reference": (co, True, lambda i: i.get_references(beyond)),
        "setting a state between steps": (co, True, lambda i: i.set({state: 0.0})),
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
    }  # fmt: skip


def _state(fmu: Fmu) -> str:
    """Return a state or, without any, a sampled state."""
    return (*fmu.states(), *fmu.sampled())[0]


def _of_input(fmu: Fmu) -> Calls:
    """Return what is illegal with an input or, without any, a parameter; nothing without both."""
    names, state = [*fmu.names("input"), *fmu.names("parameter")], _state(fmu)
    if not names:
        return {}
    moved = names[0]
    calls: dict[str, tuple[int, bool, Call]] = {
        "setting an input to NaN": (CO_SIMULATION, True, lambda i: i.set({moved: math.nan})),
        "the derivative of an input": (
            MODEL_EXCHANGE, True, lambda i: i.directional([moved], [state], [1.0])),
    }  # fmt: skip
    if fmu.version == 2:
        calls["an input derivative of order 2"] = (
            CO_SIMULATION, True, lambda i: i.set_rates({moved: 0.0}, 2))  # fmt: skip
    return calls


def _of_output(fmu: Fmu) -> Calls:
    """Return what is illegal with an output; nothing if there is none."""
    if not fmu.names("output"):
        return {}
    output = fmu.names("output")[0]
    return {
        "reading before initialization": (CO_SIMULATION, False, lambda i: i.get([output])),
        "setting an output": (CO_SIMULATION, True, lambda i: i.set({output: 0.0})),
        "an output derivative of order 2": (
            CO_SIMULATION, True, lambda i: i.output_rates([output], 2)),
        "a derivative by an output": (
            MODEL_EXCHANGE, True, lambda i: i.directional([output], [output], [1.0])),
    }  # fmt: skip


def _of_version_2(fmu: Fmu) -> Calls:
    one, co, state = c_size_t(1), CO_SIMULATION, _state(fmu)
    return {
        "SetupExperiment after initialization": (
            co, True, lambda i: i.call("SetupExperiment", 0, 0.0, 0.0, 0, 0.0)),
        "an Integer variable": (
            co, True, lambda i: i.call("GetInteger", i.references([state]), one, (c_int * 1)())),
        "CancelStep": (co, True, lambda i: i.call("CancelStep")),
    }  # fmt: skip


def _of_version_3(fmu: Fmu) -> Calls:
    one, two, value, state = c_size_t(1), c_size_t(2), (c_double * 2)(), _state(fmu)
    return {
        "two values of a scalar": (
            CO_SIMULATION, True,
            lambda i: i.call("GetFloat64", i.references([state]), one, value, two)),
        "an Int32 variable": (
            CO_SIMULATION, True,
            lambda i: i.call("GetInt32", i.references([state]), one, (c_int * 1)(), one)),
        "EnterStepMode in step mode": (
            CO_SIMULATION, True, lambda i: i.call("EnterStepMode")),
        "EnterStepMode in model exchange": (
            MODEL_EXCHANGE, True, lambda i: i.call("EnterStepMode")),
        "EnterConfigurationMode": (
            CO_SIMULATION, False, lambda i: i.call("EnterConfigurationMode")),
        "a clock": (
            CO_SIMULATION, True,
            lambda i: i.call("GetClock", i.references([state]), one, byref(value))),
        "ActivateModelPartition": (
            CO_SIMULATION, True, lambda i: i.call("ActivateModelPartition", 0, 0.0)),
    }  # fmt: skip


def _of_fixed_step(fmu: Fmu) -> Calls:
    """Return what is illegal where the step is fixed, and the parameters with it."""
    step = fixed_step_of(fmu.directory)
    if step is None:
        return {}
    co, constants = CO_SIMULATION, fmu.constants()
    calls: dict[str, tuple[int, bool, Call]] = {
        "a step that is no multiple of the fixed one": (co, True, lambda i: i.step(0.0, 1.5 * step))
    }
    if constants:
        calls["setting a constant"] = (co, True, lambda i: i.set({constants[0]: 1.0}))
    return calls


def _status(call: Call, instance: Instance) -> int:
    """Return the status of a call."""
    try:
        returned = call(instance)
    except FmuError as error:
        return error.status
    return returned if isinstance(returned, int) else OK


def illegal_calls(fmu: Fmu) -> Iterator[str]:
    """Illegal calls return an error with a message, and the instance can be used afterwards."""
    own = _of_version_2(fmu) if fmu.version == 2 else _of_version_3(fmu)
    calls = {**_common(fmu), **_of_input(fmu), **_of_output(fmu), **_of_fixed_step(fmu), **own}
    for what, (interface, initialise, call) in calls.items():
        if interface not in fmu.interfaces():
            continue
        with fmu.start(interface) if initialise else fmu.open(interface) as instance:
            status = _status(call, instance)
            if status != ERROR:
                yield f"{what} returns status {status}, not an error"
            elif not instance.messages:
                yield f"{what} is refused without a message"
            if initialise and interface == CO_SIMULATION:
                instance.step(0.0, fmu.step_size)
