"""Records that benchmarks and tests share: of the independent reference, and of the plants.

Those of the reference begin at rest at 0 V and use the voltage from 0 to u_rated: a step, loops, a
multisine. Times follow the stack: a step lasts twelve times the slowest time constant of drive,
creep lag and mechanics.
"""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

import psa_casadi as psa
from psa_casadi import reference
from psa_casadi.common.units import FloatArray
from psa_casadi.records import multisine, sine, time_grid
from tests.studies.plants.make import Truth, make_record, play_again

Values = Mapping[str, float]

STEP_SAMPLES, LOOP_SAMPLES, MULTISINE_SAMPLES = 2500, 1000, 2000
LOOP_AMPLITUDES, LOOP_FREQUENCIES, LOOP_PERIODS = (0.3, 0.6, 1.0), (0.2, 5.0), 2
#: Leaves errors of 1e-6 of the range, a thousandth of the noise that is added.
_RTOL = 1e-7


def slowest(values: Values) -> float:
    """Return the slowest time constant [s] of the linear part of the cascade, eqs. (12), (13)."""
    decays = [values["tau"], values["R_s"] * values["C_p"]]
    for part in "PB":
        m, c, k = (values[f"{q}_{part}"] for q in "mck")
        decays += [-1.0 / s.real for s in np.roots([m, c, k])]
    return float(max(decays))


def played(
    values: Values, name: str, time: FloatArray, voltage: FloatArray,
    smooth: Callable[[float], float] | None = None, rtol: float = _RTOL,
) -> psa.Record:  # fmt: skip
    """Return the reference's record from rest under a voltage (n,) [V] that is linear in between.

    Or under the `smooth` one of which these are the samples, which costs the reference a hundredth
    of the time. Straight lines between the samples of a loop lie within (pi / LOOP_SAMPLES)^2 / 4
    of it, 3e-6 of the range.
    """
    bends = np.flatnonzero(np.abs(np.diff(voltage, 2)) > 1e-12 * np.ptp(voltage)) + 1
    drive = smooth or reference.from_samples(time, voltage)
    kinks = [] if smooth else time[bends].tolist()
    result = reference.simulate(values, drive, time, breakpoints=kinks, rtol=rtol)
    return psa.Record(name=name, time=time, voltage=voltage, displacement=result.displacement)


def step_voltage(
    values: Values, share: float = 1.0, samples: int = STEP_SAMPLES
) -> tuple[FloatArray, FloatArray]:
    """Return time and voltage of a step from 0 to a share of u_rated at the second sample."""
    length = 12.0 * slowest(values)
    time = time_grid(length, length / samples)
    voltage = np.full(time.shape, share * values["u_rated"])
    voltage[0] = 0.0
    return time, voltage


def loop_voltage(
    values: Values, amplitude: float, frequency: float
) -> tuple[FloatArray, FloatArray]:
    """Return time and voltage of a sine from 0 to a share of u_rated, `LOOP_PERIODS` periods."""
    time = time_grid(LOOP_PERIODS / frequency, 1.0 / (LOOP_SAMPLES * frequency))
    return time, sine(time, 0.0, amplitude * values["u_rated"], frequency)


def multisine_voltage(values: Values, seed: int) -> tuple[FloatArray, FloatArray]:
    """Return time and voltage of a random-phase multisine that fades in over a tenth."""
    sample = 12.0 * slowest(values) / STEP_SAMPLES
    time = time_grid(MULTISINE_SAMPLES * sample, sample)
    top = values["u_rated"]
    swing = multisine(time, 0.0, top, (2.0 / time[-1], 1.0 / (6.0 * sample)), seed=seed)
    return time, swing * np.minimum(10.0 * time / time[-1], 1.0)


def clean_set(values: Values) -> list[psa.Record]:
    """Return a step, loops at three amplitudes and two frequencies, and a multisine, without noise.

    Results are kept, because the reference is slow and noise is all that seeds change.
    """
    return [*_fast_set(tuple(sorted(values.items()))), *clean_loops(values)]


def clean_loops(values: Values) -> list[psa.Record]:
    """Return the loops of `clean_set` alone, which take a small part of its time."""
    return list(_loop_set(tuple(sorted(values.items()))))


@lru_cache(maxsize=16)
def _fast_set(pairs: tuple[tuple[str, float], ...]) -> tuple[psa.Record, ...]:
    values = dict(pairs)
    fast = {"step": step_voltage(values), "multisine": multisine_voltage(values, seed=1)}
    return tuple(played(values, name, *inputs) for name, inputs in fast.items())


@lru_cache(maxsize=16)
def _loop_set(pairs: tuple[tuple[str, float], ...]) -> tuple[psa.Record, ...]:
    values, result = dict(pairs), []
    for share, f in product(LOOP_AMPLITUDES, LOOP_FREQUENCIES):
        half, omega = 0.5 * share * values["u_rated"], 2.0 * np.pi * f

        def smooth(t: float, half: float = half, omega: float = omega) -> float:
            return half * (1.0 - float(np.cos(omega * t)))

        name = f"loop {100 * share:.0f} % {f:g} Hz"
        result.append(played(values, name, *loop_voltage(values, share, f), smooth))
    return tuple(result)


def with_noise(
    records: Sequence[psa.Record], share: float, seed: int | Sequence[int]
) -> list[psa.Record]:
    """Return the records with white noise of `share` times the largest range of the set added."""
    level, draw = share * max(r.range_m for r in records), np.random.default_rng(seed)
    return [noisy(r, level, draw) for r in records]


def noisy(record: psa.Record, level: float, draw: np.random.Generator) -> psa.Record:
    """Return a record with white noise of rms `level` [m] added to its displacement."""
    more = level * draw.standard_normal(record.n)
    return replace(record, displacement=np.asarray(record.displacement) + more)


def hidden_record(effect: str | None, seed: int, **how: Any) -> tuple[Truth, psa.Record]:
    """Return a record of an independent plant that hides an effect, and the truth behind it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "record_0.csv"
        return make_record(effect, seed, path, **how), psa.read_record(path)


def played_again(
    truth: Truth, seed: int, voltage: tuple[FloatArray, FloatArray] | None = None
) -> psa.Record:
    """Return a further record of a device, under a drawn voltage or times and `voltage`."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"record_{seed}.csv"
        play_again(truth, seed, path, voltage)
        return psa.read_record(path)
