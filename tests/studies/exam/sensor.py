"""Causes in the sensor and around it, and the noise: from displacement to reading [um]."""

import math
from collections.abc import Callable

import numpy as np
from scipy.signal import lfilter

from tests.studies.exam.linear import lagged, resonant
from tests.studies.exam.record import Floats, Record, Run, Values
from tests.studies.exam.voltages import triangle

ReadingCause = Callable[[Floats, Run, Values], Floats]


def _clock(y: Floats, run: Run, values: Values) -> Floats:
    """A clock that runs ever faster than the drive's: read at t + e t^2/T."""
    return np.interp(run.times + values[0] * run.times * run.share, run.times, y)


def _delay(y: Floats, run: Run, values: Values) -> Floats:
    """The reading, a time [s] later."""
    return np.interp(run.times - values[0], run.times, y)


def _lag(y: Floats, run: Run, values: Values) -> Floats:
    """First order, of a time constant [s]."""
    return lagged(y, values[0], run.step)


def _bend(y: Floats, run: Run, values: Values) -> Floats:
    """A quadratic and a cubic part of the reading, from its mean."""
    stroke = run.record.stack.stroke
    z = (y - y.mean()) / stroke
    return np.asarray(y + stroke * (values[0] * z**2 + values[1] * z**3))


def _ripple(y: Floats, run: Run, values: Values) -> Floats:
    """An interpolation error: amplitude, period [um], share of the second harmonic."""
    size, period, second = values
    phase = 2 * math.pi * y / period
    wave = np.sin(phase) + second * np.sin(2 * phase + 1)
    return np.asarray(y + size * run.record.stack.stroke * wave)


def _drift(y: Floats, run: Run, values: Values) -> Floats:
    """An offset that settles exponentially: size, time constant as a share of the record."""
    return y + values[0] * run.record.stack.stroke * (1 - np.exp(-run.share / values[1]))


def _gain_drift(y: Floats, run: Run, values: Values) -> Floats:
    """A gain that changes over time."""
    return y * (1 + values[0] * (run.share - 0.15 * np.sin(9 * run.share)))


def _offset_step(y: Floats, run: Run, values: Values) -> Floats:
    """An offset that steps once: size and when, as a share of the record."""
    return y + values[0] * run.record.stack.stroke * (run.share > values[1])


def _hum(y: Floats, run: Run, values: Values) -> Floats:
    """Lines of the mains: frequency [Hz] and size of each."""
    for frequency, size in zip(values[::2], values[1::2], strict=True):
        line = np.sin(2 * math.pi * frequency * run.times + frequency)
        y = y + size * run.record.stack.stroke * line
    return y


def _vibration(y: Floats, run: Run, values: Values) -> Floats:
    """A floor that vibrates: noise through a resonance of frequency [Hz] and damping; its rms."""
    frequency, damping, size = values
    noise = run.record.draws(6).standard_normal(y.size)
    floor = resonant(noise, frequency, damping, run.step)
    return y + size * run.record.stack.stroke / float(floor.std()) * floor


def _bursts(y: Floats, run: Run, values: Values) -> Floats:
    """Short bursts of interference at random instants: size and number."""
    size, count = values
    length = run.times[-1]
    wave = np.sin(2 * math.pi * run.record.test.rate * 0.31 * run.times)
    for centre in run.record.draws(7).uniform(0, length, int(count)).tolist():
        near = np.exp(-(((run.times - centre) / (0.006 * length)) ** 2))
        y = y + size * run.record.stack.stroke * near * wave
    return y


def _second_device(y: Floats, run: Run, values: Values) -> Floats:
    """Another actuator that moves the stack: size, frequency [Hz] of its own triangle."""
    size, frequency = values
    slow = 1 + 0.3 * np.sin(2 * math.pi * frequency * 0.37 * run.times)
    return y + size * run.record.stack.stroke * triangle(frequency * run.times + 0.13) * slow


#: Causes that change the reading [um], in the order of the signal; sizes are shares of the stroke.
READING: dict[str, ReadingCause] = {
    "clock": _clock,
    "delay": _delay,
    "sensor lag": _lag,
    "bend": _bend,
    "ripple": _ripple,
    "drift": _drift,
    "gain drift": _gain_drift,
    "offset step": _offset_step,
    "hum": _hum,
    "floor vibration": _vibration,
    "interference": _bursts,
    "second device": _second_device,
}
#: Step of the reading, as a share of the noise's rms.
QUANTUM = 0.2


def reading(displacement: Floats, run: Run) -> Floats:
    """Return what the sensor reads of a displacement, without noise."""
    for name, cause in READING.items():
        if name in run.record.hidden:
            displacement = cause(displacement, run, run.record.hidden[name])
    return displacement


def with_noise(clean: Floats, record: Record) -> Floats:
    """Add the noise that a record states, white or AR(1), and round to the sensor's step."""
    sigma = record.test.noise * 1e-2 * float(np.ptp(clean))
    noise = record.draws(3).standard_normal(clean.size)
    pole = record.test.colour
    if pole:
        noise = np.asarray(lfilter([math.sqrt(1 - pole**2)], [1, -pole], noise))
    quantum = QUANTUM * sigma
    return np.asarray(np.round((clean + sigma * noise) / quantum) * quantum)
