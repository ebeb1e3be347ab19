"""Synthetic records with one hidden effect, none, or several, and the truth behind them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tests.studies.plants.base import Run, simulate_base
from tests.studies.plants.ceramic import heat
from tests.studies.plants.excitations import EXCITATIONS, ExcitationKind, draw_excitation
from tests.studies.plants.hide import (
    Hidden,
    Visible,
    added_by,
    base_directions,
    effect_called,
    hide,
)
from tests.studies.plants.noise import NOISES, Noise, NoiseKind, disturb, draw_noise
from tests.studies.plants.stack import FloatArray, Stack, draw_stack

HEADER = "time [s],voltage [V],displacement [um]"
THERMOMETER = ",temperature [degC]"


@dataclass(frozen=True)
class Truth:
    """What is behind a record.

    effect: the hidden effect or None. gain, parameters: those of the effect, SI. stack: the base.
    sigma, quantum: rms of the noise and count of the sensor [m]. visible: rms of what the base
    cannot absorb over sigma. gain_limited: the gain wanted was beyond the effect's plausible range
    and was clipped. times, voltage, displacement, base_displacement: (N,) clean [s, V, m], the last
    without any effect. noise: kind and figures of the noise. excitation: class of the voltage.
    temperature: (N,) [degC] where the record has a thermometer. more: further hidden effects, added
    to the first.
    """

    effect: str | None
    gain: float
    parameters: Mapping[str, float]
    stack: Stack
    sigma: float
    quantum: float
    visible: float
    gain_limited: bool
    times: FloatArray
    voltage: FloatArray
    displacement: FloatArray
    base_displacement: FloatArray
    noise: Noise
    excitation: ExcitationKind
    temperature: FloatArray | None
    more: tuple[Hidden, ...]

    @property
    def hidden(self) -> tuple[tuple[str, Mapping[str, float], float], ...]:
        """Name, parameters and gain of every hidden effect."""
        first = () if self.effect is None else ((self.effect, self.parameters, self.gain),)
        return (*first, *((h.effect.name, h.parameters, h.gain) for h in self.more))


def make_record(
    effect: str | None,
    seed: int,
    path: Path,
    *,
    noise: NoiseKind = "white",
    excitation: ExcitationKind = "rich",
    visible: Visible | None = None,
    gain: float | None = None,
    more: tuple[str, ...] = (),
    more_visible: Visible | None = None,
) -> Truth:
    """Write a synthetic record as CSV and return the truth; the same seed gives the same bytes.

    effect: a name of `HIDDEN_EFFECTS` or None. `visible` (a ratio or a range) replaces the drawn
    visible ratio (1.5 to 4), and a `gain` both: it needs no search, and 0 removes the effect. The
    same seed gives the same stack, voltage and noise with every effect, and the same stack with
    every excitation. more: further effects, each as visible in the base as `more_visible` demands;
    they act on each other (`added_by`).
    """
    for value, known in ((noise, NOISES), (excitation, EXCITATIONS)):
        if value not in known:
            raise KeyError(f"There is no {value!r}; there are {', '.join(known)}.")
    further = [effect_called(name) for name in more]
    chosen = None if effect is None else effect_called(effect)
    seeds = np.random.SeedSequence(seed).spawn(3 + len(further))
    base_rng, effect_rng, noise_rng, *more_rng = (np.random.default_rng(s) for s in seeds)
    stack = draw_stack(base_rng)
    run = simulate_base(stack, *draw_excitation(base_rng, excitation, stack.u_rated))
    kind = draw_noise(noise_rng, noise, float(np.ptp(run.displacement)))
    bare = chosen is None and not further
    directions = np.empty((run.times.size, 0)) if bare else base_directions(run)
    first = [
        hide(one, run, effect_rng, directions, kind.rms, visible, gain)
        for one in (chosen,)
        if one is not None
    ]
    others = tuple(
        hide(one, run, rng, directions, kind.rms, more_visible)
        for one, rng in zip(further, more_rng, strict=True)
    )
    every = [(h.effect, h.parameters, h.gain) for h in (*first, *others)]
    clean = run.displacement + added_by(run, every)
    read = disturb(noise_rng, kind, clean)
    temperature = None
    for one, parameters, _ in every:
        if one.room is not None:
            temperature = one.room(run.times, parameters)
    write_csv(path, run.times, run.command, read, temperature)
    gain_and_parameters = (first[0].gain, first[0].parameters) if first else (0.0, {})
    visibility = (first[0].visible, first[0].gain_limited) if first else (0.0, False)
    return Truth(
        effect,
        *gain_and_parameters,
        stack,
        kind.rms,
        kind.quantum,
        *visibility,
        run.times,
        run.command,
        clean,
        run.displacement,
        kind,
        excitation,
        temperature,
        others,
    )


def write_csv(
    path: Path,
    times: FloatArray,
    voltage: FloatArray,
    displacement: FloatArray,
    temperature: FloatArray | None = None,
) -> None:
    """Write a record: times to 1 us, voltage to 1 mV, displacement [m] in um to 1 pm (an empty cell
    where it is nan), temperature [degC] to 1 mK.
    """
    rows = [
        f"{t:.6f},{v:.3f}," + ("" if math.isnan(x) else f"{x * 1e6:.6f}")
        for t, v, x in zip(times.tolist(), voltage.tolist(), displacement.tolist(), strict=True)
    ]
    header = HEADER
    if temperature is not None:
        header += THERMOMETER
        rows = [f"{row},{t:.3f}" for row, t in zip(rows, temperature.tolist(), strict=True)]
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")


def make_demo(path: Path) -> Truth:
    """The demonstration's record: a stack that creeps."""
    return make_record("slow_creep", 2015, path)


_IN_LENGTHS = ("exponential", "q", "s_1")


def in_terms_of(truth: Truth, times: FloatArray, command: FloatArray) -> Truth:
    """Return the truth whose effect on times (N,) [s] and commands (N,) [V] is the same device's.

    Further effects stay as they are. Three effects are drawn relative to the record that they are
    hidden in: the drift to its length T, the heating to its mean loss P, the clipping to its
    highest voltage V. On a record with T', P', V' the same device has

        drift       g' = g T'/T,  c' = c T/T',  q' = q T/T',  s_1' = s_1 T/T',  e' = e
        heating     g' = g P'/P
        clipping    (1 - g') V' = (1 - g) V,  no less than 0
    """
    if truth.effect == "offset_drift":
        ratio = _length(times) / _length(truth.times)
        parameters = {n: v / ratio if n in _IN_LENGTHS else v for n, v in truth.parameters.items()}
        return replace(truth, gain=truth.gain * ratio, parameters=parameters)
    if truth.effect == "self_heating":
        losses = [
            _mean_loss(simulate_base(truth.stack, t, v), truth.parameters)
            for t, v in ((truth.times, truth.voltage), (times, command))
        ]
        return replace(truth, gain=truth.gain * losses[1] / losses[0])
    if truth.effect == "voltage_saturation":
        ends = (1.0 - truth.gain) * float(truth.voltage.max())
        return replace(truth, gain=max(0.0, 1.0 - ends / float(command.max())))
    return truth


def _length(times: FloatArray) -> float:
    return float(times[-1] - times[0])


def _mean_loss(run: Run, parameters: Mapping[str, float]) -> float:
    """Return what the plant's temperature is divided by [V^q/s]."""
    energy: FloatArray = heat(run.path.path_voltage, parameters["q"])[run.path.node]
    return float(energy[-1]) / float(np.ptp(run.times))


def play_again(
    truth: Truth,
    seed: int,
    path: Path,
    played: tuple[FloatArray, FloatArray] | None = None,
) -> FloatArray:
    """Write a further record of a device and return its displacement without noise, (N,) [m].

    `truth` is the device: its stack, its effects with their gains (`in_terms_of` the new record),
    the kind of its noise. `played`
    are uniform times (N,) [s] and commands (N,) [V], beginning at 0 V; else a voltage of the class
    of the first record is drawn. The seed decides what is drawn, and the noise.
    """
    rng = np.random.default_rng([seed, 2])
    times, command = played or draw_excitation(rng, truth.excitation, truth.stack.u_rated)
    truth = in_terms_of(truth, times, command)
    run = simulate_base(truth.stack, times, command)
    effects = [(effect_called(name), p, gain) for name, p, gain in truth.hidden]
    clean, temperature = run.displacement + added_by(run, effects), None
    for effect, parameters, _ in effects:
        if effect.room is not None:
            temperature = effect.room(times, parameters)
    read = disturb(rng, truth.noise, clean)
    write_csv(path, times, command, read, temperature)
    return clean
