"""What an effect does: its signature on an ordinary stack, and its size for one stack.

The signature is the difference of the readings with (y) and without (y_0) the effect,

    d = y - (a + b y_0)

offset a and slope b are fitted, as an identification of the base would. It is looked at along every
coordinate of a misfit.

The size is stated in tests that anyone can repeat on the device. A test plays a voltage
through the model with the effect and with the effect's gain at 0. The
difference d(t) of what the two show is what the effect does:

    hold       step to the highest voltage: d 10 s and 10 min later, less d at the step's end
    reversal   slow loops: the largest difference of d between the two ways at one voltage
    range      slow rise: the largest |d - (a + b y_0)|, and at the top d itself
    slew       loop at the records' fastest rate: the largest |d|
    resonance  linearised at rest: the largest ratios of the two responses, and where
    record     the records themselves: the range of d in one of them, and its rms

y_0 is what the model shows without the effect; offset a and slope b are fitted, since a user takes
them for zero and sensitivity. Of an identified model voltages, rate and duration are those of its
records; else the voltage is the rated one and the record a standard one.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from psa_casadi.common.errors import PsaError
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis import misfit
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.model.component import SPECTRAL_PEAKS, Component
from psa_casadi.model.compose import Model
from psa_casadi.model.stacks import stack_model
from psa_casadi.model.variables import NORMAL_95
from psa_casadi.records.record import Record
from psa_casadi.simulation.simulate import (
    accurate,
    input_samples,
    output_of,
    record_inputs,
    simulate,
)
from psa_casadi.simulation.start import linear_part, start_on

STACK = "P-885.51"
#: Period [s] of the slow loops of the standard voltage, for the slow play and the quick one.
_PERIODS = (0.25, 0.0025)
_PLAYED = 4001
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
_HEATING = 3.0
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
    telling: misfit.View
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
    when = np.linspace(0.0, _END, _PLAYED)
    voltage = np.zeros(_PLAYED)
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
            warming = _HEATING * time / time[-1]
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


def _telling(effect: Component, play: _Play) -> tuple[misfit.View, FloatArray, FloatArray]:
    """Return the view that explains most of the difference, its coordinate, and what it counts."""
    d = play.changed - play.base
    if SPECTRAL_PEAKS in effect.probe.values():
        return _spectrum(play.time, d), np.zeros(0), np.zeros(0)
    record = Record(
        name="signature", time=play.time, voltage=play.voltage, displacement=play.changed
    )
    rows = [misfit.time_axis(record), *misfit.axes(record, play.base, misfit.drive_of(record))]
    # two amplitudes at two rates make no curve
    rows = [row for row in rows if not row.name.startswith(("amplitude", "frequency"))]
    if play.warming is not None:
        rows = [misfit.Axis("temperature", "K", play.warming)]
    signatures = [_view(axis, d) for axis in rows]
    if any(s.memory and s.settles for s in effect.states):
        axis, _ = misfit.hold_axis(record)
        signatures.append(_view(axis, _since_it_began(axis.x, d)))

    def weight(row: tuple[misfit.View, FloatArray, FloatArray]) -> float:
        return row[0].share * (_RATHER if row[0].name == "time" else 1.0)

    return max(signatures, key=weight)


def _view(axis: misfit.Axis, d: FloatArray) -> tuple[misfit.View, FloatArray, FloatArray]:
    """Return the binned means of a difference along an axis, with the share they explain.

    No part is left out for judging, as in a measured record: this one has no noise but 2 %, and no
    repetition. With it come coordinate and signed difference (n,), nan where they do not count.
    """
    there = np.isfinite(d)
    noise = _NOISE * float(np.nanstd(d))
    residual = d + noise * np.random.default_rng(0).standard_normal(d.size)
    view = misfit.view(misfit.ground_of(residual, noise), axis)
    sign = np.ones(d.size) if axis.sign is None else axis.sign
    on = there & np.isfinite(axis.x) & (sign != 0)
    coordinate, counted = np.where(on, axis.x, np.nan), np.where(on, d * sign, np.nan)
    if not view.x.size:
        return view, coordinate, counted
    x, bins = (np.log10(v) if axis.log else v for v in (coordinate[on], view.x))
    left = counted[on] - np.interp(x, bins, view.mean)
    power = float(np.sum(d[there] ** 2))
    others = float(np.sum(d[there & ~on] ** 2))
    share = 1.0 - (float(np.sum(left**2)) + others) / power if power > 0 else 0.0
    return replace(view, share=max(0.0, share)), coordinate, counted


def _since_it_began(since: FloatArray, d: FloatArray) -> FloatArray:
    """Return the difference (n,) from that at the beginning of its hold, nan outside of holds."""
    first = np.isfinite(since) & ~(np.r_[np.inf, since[:-1]] < since)
    moved = np.full(d.size, np.nan)
    for start in np.flatnonzero(first).tolist():
        rest = np.flatnonzero(~np.isfinite(since[start:]))
        stop = start + int(rest[0]) if rest.size else d.size
        moved[start:stop] = d[start:stop] - d[start]
    return moved


def _spectrum(time: FloatArray, d: FloatArray) -> misfit.View:
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
    return misfit.View("spectrum", "Hz", frequency[drawn], density, none, share, True)


#: When a hold is looked at [s] after its step, and how long the step takes [s].
_HELD, _STEP = (10.0, 600.0), 0.02
#: Samples of one way, and how long a slow one takes [s].
_SAMPLES, _SLOW = 200, 1.0
#: Tolerance of the runs over the range of the displacement: both err by the same share.
_RTOL = 1e-5
#: Resonances that are listed, and the smallest change of the response there that counts.
_MOST, _TOLD = 3, 0.02
#: Period [s] of a model's loops that has no records, and its warming [K] in them.
_PERIOD, _WARMING = 0.25, 1.0


class Figure(NamedTuple):
    """What a test shows: a value, its unit ("" for that of the displacement), where in the test."""

    test: str
    value: float
    unit: str
    at: float
    at_unit: str


@dataclass(frozen=True, eq=False)
class Drive:
    """What a model is driven with: voltages [V], largest rate [V/s], longest duration [s], plays.

    A play is time (n,), inputs (n, nu) and the state at its start, None where it is at rest;
    `without` keeps what a model without the effect shows in it.
    """

    low: float
    high: float
    rate: float
    longest: float
    plays: tuple[tuple[FloatArray, FloatArray, FloatArray | None], ...]
    without: dict[int, FloatArray] = field(default_factory=dict)


def drive_of(model: Model, effect: Component, records: Sequence[Record]) -> Drive:
    """Return what a model is driven with: its records, that of its evidence, or standard loops."""
    known = model.evidence
    plays = []
    for r in records:
        run = None if known is None else known.run_of(r.name)
        x0 = None if run is None else _state(model, run.start)
        plays.append((r.time, record_inputs(model, r, r.n), x0))
    if known is not None and known.seen.rate > 0:
        if not plays and known.reference is not None:
            play, run = known.reference, known.run_of(known.reference.record)
            inputs = {n: np.array(v) for n, v in play.inputs.items() if n in model.input_names}
            x0 = None if run is None else _state(model, run.start)
            plays = [(np.array(play.time), input_samples(model, len(play.time), inputs), x0)]
        low, high = known.seen.voltage.low, known.seen.voltage.high
        return Drive(low, high, known.seen.rate, known.seen.duration, tuple(plays))
    high = model.values["u_rated"] / (model.values["G"] or 1.0)
    time, voltage = standard_voltage(_PERIOD, high)
    inputs = {"voltage": voltage}
    if "temperature" in model.input_names:
        room = next(i.start for i in model.structure.inputs if i.name == "temperature")
        inputs["temperature"] = room + _WARMING * time / time[-1]
    u = input_samples(model, len(time), inputs)
    memory = effect.trial_starts[0] if effect.trial_starts else None
    x0 = start_on(model, time, u, memory).x
    fastest = float(np.max(np.abs(np.diff(voltage) / np.diff(time))))
    return Drive(0.0, high, fastest, np.inf, tuple(plays) or ((time, u, x0),))


def _state(model: Model, start: Mapping[str, float]) -> FloatArray:
    return np.array([start.get(s.name, s.start) for s in model.structure.states])


def _shown(model: Model, t: FloatArray, u: FloatArray, x0: FloatArray | None = None) -> FloatArray:
    """Return a model's output (n,), from rest without a start."""
    started = start_on(model, t, u).x if x0 is None else x0
    steps, _ = accurate(model, t, u, started, rtol=_RTOL, hold="linear")
    return steps.y[:, model.output_names.index(output_of(model) or "displacement")]


def _played(
    on: Model, off: Model, t: FloatArray, voltage: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return d (n,), and what the model shows without the effect (n,)."""
    u = input_samples(on, len(t), {"voltage": voltage})
    without = _shown(off, t, u)
    return _shown(on, t, u) - without, without


def _hold(on: Model, off: Model, drive: Drive) -> list[Figure]:
    after = np.unique([*np.geomspace(1e-3, _HELD[-1], _SAMPLES), *_HELD])
    step = np.linspace(0.0, _STEP, 41)
    t = np.concatenate([step, _STEP + after])
    way = np.minimum(t / _STEP, 1.0)
    voltage: FloatArray = drive.low + (drive.high - drive.low) * 0.5 * (1.0 - np.cos(np.pi * way))
    d, _ = _played(on, off, t, voltage)
    at = len(step) + np.searchsorted(after, _HELD)
    began = d[len(step) - 1]
    return [Figure("hold", float(d[k] - began), "", s, "s") for k, s in zip(at, _HELD, strict=True)]


def _slow_loops(on: Model, off: Model, drive: Drive) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return d on the last way up and down, and the output without the effect on the former.

    All (n,) over voltages that rise evenly.
    """
    way = np.linspace(0.0, 1.0, _SAMPLES + 1)
    share: FloatArray = np.concatenate([way, way[-2::-1], way[1:], way[-2::-1]])
    t: FloatArray = _SLOW / _SAMPLES * np.arange(len(share), dtype=np.float64)
    d, without = _played(on, off, t, drive.low + (drive.high - drive.low) * share)
    up = slice(2 * _SAMPLES, 3 * _SAMPLES + 1)
    return d[up], d[3 * _SAMPLES :][::-1], without[up]


def _reversal(on: Model, off: Model, drive: Drive) -> list[Figure]:
    up, down, _ = _slow_loops(on, off, drive)
    return [Figure("reversal", float(np.max(np.abs(down - up))), "", drive.high, "V")]


def _range(on: Model, off: Model, drive: Drive) -> list[Figure]:
    up, _, without = _slow_loops(on, off, drive)
    line = np.column_stack([np.ones_like(without), without])
    bent = up - line @ np.linalg.lstsq(line, up, rcond=None)[0]
    return [
        Figure("range", float(np.max(np.abs(bent))), "", drive.high, "V"),
        Figure("top", float(up[-1]), "", drive.high, "V"),
    ]


def _slew(on: Model, off: Model, drive: Drive) -> list[Figure]:
    way = (drive.high - drive.low) / drive.rate
    t: FloatArray = way * np.linspace(0.0, 2.1, 2 * _SAMPLES + 21)
    share: FloatArray = 1.0 - np.abs(np.clip(t / way - 0.05, 0.0, 2.0) - 1.0)
    d, _ = _played(on, off, t, drive.low + (drive.high - drive.low) * share)
    return [Figure("slew", float(np.max(np.abs(d))), "", drive.rate, "V/s")]


def _resonance(on: Model, off: Model, drive: Drive) -> list[Figure]:
    with_it, without = linear_part(on), linear_part(off)
    poles = np.linalg.eigvals(with_it.a)
    ringing = np.unique(np.abs(poles[np.abs(poles.imag) > 1e-6 * np.abs(poles)]))
    near = np.geomspace(0.9, 1.1, _SAMPLES + 1)  # the peak lies near the pole
    figures = []
    for natural in ringing.tolist():
        omega = natural * near
        ratio = np.abs(with_it.response(omega) / without.response(omega))
        best = int(np.argmax(np.abs(np.log(ratio))))
        if abs(float(np.log(ratio[best]))) > _TOLD:
            at = float(omega[best]) / (2.0 * np.pi)
            figures.append(Figure("resonance", float(ratio[best]), "1", at, "Hz"))
    return sorted(figures, key=lambda f: -abs(float(np.log(f.value))))[:_MOST]


def _record(on: Model, off: Model, drive: Drive) -> list[Figure]:
    rows = []
    for k, (t, u, x0) in enumerate(drive.plays):
        start = start_on(on, t, u).x if x0 is None else x0
        if k not in drive.without:
            drive.without[k] = _shown(off, t, u, start)
        d = _shown(on, t, u, start) - drive.without[k]
        rows.append((float(np.ptp(d)), float(np.std(d)), float(t[-1] - t[0])))
    if not rows:
        return []
    largest, rms, duration = max(rows)
    return [
        Figure("record", largest, "", duration, "s"), Figure("rms", rms, "", duration, "s"),
    ]  # fmt: skip


#: A test returns its figures: (model with the effect, model without it, drive) -> figures.
TESTS: dict[str, Callable[[Model, Model, Drive], list[Figure]]] = {
    "hold": _hold,
    "reversal": _reversal,
    "range": _range,
    "slew": _slew,
    "resonance": _resonance,
    "record": _record,
}
#: Figures that have a sign.
SIGNED = ("hold", "top")


@dataclass(frozen=True)
class Size:
    """What an effect changes in a test, in `unit`; signed where it moves on (hold, top).

    `interval` (95 %) is what the uncertainty of the effect's parameters leaves, None where that
    is not known. `at` is the point in the test: time after the step, rate, frequency, duration. The
    test plays between the `voltages`, for a user's model as its records do (None), and of that
    one `output` shows it. `beyond_records` means that the records do not reach there.
    """

    test: str
    value: float
    unit: str
    interval: tuple[float, float] | None
    at: float
    at_unit: str
    voltages: tuple[float, float] | None
    beyond_records: bool = False
    output: str = "displacement"


def sizes(
    effect: Component, model: Model, records: Sequence[Record] = (), *, unit: str = "m"
) -> tuple[Size, ...]:
    """Return how large an effect of a model is, none where the test cannot be simulated.

    `records` are those that the model was identified from; without them the one in its evidence is
    played. `unit` is that of their displacement.
    """
    drive = drive_of(model, effect, records)
    off = model.with_values({effect.gain or "": 0.0})
    test = TESTS[effect.what_now.test]
    try:
        figures = test(model, off, drive)
        interval = _intervals(effect, model, figures, lambda changed: test(changed, off, drive))
    except PsaError:
        return ()
    if not np.isfinite([f.value for f in figures]).all():
        return ()
    return tuple(
        Size(
            f.test, f.value, f.unit or unit, within, f.at, f.at_unit, (drive.low, drive.high),
            f.test == "hold" and f.at > drive.longest,
        )
        for f, within in zip(figures, interval, strict=True)
    )  # fmt: skip


def changes(
    effects: Sequence[Component], fit: Fit, arrays: Sequence[FloatArray]
) -> tuple[Size, ...]:
    """Return by how much effects of any model change each measured output within a record.

    It is the range of the difference of two runs from the same start: `arrays` (n, ny), the outputs
    of the fit, and those with the effects' gains at 0; nothing where these cannot be simulated.
    """
    columns = [fit.model.output_names.index(o.channel.outputs[0]) for o in fit.channels]
    without = fit.at({e.gain: 0.0 for e in effects if e.gain})
    try:
        pairs = zip(arrays, without.outputs(), strict=True)
        most = np.max([np.ptp(a - b, axis=0)[columns] for a, b in pairs], axis=0)
    except PsaError:
        return ()
    longest = max(e.record.duration for e in fit.experiments)
    return tuple(
        Size("record", float(size), o.channel.unit, None, longest, "s", None, output=o.column)
        for size, o in zip(most, fit.channels, strict=True)
    )


def example(effect: Component, stack: Model | None = None) -> tuple[Model, tuple[Size, ...]]:
    """Return a stack with an effect, by default the P-885.51, and how large the effect is there.

    A model that holds the effect keeps its values; else its gain has an ordinary size.
    """
    # delta, by which a voltage that leaks slowly makes a force that grows, belongs to no effect
    model = stack or stack_model(STACK).with_values({"delta": 0.0})
    if effect.name not in (c.name for c in model.components):
        model = model.with_effect(effect)
        gain = model.parameter(effect.gain or "")
        ordinary = gain.typical({**model.values, gain.name: 0.0})
        model = model.with_values({gain.name: min(ordinary, gain.bounds[1])})
    return model, sizes(effect, model)


def _intervals(
    effect: Component,
    model: Model,
    figures: Sequence[Figure],
    test: Callable[[Model], Sequence[Figure]],
) -> list[tuple[float, float] | None]:
    """Return the 95 % intervals of figures.

    (s_i - s)^2 add up over the columns i of a root of the covariance of the effect's parameters,
    1.96 of which change them, within their bounds.
    """
    known = None if model.evidence is None else model.evidence.covariance.of(effect.fitted)
    if known is None or not known.names or effect.trial_starts:  # its starts share the gain's size
        return [None] * len(figures)
    size, directions = np.linalg.eigh(np.array(known.matrix))
    moves = NORMAL_95 * directions * np.sqrt(np.maximum(size, 0.0))
    spread = np.zeros(len(figures))
    for move in moves.T:
        changed = {}
        for name, step in zip(known.names, move.tolist(), strict=True):
            bounds = model.parameter(name).bounds
            changed[name] = float(np.clip(model.values[name] + step, *bounds))
        other = test(model.with_values(changed))
        if len(other) != len(figures):
            return [None] * len(figures)
        spread += [(o.value - f.value) ** 2 for o, f in zip(other, figures, strict=True)]
    return [
        (f.value - half if f.test in SIGNED else max(f.value - half, 0.0), f.value + half)
        for f, half in zip(figures, np.sqrt(spread).tolist(), strict=True)
    ]
