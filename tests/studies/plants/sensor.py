"""Hidden effects of the sensor and its surroundings: what is read is not what moves."""

import math

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

from tests.studies.plants.base import Run, first_order
from tests.studies.plants.effect import Draw, Parameters, hidden
from tests.studies.plants.stack import FloatArray


@hidden("d", "s", (2e-5, 1e-2), of_sensor=True)
def sensor_delay(run: Run, _: Parameters, gain: float) -> FloatArray:
    """A sensor that reports late by a pure delay.

        measured(t) = x(t - d)

    by cubic interpolation of the displacement on the fine grid (x = 0 before the record).
    Source: none needed; e.g. the output filter and bus of a digital interferometer. Not the
    project's form: a shift, not a Padé fraction.
    """
    spline, start = CubicSpline(run.path.time, run.fine_displacement), run.path.time[0]
    read = np.asarray(spline(np.maximum(run.times - gain, start)), dtype=np.float64)
    return read - run.displacement


@hidden("T", "s", (2e-5, 4e-3), refit=True, of_sensor=True)
def sensor_lag(run: Run, _: Parameters, gain: float) -> FloatArray:
    """A sensor with a first-order low-pass.

        T m' + m = x

    exact for a displacement that is linear on each sub-interval. g = T. Source: the
    bandwidth in the data sheet of any capacitive or inductive sensor, 40 Hz to 8 kHz. Not
    the project's form: a recursion on the finished displacement, no further state.

    A fit of R_s C_p and tau leaves 0.5 to 2 times the noise at most, at any T: often
    limited.
    """
    slow = first_order(-1.0 / gain + 0j, run.fine_displacement, run.fine_step).real / gain
    return (slow - run.fine_displacement)[:: run.sub_intervals]


def bend(x: FloatArray, centre: float, span: float, b: float) -> FloatArray:
    """h, (N,) [1]: zero in the centre and half the range away from it."""
    z = 2.0 * (x - centre) / span
    return np.asarray(np.arctan(b * z) / math.atan(b) - z, dtype=np.float64)


def _bent(d: Draw) -> dict[str, float]:
    """Centre x_c and range S [m], steepness b."""
    return {"centre": d.place(0.25, 0.75), "span": d.span, "b": d.uniform(1.0, 2.5)}


@hidden("g", "1", (5e-4, 0.3), linear=True, of_sensor=True, drawn=_bent)
def sensor_nonlinearity(run: Run, p: Parameters, gain: float) -> FloatArray:
    """A sensor whose characteristic bends: a function of the displacement alone.

        measured = x + g S (h(z) - h(z_0)),   h(z) = atan(b z)/atan(b) - z,   z = 2 (x - x_c)/S

    S: range moved; x_c: electrical centre, off the middle; z_0: z at x = 0. Source: the
    S-shaped error of differential transformers and Hall sensors, e.g. J. Fraden, "Handbook
    of Modern Sensors". Not the project's form: no polynomial.
    """
    shape = p["centre"], p["span"], p["b"]
    return gain * p["span"] * (bend(run.displacement, *shape) - bend(np.zeros(1), *shape))


def _grating(d: Draw) -> dict[str, float]:
    """Period and phase of the grating, errors of its signals."""
    return {
        "period": d.uniform(1.6e-6, 2.4e-6), "phase": d.uniform(0.0, 6.28),
        "p": d.uniform(0.1, 0.3), "q": d.uniform(-0.3, 0.3), "k": d.uniform(-0.3, 0.3),
        "c": d.uniform(-0.3, 0.3),
    }  # fmt: skip


def angle_error(angle: FloatArray, parameters: Parameters) -> FloatArray:
    """Error of the angle that the two signals yield [rad]."""
    first = np.cos(angle + parameters["c"]) + parameters["p"]
    second = (1.0 + parameters["k"]) * np.sin(angle) + parameters["q"]
    result = np.arctan2(second, first) - angle
    return np.asarray(result - 2.0 * math.pi * np.round(result / (2.0 * math.pi)), dtype=np.float64)


@hidden("g", "m", (1e-9, 3e-7), linear=True, called="sensor_ripple", of_sensor=True, drawn=_grating)
def encoder_ripple(run: Run, p: Parameters, gain: float) -> FloatArray:
    """The sub-divisional error of an optical encoder, periodic in the displacement.

        measured = x + g e(2 pi x/L + phi),   e(a) = arg(cos(a + c) + p + i ((1 + k) sin a + q)) - a

    two signals with offsets p and q, unequal amplitudes k and a phase that is off by c; e
    has rms 1. L: grating signal period, about 2 um; g: up to a few percent of it. Source:
    P. L. M. Heydemann, "Determination and correction of quadrature fringe measurement
    errors in interferometers", Appl. Opt. 20 (1981) 3382. Not the project's form: the angle
    of a bent circle, with all harmonics.
    """
    once = angle_error(np.linspace(0.0, 2.0 * math.pi, 721)[:-1], p)
    angle = 2.0 * math.pi * run.displacement / p["period"] + p["phase"]
    rest = angle_error(np.array([p["phase"]]), p)
    return np.asarray(gain * (angle_error(angle, p) - rest) / np.std(once))


def _converter(d: Draw) -> dict[str, float]:
    """Mid-scale and the distance of the next bit's steps [m], and their height over its."""
    return {
        "mid": d.place(0.25, 0.75), "quarter": d.uniform(0.3, 0.6) * d.span,
        "next": d.uniform(-0.25, 0.25),
    }  # fmt: skip


@hidden("g", "m", (1e-9, 3e-7), linear=True, called="sensor_jump", of_sensor=True, drawn=_converter)
def converter_step(run: Run, p: Parameters, gain: float) -> FloatArray:
    """The major carry of a sensor's analogue-to-digital converter: its bits do not add up.

        measured = x + g (H(x - a) + c H(x - a + b) + c H(x - a - b)) - the same at x = 0

    H is the unit step. Where all lower bits turn at once, at mid-scale a, the mismatch of
    the largest bit shows as a jump; the next bit's at a quarter of the scale b below and
    above it. Source: W. Kester (ed.), "The Data Conversion Handbook", Analog Devices
    (2005), 2.3 (static linearity, major carry). Not the project's form: hard steps, and
    three of them.
    """
    x, mid, quarter = np.append(0.0, run.displacement), p["mid"], p["quarter"]
    others = (x > mid - quarter).astype(float) + (x > mid + quarter)
    steps = (x > mid) + p["next"] * others
    return np.asarray(gain * (steps - steps[0])[1:], dtype=np.float64)


def _drift(d: Draw) -> dict[str, float]:
    """Direction, and the kind and size of the departure from a straight line."""
    direction = {"direction": d.sign()}
    if d.rng.integers(2):
        return {**direction, "exponential": d.uniform(-0.3, 0.3), "q": d.uniform(0.2, 0.6)}
    return {**direction, "slope_change": d.uniform(-0.3, 0.3), "s_1": d.uniform(0.3, 0.7)}


@hidden("g", "m", (1e-9, 3e-6), linear=True, of_sensor=True, drawn=_drift)
def offset_drift(run: Run, p: Parameters, gain: float) -> FloatArray:
    """A zero point that wanders, whatever the voltage does.

        x_drift = g D(s),  s = t/T from 0 to 1
        D = s + c (1 - exp(-s/q)),  |c| <= 0.3      or      D = s + e max(s - s_1, 0),  |e| <= 0.3

    A ramp with a small saturating exponential, or a ramp whose slope changes once. Source:
    warming of frames and interferometer paths. Not the project's form: not a straight line.

    g is about the drift over the whole record [m].
    """
    s = (run.times - run.times[0]) / float(run.times[-1] - run.times[0])
    if "q" in p:
        shape = s + p["exponential"] * (1.0 - np.exp(-s / p["q"]))
    else:
        shape = s + p["slope_change"] * np.maximum(s - p["s_1"], 0.0)
    return np.asarray(gain * p["direction"] * shape, dtype=np.float64)


def _hum(d: Draw) -> dict[str, float]:
    """Frequency [Hz], phases, third harmonic of 5-20 %."""
    mains, turn = 50.0 if d.rng.integers(2) else 60.0, 2.0 * math.pi
    return {
        "frequency": mains * (1.0 + 1e-3 * d.uniform(-1.0, 1.0)), "a": d.uniform(0.0, turn),
        "b": d.uniform(0.05, 0.2), "c": d.uniform(0.0, turn),
    }  # fmt: skip


@hidden("g", "m", (1e-10, 3e-6), linear=True, of_sensor=True, drawn=_hum)
def mains_hum(run: Run, p: Parameters, gain: float) -> FloatArray:
    """Hum of the mains with its third harmonic.

        x_hum = g (sin(w t + a) + b sin(3 w t + c)),   w = 2 pi 50 or 60 Hz, off by at most 0.1 %

    Sampled at less than twice the frequency it appears as its alias, as it does in a real
    record. Source: magnetising current of transformers, e.g. H. W. Ott, "Electromagnetic
    Compatibility Engineering". Not the project's form: not a single line.
    """
    angle = 2.0 * math.pi * p["frequency"] * run.times
    third = p["b"] * np.sin(3.0 * angle + p["c"])
    return np.asarray(gain * (np.sin(angle + p["a"]) + third), dtype=np.float64)


def _room(d: Draw) -> dict[str, float]:
    """Room: T_0 [degC], D [K], tau and tau_f [s], size and seed of the walk; b; S [m]."""
    return {
        "t_0": d.uniform(19.0, 26.0), "d": d.uniform(0.3, 1.0) * d.sign(),
        "tau": d.uniform(0.3, 1.5) * d.length, "tau_f": d.uniform(0.005, 0.03) * d.length,
        "walk": d.uniform(0.15, 0.4), "length": d.length, "b": d.uniform(0.0, 0.3),
        "span": d.span, "seed": d.seed(),
    }  # fmt: skip


def room(times: FloatArray, parameters: Parameters) -> FloatArray:
    """T at the samples, (N,) [degC]; the walk is smoothed over a fiftieth of the record."""
    rng = np.random.default_rng(int(parameters["seed"]))
    age, step = times - times[0], float(times[1] - times[0])
    drift = parameters["d"] * (1.0 - np.exp(-age / parameters["tau"]))
    decay = np.exp(-50.0 * step / parameters["length"])
    kicks = rng.standard_normal(times.size) * np.sqrt(step / parameters["length"])
    smooth = lfilter([1.0 - decay], [1.0, -decay], np.cumsum(kicks))
    return np.asarray(parameters["t_0"] + drift + parameters["walk"] * smooth, dtype=np.float64)


@hidden("g", "m/K", (1e-9, 2e-6), linear=True, room=room, drawn=_room)
def temperature(run: Run, p: Parameters, gain: float) -> FloatArray:
    """A room whose temperature moves.

    The frame expands and the gain changes. The thermometer is in the record.

        T(t) = T_0 + D (1 - exp(-t/tau)) + random walk           thermometer, a column of the record
        (tau_f/2 s + 1)^2 T_f = T - T(0)                           frame, through a wall
        x -> x + g T_f (1 + b x/S)

    g: expansion for each kelvin; b: share by which it grows over the range S (gain of the
    ceramic). Source: frames of 10-20 ppm/K and 10-40 mm. Not the project's form: the frame
    follows the thermometer through two lags in series, a coarse wall.
    """
    air = room(run.times, p)
    frame, lag = air - air[0], 0.5 * p["tau_f"]
    for _ in range(2):
        frame = first_order(-1.0 / lag + 0j, frame, float(run.times[1] - run.times[0])).real / lag
    return np.asarray(gain * frame * (1.0 + p["b"] * run.displacement / p["span"]), np.float64)


@hidden(
    "g", "1", (1e-4, 0.03), linear=True, foreign=True, of_sensor=True,
    drawn=lambda d: {"level": d.place(0.35, 0.65), "half": d.uniform(0.02, 0.06) * d.span},
)  # fmt: skip
def range_switch(run: Run, p: Parameters, gain: float) -> FloatArray:
    """Foreign: a sensor that changes its gain range at one level.

        measured = x (1 + g)  in the upper range,   x  in the lower range
        up when x > x_s + e,   down when x < x_s - e

    The two ranges disagree by g (0.3-1 % in instruments that are adjusted, more in others),
    so the reading jumps by g x_s; the level of return lies 2 e lower, so it is no function
    of the displacement. Source: autoranging amplifiers, e.g. Keithley, "Low Level
    Measurements Handbook".

    Above 1 % only where the base absorbs most of it.
    """
    x, level, half = run.displacement, p["level"], p["half"]
    decided = (x > level + half) | (x < level - half)
    last = np.maximum.accumulate(np.where(decided, np.arange(x.size), -1))
    upper = (last >= 0) & (x[np.maximum(last, 0)] > level)  # starts in the lower range
    return np.asarray(gain * x * upper)


def _source(d: Draw) -> dict[str, float]:
    """Correlation time T [s], 1-4 % of the record's length, and the seed of the noise."""
    return {"t": d.uniform(0.01, 0.04) * d.length, "seed": d.seed()}


@hidden("g", "1", (1e-4, 0.1), linear=True, foreign=True, random=True, drawn=_source)
def source_power(run: Run, p: Parameters, gain: float) -> FloatArray:
    """Foreign: an optical sensor whose source flickers slowly: the gain of the reading
    wanders.

        measured = x (1 + g n(t)),   (T d/dt + 1)^2 n = white noise,   rms of n = 1

    n is unrelated to the voltage: it comes and goes, so it is neither ageing nor heat, and
    it vanishes at x = 0, so it is no drift. Source: relative intensity noise of diodes in
    reflective sensors, e.g. K. Petermann, "Laser Diode Modulation and Noise".
    """
    decay = math.exp(-float(run.times[1] - run.times[0]) / p["t"])
    noise = np.random.default_rng(int(p["seed"])).standard_normal(2 * run.times.size)
    slow = np.asarray(lfilter([1.0], [1.0, -2.0 * decay, decay**2], noise))[run.times.size :]
    slow = slow - slow.mean()
    return np.asarray(gain * (slow / np.std(slow)) * run.displacement)


def held(run: Run, renewals: int, skew: float, first: float) -> FloatArray:
    """A sensor that renews its reading by one clock, read by another one.

        measured(t_n) = x(P floor((t_n - t_0) / P) + t_0),   P = h (1 - skew) / m

    The sensor converts every P seconds and holds the value; the record takes one every h
    seconds. P is nearly the m-th part of h, so that the age of what is taken moves by h
    skew a sample, and jumps by P after P / (h skew) samples. Source: none needed; two
    quartz clocks differ by 10 to 100 ppm. Not the project's form: the value held at a true
    instant, by cubic interpolation, and no delay anywhere.

    Displacement as the record takes it, (N,) [m]; renewals: m; skew: relative difference of
    the clocks; first: t_0 as a share of P.
    """
    step = float(run.times[1] - run.times[0])
    period = step * (1.0 - skew) / renewals
    start = (first - 1.0) * period
    instants = start + period * np.floor((run.times - start) / period)
    taken = CubicSpline(run.path.time, run.fine_displacement)(np.maximum(instants, 0.0))
    return np.asarray(taken, dtype=np.float64)
