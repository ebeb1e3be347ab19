"""The same device once more: another voltage and fresh noise, or a voltage that was designed."""

from pathlib import Path

import numpy as np

from tests.studies.plants.base import simulate_base
from tests.studies.plants.excitations import draw_excitation
from tests.studies.plants.hide import effect_called
from tests.studies.plants.make import Truth, write_csv
from tests.studies.plants.noise import disturb
from tests.studies.plants.same_device import in_terms_of
from tests.studies.plants.several import added_by
from tests.studies.plants.stack import FloatArray


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
    read, _ = disturb(rng, truth.noise, clean)
    write_csv(path, times, command, read, temperature)
    return clean
