"""What one effect does to an ordinary stack: its signature, as figures to draw.

    d = y - (a + b y_0)

is the difference of the readings with (y) and without (y_0) the effect; offset a and slope b are
fitted, as an identification of the base would. It is looked at along every coordinate of a misfit.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis import views
from psa_casadi.model.component import SPECTRAL_PEAKS, Component
from psa_casadi.model.compose import Model
from psa_casadi.model.stacks import stack_model
from psa_casadi.records.record import Record
from psa_casadi.simulation.simulate import simulate

STACK = "P-885.51"
#: Period [s] of the slow loops of the standard voltage, for the slow play and the quick one.
_PERIODS = (0.25, 0.0025)
_SAMPLES = 4001
#: Loops: first and last period, span over the rated voltage, period over that of the slow loops.
_LOOPS = ((0, 2, 1.0, 1.0), (2, 3, 0.4, 1.0), (3, 3.6, 1.0, 0.2), (3.6, 4.2, 0.4, 0.2))
#: Steps: when they begin [periods], and the level they lead to; how long one takes.
_STEPS, _RISE = ((4.2, 0.8), (6.2, 0.3)), 0.1
_END = 8.2
#: The gain's ordinary size is multiplied by the first factor that makes d plain to see: its rms
#: over the stroke lies between these limits; if none does, by that which comes nearest.
_FACTORS = (1.0, 3.0, 0.3, 10.0, 0.1, 0.03, 0.02, 30.0, 100.0)
_PLAIN = (3e-3, 3e-2)
#: Everything is a function of time: another coordinate is weight where it has this share of it.
_RATHER = 0.8
#: Warming [K] during a play, for effects that follow the temperature.
_WARMING = 3.0
#: Artificial noise, a share of d: no view is free of error. Half width of a peak's band.
_NOISE, _BAND = 0.02, 0.1


@dataclass(frozen=True, eq=False)
class Signature:
    """The signature of an effect on a stack; arrays (n,) over `time` [s], displacements in m.

    `base` is the reading without the effect, offset and slope fitted to `changed`, the one with it.
    `size` is that of the parameter `gain` in `unit`. `telling` is the view of the difference that
    explains most of it: binned means along `coordinate` (n,), nan where it has no value, of
    `counted` (n,), the difference with the sign that the view gives it. Both are empty for a
    spectrum, whose `telling` holds amplitude densities [m/sqrt(Hz)]. Its share is that of the
    difference's power.
    """

    effect: str
    stack: str
    gain: str
    unit: str
    size: float
    time: FloatArray
    voltage: FloatArray
    base: FloatArray
    changed: FloatArray
    telling: views.View
    coordinate: FloatArray
    counted: FloatArray

    @property
    def difference(self) -> FloatArray:
        """With the effect minus without it [m], shape (n,)."""
        return self.changed - self.base

    @property
    def stroke(self) -> float:
        """Range of the reading without the effect [m]."""
        return float(np.ptp(self.base))


@dataclass(frozen=True, eq=False)
class _Play:
    """A voltage (n,) with what it shows of an effect: both readings and the warming (n,) [K]."""

    size: float
    time: FloatArray
    voltage: FloatArray
    base: FloatArray
    changed: FloatArray
    warming: FloatArray | None

    @property
    def off(self) -> float:
        """By which factor, as a logarithm, the difference is too small or too large to be plain."""
        plain = float(np.std(self.changed - self.base)) / float(np.ptp(self.base))
        return abs(float(np.log(max(plain, 1e-12) / np.clip(plain, *_PLAIN))))


def signature(effect: Component) -> Signature:
    """Return what an effect changes on a P-885.51 without effects.

    Plays loops of two amplitudes and rates and two steps with holds in 2 s; or in 20 ms, for an
    effect that does not show in 2 s. The effect has the ordinary size of its gain if it shows.

    Raises:
        SimulationError: the stack cannot follow the voltage.
    """
    base = stack_model(STACK)
    extended = base.with_effect(effect)
    plays = _plays(base, extended, effect)
    best = next(plays)
    # the first that shows it plainly, else the nearest to that: far beyond an effect hides its form
    for play in plays:
        if best.off == 0.0:
            break
        best = play if play.off < best.off else best
    telling, coordinate, counted = _telling(effect, best)
    gain = extended.parameter(effect.gain or "")
    return Signature(
        effect.name, STACK, gain.name, gain.unit, best.size,
        best.time, best.voltage, best.base, best.changed, telling, coordinate, counted,
    )  # fmt: skip


def standard_voltage(period: float, span: float) -> tuple[FloatArray, FloatArray]:
    """Return time [s] and voltage [V] of the standard play, both (4001,).

    Loops of 0 to `span` and to 0.4 `span` at the slow and at five times the rate, then steps to
    0.8 and 0.3 `span` with holds.
    """
    when = np.linspace(0.0, _END, _SAMPLES)
    voltage = np.zeros(_SAMPLES)
    for first, last, height, length in _LOOPS:
        on = (when >= first) & (when < last)
        voltage[on] = height * _raised((when[on] - first) * 2.0 / length)
    before = 0.0
    for first, level in _STEPS:
        on = when >= first
        way = np.minimum((when[on] - first) / _RISE, 1.0)
        voltage[on] = before + (level - before) * _raised(way)
        before = level
    return period * when, span * voltage


def _raised(way: FloatArray) -> FloatArray:
    return 0.5 * (1.0 - np.cos(np.pi * way))


def _plays(base: Model, extended: Model, effect: Component) -> Iterator[_Play]:
    """Yield the plays of all periods and sizes, the ordinary size of the slow one first."""
    gain = extended.parameter(effect.gain or "")
    ordinary = gain.typical({**extended.values, gain.name: 0.0})
    memory = effect.trial_starts[0] if effect.trial_starts else None
    for period in _PERIODS:
        time, voltage = standard_voltage(period, base.values["u_rated"])
        warming, inputs = None, {}
        if "temperature" in extended.input_names:
            warming = _WARMING * time / time[-1]
            room = next(i.start for i in extended.structure.inputs if i.name == "temperature")
            inputs = {"temperature": room + warming}
        y_0 = simulate(base, time, voltage).displacement
        for factor in _FACTORS:
            size = float(np.clip(factor * ordinary, *gain.bounds))
            changed = extended.with_values({gain.name: size})
            y = simulate(changed, time, voltage, memory=memory, **inputs).displacement
            line = np.column_stack([np.ones_like(y_0), y_0])
            fitted = line @ np.linalg.lstsq(line, y, rcond=None)[0]
            yield _Play(size, time, voltage, fitted, y, warming)


def _telling(effect: Component, play: _Play) -> tuple[views.View, FloatArray, FloatArray]:
    """Return the view that explains most of the difference, its coordinate, and what it counts."""
    d = play.changed - play.base
    if SPECTRAL_PEAKS in effect.probe.values():
        return _spectrum(play.time, d), np.zeros(0), np.zeros(0)
    record = Record(
        name="signature", time=play.time, voltage=play.voltage, displacement=play.changed
    )
    rows = [views.time_axis(record), *views.axes(record, play.base, views.drive_of(record))]
    # two amplitudes at two rates make no curve
    rows = [row for row in rows if not row.name.startswith(("amplitude", "frequency"))]
    if play.warming is not None:
        rows = [views.Axis("temperature", "K", play.warming)]
    signatures = [_view(axis, d) for axis in rows]
    if any(s.memory and s.settles for s in effect.states):
        axis, _ = views.hold_axis(record)
        signatures.append(_view(axis, _since_it_began(axis.x, d)))

    def weight(row: tuple[views.View, FloatArray, FloatArray]) -> float:
        return row[0].share * (_RATHER if row[0].name == "time" else 1.0)

    return max(signatures, key=weight)


def _view(axis: views.Axis, d: FloatArray) -> tuple[views.View, FloatArray, FloatArray]:
    """Return the binned means of a difference along an axis, with the share they explain.

    No part is left out for judging, as in a measured record: this one has no noise but 2 %, and no
    repetition. With it come coordinate and signed difference (n,), nan where they do not count.
    """
    there = np.isfinite(d)
    noise = _NOISE * float(np.nanstd(d))
    residual = d + noise * np.random.default_rng(0).standard_normal(d.size)
    seen = views.view(views.ground_of(residual, noise), axis)
    sign = np.ones(d.size) if axis.sign is None else axis.sign
    on = there & np.isfinite(axis.x) & (sign != 0)
    coordinate, counted = np.where(on, axis.x, np.nan), np.where(on, d * sign, np.nan)
    if not seen.x.size:
        return seen, coordinate, counted
    x, bins = (np.log10(v) if axis.log else v for v in (coordinate[on], seen.x))
    left = counted[on] - np.interp(x, bins, seen.mean)
    power = float(np.sum(d[there] ** 2))
    others = float(np.sum(d[there & ~on] ** 2))
    share = 1.0 - (float(np.sum(left**2)) + others) / power if power > 0 else 0.0
    return replace(seen, share=max(0.0, share)), coordinate, counted


def _since_it_began(since: FloatArray, d: FloatArray) -> FloatArray:
    """Return the difference (n,) from that at the beginning of its hold, nan outside of holds."""
    first = np.isfinite(since) & ~(np.r_[np.inf, since[:-1]] < since)
    moved = np.full(d.size, np.nan)
    for start in np.flatnonzero(first).tolist():
        rest = np.flatnonzero(~np.isfinite(since[start:]))
        stop = start + int(rest[0]) if rest.size else d.size
        moved[start:stop] = d[start:stop] - d[start]
    return moved


def _spectrum(time: FloatArray, d: FloatArray) -> views.View:
    """Return the amplitude density; its share is that of the band around the highest peak."""
    step = float(time[-1]) / (time.size - 1)
    window = np.hanning(d.size)
    power = np.abs(np.fft.rfft((d - np.mean(d)) * window)) ** 2
    frequency = np.asarray(np.fft.rfftfreq(d.size, step), dtype=np.float64)
    peak = float(frequency[np.argmax(power)])
    band = np.abs(frequency - peak) <= max(_BAND * peak, 2.0 * frequency[1])
    share = float(np.sum(power[band]) / np.sum(power))
    drawn = (frequency > 0) & (frequency < 20.0 * peak)
    density = np.sqrt(2.0 * step * power / float(window @ window))[drawn]
    none = np.zeros(density.size)
    return views.View("spectrum", "Hz", frequency[drawn], density, none, share, True)
