"""The same device once more: another voltage and fresh noise, or a voltage that was designed."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.studies.plants.base import Run, simulate_base
from tests.studies.plants.ceramic import heat
from tests.studies.plants.excitations import draw_excitation
from tests.studies.plants.hide import added_by, effect_called
from tests.studies.plants.make import Truth, write_csv
from tests.studies.plants.noise import disturb
from tests.studies.plants.stack import FloatArray

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
