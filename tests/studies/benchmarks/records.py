"""Synthetic records from the independent reference: step, loops, multisine, with white noise.

All begin at rest at 0 V and use the voltage from 0 to u_rated. Times follow the stack: a step lasts
twelve times the slowest time constant of drive, creep lag and mechanics.
"""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from psa_casadi import reference
from psa_casadi.records import Record, multisine, read_record, sine, time_grid
from tests.studies.plants.again import play_again
from tests.studies.plants.make import Truth, make_record

FloatArray = npt.NDArray[np.float64]
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


def response(values: Values, time: FloatArray, voltage: FloatArray) -> FloatArray:
    """Return the reference's displacement (n,) [m], voltage linear between samples, from rest."""
    bends = np.flatnonzero(np.abs(np.diff(voltage, 2)) > 1e-12 * np.ptp(voltage)) + 1
    drive = reference.from_samples(time, voltage)
    found = reference.simulate(values, drive, time, breakpoints=time[bends].tolist(), rtol=_RTOL)
    return found.displacement


def loop_response(
    values: Values, amplitude: float, frequency: float, time: FloatArray
) -> FloatArray:
    """Return the reference's displacement (n,) [m] under the smooth sine of `loop_voltage`.

    Straight lines between its samples lie within (pi / LOOP_SAMPLES)^2 / 4 of it, 3e-6 of the
    range, and a smooth voltage costs the reference a hundredth of the time.
    """
    half, omega = 0.5 * amplitude * values["u_rated"], 2.0 * np.pi * frequency
    found = reference.simulate(
        values, lambda t: half * (1.0 - float(np.cos(omega * t))), time, rtol=_RTOL
    )
    return found.displacement


def step_voltage(values: Values, duration: float | None = None) -> tuple[FloatArray, FloatArray]:
    """Return time and voltage of a step from 0 to u_rated at the second sample."""
    length = duration or 12.0 * slowest(values)
    time = time_grid(length, length / STEP_SAMPLES)
    voltage = np.full(time.shape, values["u_rated"])
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


def clean_set(values: Values) -> list[Record]:
    """Return a step, loops at three amplitudes and two frequencies, and a multisine, without noise.

    Results are kept, because the reference is slow and noise is all that seeds change.
    """
    return [*_fast_set(tuple(sorted(values.items()))), *clean_loops(values)]


def clean_loops(values: Values) -> list[Record]:
    """Return the loops of `clean_set` alone, which take a small part of its time."""
    return list(_loop_set(tuple(sorted(values.items()))))


@lru_cache(maxsize=16)
def _fast_set(items: tuple[tuple[str, float], ...]) -> tuple[Record, ...]:
    values = dict(items)
    fast = {"step": step_voltage(values), "multisine": multisine_voltage(values, seed=1)}
    return tuple(
        Record(name=n, time=t, voltage=v, displacement=response(values, t, v))
        for n, (t, v) in fast.items()
    )


@lru_cache(maxsize=16)
def _loop_set(items: tuple[tuple[str, float], ...]) -> tuple[Record, ...]:
    values, found = dict(items), []
    for amplitude, frequency in product(LOOP_AMPLITUDES, LOOP_FREQUENCIES):
        name = f"loop {100 * amplitude:.0f} % {frequency:g} Hz"
        t, v = loop_voltage(values, amplitude, frequency)
        x = loop_response(values, amplitude, frequency, t)
        found.append(Record(name=name, time=t, voltage=v, displacement=x))
    return tuple(found)


def with_noise(records: Sequence[Record], share: float, seed: int | Sequence[int]) -> list[Record]:
    """Return the records with white noise of `share` times the largest range of the set added."""
    level = share * max(r.range_m for r in records)
    draw = np.random.default_rng(seed)
    return [
        replace(r, displacement=r.displacement + level * draw.standard_normal(r.n))
        for r in records
        if r.displacement is not None
    ]


def hidden_record(effect: str | None, seed: int, **how: Any) -> tuple[Truth, Record]:
    """Return a record of an independent plant that hides an effect, and the truth behind it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "record_0.csv"
        return make_record(effect, seed, path, **how), read_record(path)


def played_again(
    truth: Truth, seed: int, given: tuple[FloatArray, FloatArray] | None = None
) -> Record:
    """Return a further record of a device, under a drawn voltage or a given one."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"record_{seed}.csv"
        play_again(truth, seed, path, given)
        return read_record(path)
