"""Causes in the ceramic: what changes its free strain, which is expressed in volts."""

import math
from collections.abc import Callable

import numpy as np
from scipy.signal import fftconvolve

from tests.studies.exam.linear import filtered, lagged
from tests.studies.exam.record import Floats, Run, Values

StrainCause = Callable[[Floats, Floats, Run, Values], Floats]


def _saturation(strain: Floats, voltage: Floats, run: Run, values: Values) -> Floats:
    """Langevin's function q (coth z - 1/z), z = 3 g/q. Source: P. Langevin, 1905."""
    limit = values[0] * run.record.test.largest
    z = 3 * strain / limit
    z = np.where(np.abs(z) < 1e-6, 1e-6, z)
    return np.asarray(limit * (1 / np.tanh(z) - 1 / z))


def _field_gain(strain: Floats, voltage: Floats, run: Run, values: Values) -> Floats:
    """A gain that grows with the magnitude of the voltage."""
    return strain * (1 + values[0] * np.abs(voltage) / run.record.test.largest)


def _asymmetry(strain: Floats, voltage: Floats, run: Run, values: Values) -> Floats:
    """A state that differs between the branches: h' = |u'| (u - 1.2 h)/V."""
    largest, h = run.record.test.largest, 0.0
    moved = np.abs(np.diff(voltage, prepend=voltage[0]))
    states = []
    for u, du in zip(voltage.tolist(), moved.tolist(), strict=True):
        h += du * (u / largest) - 1.2 / largest * du * h
        states.append(h)
    return strain + values[0] * np.array(states)


def _ageing(strain: Floats, voltage: Floats, run: Run, values: Values) -> Floats:
    """A gain that falls with the logarithm of the number of cycles."""
    way = np.cumsum(np.abs(np.diff(voltage, prepend=voltage[0])))
    return strain * (1 - values[0] * np.log10(1 + way / (2 * run.record.test.span)))


def _heating(strain: Floats, voltage: Floats, run: Run, values: Values) -> Floats:
    """A gain that follows the power u'^2 with a time constant [s]."""
    gain, time = values
    test = run.record.test
    rate = np.gradient(voltage, run.step) / (test.largest * 2 * math.pi * test.frequency)
    power = lagged(rate**2, 0.02 / test.frequency, run.step)
    return strain * (1 + gain * filtered([1.0], [time, 1.0], power - power[0], run.step))


def _temperature(strain: Floats, voltage: Floats, run: Run, values: Values) -> Floats:
    """A gain and an offset that follow the recorded temperature from 22 degC."""
    gain, offset = values
    change = temperature(run) - 22
    return strain * (1 + gain * change) + offset * run.record.test.largest * change


def _log_creep(strain: Floats, voltage: Floats, run: Run, values: Values) -> Floats:
    """gamma log10(1 + t/t_0) after every change. Source: H. Jung, D. G. Gweon, RSI 71 (2000)."""
    return strain + _after_changes(strain, values[0] * np.log10(1 + run.times / values[1]))


def _power_creep(strain: Floats, voltage: Floats, run: Run, values: Values) -> Floats:
    """c (t/T)^alpha after every change, a fractional creep."""
    return strain + _after_changes(strain, values[0] * run.share ** values[1])


def _after_changes(strain: Floats, response: Floats) -> Floats:
    """Sum of a step response over all changes of the strain (superposition of Boltzmann)."""
    changes = np.diff(strain, prepend=strain[0])
    return np.asarray(fftconvolve(changes, response)[: strain.size])


#: Causes that follow the hysteresis at once, and those behind the lag of the strain.
AT_ONCE: dict[str, StrainCause] = {
    "strain saturation": _saturation,
    "field gain": _field_gain,
    "asymmetry": _asymmetry,
    "ageing": _ageing,
    "self-heating": _heating,
    "temperature": _temperature,
}
CREEP: dict[str, StrainCause] = {"log creep": _log_creep, "power creep": _power_creep}


def free_strain(hysteretic: Floats, voltage: Floats, run: Run) -> Floats:
    """Return the free strain of a stack, from what its hysteresis gives [V]."""
    strain = _with(AT_ONCE, hysteretic, voltage, run)
    lag = run.record.stack.strain_lag
    return _with(CREEP, lagged(strain, lag, run.step) if lag else strain, voltage, run)


def _with(causes: dict[str, StrainCause], strain: Floats, voltage: Floats, run: Run) -> Floats:
    for name, cause in causes.items():
        if name in run.record.hidden:
            strain = cause(strain, voltage, run, run.record.hidden[name])
    return strain


def temperature(run: Run) -> Floats:
    """Return the temperature of the stack [degC]."""
    return 22 + 3 * np.sin(2 * math.pi * 0.8 * run.share + 1) + 1.5 * run.share
