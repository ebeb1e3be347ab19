"""Causes by their place: amplifier and cable [V], ceramic (its free strain is expressed in volts),
mechanics and sensor [um], and the noise. A record hides a cause by its name with its values.
"""

import math

import numpy as np
from scipy.signal import fftconvolve, lfilter

from tests.studies.exam.record import Floats, Record, Run, Values, filtered, lagged, named, resonant
from tests.studies.exam.voltages import triangle


def _amplifier_gain(command: Floats, run: Run, values: Values) -> Floats:
    """v + a_2 v^2/V + a_3 v^3/V^2, V the largest voltage."""
    largest = run.record.test.largest
    return command + values[0] * command**2 / largest + values[1] * command**3 / largest**2


def _dead_time(command: Floats, run: Run, values: Values) -> Floats:
    """The command, a time [s] later."""
    return np.interp(run.times - values[0], run.times, command)


def _amplifier_lag(command: Floats, run: Run, values: Values) -> Floats:
    """Second order: frequency [Hz] and damping."""
    return resonant(command, values[0], values[1], run.step)


def _output_limit(command: Floats, run: Run, values: Values) -> Floats:
    """No more than a share of the highest voltage."""
    return np.minimum(command, values[0] * run.record.test.limits[1])


def _slew_limit(command: Floats, run: Run, values: Values) -> Floats:
    """A largest rate [V/s]."""
    most, out = values[0] * run.step, command[0]
    outs = []
    for x in command.tolist():
        out += max(-most, min(most, x - out))
        outs.append(out)
    return np.array(outs)


def _controller(reference: Floats, run: Run, values: Values) -> Floats:
    """PI controller around the stack, whose reference is recorded in place of the voltage.

    c = k_p e + integral of k_i e, e = r less a reading that comes late; the stack has R_s C_p and
    Bouc-Wen's hysteresis of n = 1. `values`: k_p, k_i [1/s], delay [s].
    """
    proportional, integral, delay = values
    late = max(1, int(delay / run.step))
    A, beta = -0.3, 0.3 / (0.05 * run.record.test.span)
    u = total = float(reference[0])
    h, readings, drive = 0.0, [u] * late, []
    for i, r in enumerate(reference.tolist()):
        error = r - readings[i]
        total += integral * run.step * error
        drive.append(total + proportional * error)
        du = (drive[-1] - u) * run.step / run.record.stack.lag
        u += du
        h += A * du - beta * abs(du) * h
        readings.append(u + h)
    return np.array(drive)


def _current_limit(command: Floats, run: Run, values: Values) -> Floats:
    """R_s C_p whose voltage changes no faster than a rate [V/s]."""
    reached = 1 - math.exp(-run.step / run.record.stack.lag)
    most, u = values[0] * run.step, command[0]
    outs = []
    for x in command.tolist():
        u += max(-most, min(most, (x - u) * reached))
        outs.append(u)
    return np.array(outs)


#: Causes of the amplifier, in the order of the signal.
AMPLIFIER = named(
    _amplifier_gain, _dead_time, _amplifier_lag, _output_limit, _slew_limit, _controller
)
#: Causes of the stack's electrical side.
ELECTRICAL = ("current limit", "leakage")


def stack_voltage(output: Floats, run: Run) -> Floats:
    """Return the voltage on the stack behind R_s C_p, of which a leak passes the fast part."""
    hidden = run.record.hidden
    if "current limit" in hidden:
        u = _current_limit(output, run, hidden["current limit"])
    else:
        u = lagged(output, run.record.stack.lag, run.step)
    if "leakage" in hidden:
        (time,) = hidden["leakage"]
        u = u[0] + filtered([time, 0.0], [time, 1.0], u - u[0], run.step)
    return u


def _strain_saturation(strain: Floats, voltage: Floats, run: Run, values: Values) -> Floats:
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


def _self_heating(strain: Floats, voltage: Floats, run: Run, values: Values) -> Floats:
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
AT_ONCE = named(_strain_saturation, _field_gain, _asymmetry, _ageing, _self_heating, _temperature)
CREEP = named(_log_creep, _power_creep)


def free_strain(hysteretic: Floats, voltage: Floats, run: Run) -> Floats:
    """Return the free strain of a stack, from what its hysteresis gives [V]."""
    strain = run.changed(AT_ONCE, hysteretic, voltage)
    lag = run.record.stack.strain_lag
    strain = lagged(strain, lag, run.step) if lag else strain
    return run.changed(CREEP, strain, voltage)


def temperature(run: Run) -> Floats:
    """Return the temperature of the stack [degC]."""
    return 22 + 3 * np.sin(2 * math.pi * 0.8 * run.share + 1) + 1.5 * run.share


def displacement(strain: Floats, run: Run) -> Floats:
    """Return the displacement [um] of a stack from its free strain [V]."""
    moved = _vibrating(strain, run)
    modes = run.record.hidden.get("mode", ())
    if modes:
        frequency, damping, share = modes
        moved = moved + share * resonant(strain, frequency, damping, run.step)
    moved = moved * run.record.stack.stroke / run.record.test.span
    return run.changed(MOTION, moved)


def _vibrating(strain: Floats, run: Run) -> Floats:
    """Two resonances in a row, unless the masses are a pair or the damping grows."""
    f1, zeta1, f2, zeta2 = run.record.stack.mechanics
    hidden = run.record.hidden
    if "reciprocal masses" in hidden:
        return _two_masses(strain, run, hidden["reciprocal masses"][0])
    if "amplitude damping" in hidden:
        first = _growing_damping(strain, run, hidden["amplitude damping"][0])
        return resonant(first, f2, zeta2, run.step)
    zero = (2 * zeta1 / f1 + 6 * zeta2 / f2) / (8 * math.pi)
    return resonant(resonant(strain, f1, zeta1, run.step), f2, zeta2, run.step, zero)


def _two_masses(strain: Floats, run: Run, ratio: float) -> Floats:
    """Newton's equations of two masses, the outer `ratio` times the inner.

    x_B = (c_B s + k_B) k_P/((s^2 + (c_P + c_B) s + k_P + k_B)(q s^2 + c_B s + k_B) - (c_B s +
    k_B)^2) g, in a time that is scaled by the first frequency.
    """
    f1, zeta1, f2, zeta2 = run.record.stack.mechanics
    w1, w2 = 2 * math.pi * f1, 2 * math.pi * f2
    k_p, c_p = w1**2, 2 * zeta1 * w1
    k_b, c_b = ratio * w2**2, 2 * zeta2 * w2 * ratio
    link = np.array([c_b, k_b])
    outer = np.polymul([1, c_p + c_b, k_p + k_b], [ratio, c_b, k_b])
    total = np.polysub(outer, np.polymul(link, link)) / (k_b * k_p)
    numerator = link * w1 ** np.array([1, 0]) / k_b
    denominator = total * w1 ** np.arange(total.size)[::-1]
    return filtered(numerator.tolist(), denominator.tolist(), strain, run.step * w1)


def _growing_damping(strain: Floats, run: Run, growth: float) -> Floats:
    """One mode whose damping grows with its speed: 2 zeta w v (1 + k |v|/(w R)), midpoint rule."""
    f1, zeta, *_ = run.record.stack.mechanics
    w = 2 * math.pi * f1
    parts = max(1, math.ceil(run.step * w / 0.15))
    h, scale = run.step / parts, w * run.record.test.span

    def acceleration(force: float, x: float, v: float) -> float:
        return w * w * (force - x) - 2 * zeta * w * v * (1 + growth * abs(v) / scale)

    x, v = float(strain[0]), 0.0
    places = [x]
    for before, after in zip(strain[:-1].tolist(), strain[1:].tolist(), strict=True):
        for part in range(parts):
            force = before + (after - before) * (part + 0.5) / parts
            middle = v + h / 2 * acceleration(force, x, v)
            v += h * acceleration(force, x + h / 2 * v, middle)
            x += h * middle
        places.append(x)
    return np.array(places)


def _stiffening_load(x: Floats, run: Run, values: Values) -> Floats:
    """A load whose force grows exponentially: y + a R (exp(y/l) - 1 - y/l) = x, by Newton."""
    force, length = values[0] * run.record.stack.stroke, values[1] * run.record.stack.stroke
    y = x.copy()
    for _ in range(30):
        growth = np.exp(y / length)
        error = y + force * (growth - 1 - y / length) - x
        y -= error / (1 + force / length * (growth - 1))
    return y


def _contact(x: Floats, run: Run, values: Values) -> Floats:
    """A contact that opens: beyond x_0 the slope is smaller by k, with a rounded corner."""
    loss, place, width = values
    size = width * run.record.stack.stroke
    corner = np.logaddexp(0, (x - place * run.record.stack.stroke) / size)
    return np.asarray(x - loss * size * corner)


def _guide_friction(x: Floats, run: Run, values: Values) -> Floats:
    """The stack's spring against a guide that sticks: y = x - c F, F' = (1 - F sgn y') y'/l.

    Source: P. R. Dahl, AIAA J. 14 (1976) 1675.
    """
    push, length = values[0] * run.record.stack.stroke, values[1] * run.record.stack.stroke
    force, last = 0.0, float(x[0])
    out = []
    for place in x.tolist():
        moved, last = place - last, place
        slope = (1 - force * float(np.sign(moved))) / length
        force += slope * moved / (1 + push * slope)
        out.append(place - push * force)
    return np.array(out)


def _play(x: Floats, run: Run, values: Values) -> Floats:
    """A joint that follows only beyond its play."""
    width, place = values[0] * run.record.stack.stroke, float(x[0])
    out = []
    for driven in x.tolist():
        place = max(driven - width, min(driven + width, place))
        out.append(place)
    return np.array(out)


def _stick_slip(x: Floats, run: Run, values: Values) -> Floats:
    """Short whiles in which the output moves in jerks."""
    size, count = values
    rng, out = run.record.draws(5), np.zeros(x.size)
    for start in np.sort(rng.integers(0, x.size, int(count))).tolist():
        stop = min(x.size, start + int(x.size * rng.uniform(0.01, 0.04)))
        jerk = size * run.record.stack.stroke * rng.uniform(0.5, 1.5)
        away = x[start:stop] - x[start]
        out[start:stop] = np.clip(np.round(away / (4 * jerk)) * 4 * jerk - away, -jerk, jerk)
    return x + out


#: Causes that change the displacement [um], in the order of the signal.
MOTION = named(_stiffening_load, _contact, _guide_friction, _play, _stick_slip)
#: Causes within the masses.
MASSES = ("mode", "reciprocal masses", "amplitude damping")


def _clock(y: Floats, run: Run, values: Values) -> Floats:
    """A clock that runs ever faster than the drive's: read at t + e t^2/T."""
    return np.interp(run.times + values[0] * run.times * run.share, run.times, y)


def _delay(y: Floats, run: Run, values: Values) -> Floats:
    """The reading, a time [s] later."""
    return np.interp(run.times - values[0], run.times, y)


def _sensor_lag(y: Floats, run: Run, values: Values) -> Floats:
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


def _floor_vibration(y: Floats, run: Run, values: Values) -> Floats:
    """A floor that vibrates: noise through a resonance of frequency [Hz] and damping; its rms."""
    frequency, damping, size = values
    noise = run.record.draws(6).standard_normal(y.size)
    floor = resonant(noise, frequency, damping, run.step)
    return y + size * run.record.stack.stroke / float(floor.std()) * floor


def _interference(y: Floats, run: Run, values: Values) -> Floats:
    """Short bursts of interference at random instants: size and number."""
    size, count = values
    length = run.times[-1]
    wave = np.sin(2 * math.pi * run.record.test.rate * 0.31 * run.times)
    for centre in run.record.draws(7).uniform(0, length, int(count)).tolist():
        near = np.exp(-(((run.times - centre) / (0.006 * length)) ** 2))
        y = y + size * run.record.stack.stroke * near * wave
    return y


def _second_device(y: Floats, run: Run, values: Values) -> Floats:
    """Another actuator that moves the stack: size, frequency [Hz] of its triangle."""
    size, frequency = values
    slow = 1 + 0.3 * np.sin(2 * math.pi * frequency * 0.37 * run.times)
    return y + size * run.record.stack.stroke * triangle(frequency * run.times + 0.13) * slow


#: Causes that change the reading [um], in the order of the signal; sizes are shares of the stroke.
READING = named(
    _clock,
    _delay,
    _sensor_lag,
    _bend,
    _ripple,
    _drift,
    _gain_drift,
    _offset_step,
    _hum,
    _floor_vibration,
    _interference,
    _second_device,
)
#: Step of the reading, as a share of the noise's rms.
QUANTUM = 0.2


def with_noise(clean: Floats, record: Record) -> Floats:
    """Add the noise that a record states, white or AR(1), and round to the sensor's step."""
    sigma = record.test.noise * 1e-2 * float(np.ptp(clean))
    noise = record.draws(3).standard_normal(clean.size)
    pole = record.test.colour
    if pole:
        noise = np.asarray(lfilter([math.sqrt(1 - pole**2)], [1, -pole], noise))
    quantum = QUANTUM * sigma
    return np.asarray(np.round((clean + sigma * noise) / quantum) * quantum)
