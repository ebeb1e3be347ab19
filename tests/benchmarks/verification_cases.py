"""The records behind the paper's figures 6 to 10: what is fitted, and what is kept for judging.

Three stacks: the measured records are made by the independent reference, with white noise. One
instrument: a micromanipulator measured by Y. N. Aye, where its records are at hand.
"""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from psa_casadi import reference
from psa_casadi.errors import InputError
from psa_casadi.identification.fitting.fit import fit
from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.identification.identify import identify
from psa_casadi.model.compose import Model
from psa_casadi.model.stacks import STACKS
from psa_casadi.records import Record, read_record, time_grid
from psa_casadi.records.split import Experiment, split
from psa_casadi.simulation.simulate import simulate
from tests.benchmarks.outcome import Progress
from tests.benchmarks.records import response, slowest

FloatArray = npt.NDArray[np.float64]
Values = Mapping[str, float]
Signal = Callable[[float], float]

#: White noise of the synthetic records, as a share of the range of each.
NOISE = 1e-3
LOOPS, STEPS, OTHER = "loops", "steps", "non-periodic"
INSTRUMENT = "micromanipulator"
#: Loops as (share of u_rated, frequency [Hz]): fitted, and kept for judging.
FITTED_LOOPS, KEPT_LOOPS = ((1.0, 1.0), (0.3, 10.0)), ((0.6, 3.0), (0.85, 0.5))
KEPT_STEP = 0.6
_PERIODS, _LOOP_SAMPLES, _STEP_SAMPLES, _OTHER_SAMPLES = 2, 300, 1500, 3000
_RTOL = 1e-8


@dataclass(frozen=True, eq=False)
class Comparison:
    """Measured and predicted displacement (n,) [m] of samples that no fit has seen.

    `kind` is LOOPS, STEPS or OTHER; `range_m` [m] is what errors are compared with: the range of
    the displacement, for a step its final value. A step is told normalised, as in the paper.
    """

    kind: str
    stack: str
    record: str
    time: FloatArray
    voltage: FloatArray
    measured: FloatArray
    predicted: FloatArray
    range_m: float

    @property
    def error(self) -> FloatArray:
        """Measured minus predicted [m]; nan where a fit has used the sample."""
        return self.measured - self.predicted

    @property
    def largest(self) -> float:
        """Largest absolute error [m]."""
        return float(np.nanmax(np.abs(self.error)))

    @property
    def rms(self) -> float:
        """Root mean square of the error [m]."""
        return float(np.sqrt(np.nanmean(self.error**2)))


def synthetic(name: str, progress: Progress) -> list[Comparison]:
    """Identify a named stack from a step and two loops of the reference; predict other records."""
    p = {key: figure.value for key, figure in STACKS[name].values.items()}
    noise = np.random.default_rng(2015)
    progress(f"{name}: records of the reference")
    fitted = [_step(p, 1.0), *(_loop(p, *loop) for loop in FITTED_LOOPS)]
    kept = [(LOOPS, _loop(p, *loop)) for loop in KEPT_LOOPS]
    kept += [(STEPS, _step(p, KEPT_STEP)), (OTHER, _non_periodic(p))]
    noisy = [_with_noise(r, noise) for r in fitted]
    found = identify(noisy, progress=lambda text: progress(f"{name}: {text}"))
    return [_compare(kind, name, found.model, _with_noise(r, noise)) for kind, r in kept]


def instrument(progress: Progress) -> list[Comparison]:
    """Identify the micromanipulator from blocks of one record; predict the rest and another record.

    The records are looked for in $PSA_CASADI_DATA; without them the list is empty.
    """
    folder = Path(os.environ.get("PSA_CASADI_DATA", "")) / INSTRUMENT
    try:
        sine, minor = (read_record(folder / f"{n}.csv") for n in ("sine_1hz", "minor_loops"))
    except InputError:
        return []
    cut = split(sine)
    part = replace(sine, displacement=np.where(cut.used, measured(sine), np.nan))
    found = identify([part], progress=lambda text: progress(f"{INSTRUMENT}: {text}"))
    rest = np.where(cut.held_out, measured(sine), np.nan)
    (predicted,) = found.fit.predicted(found.experiments)
    kept = (sine.time, sine.voltage, rest, predicted, sine.range_m)
    return [
        Comparison(LOOPS, INSTRUMENT, "sine 1 Hz, blocks kept", *kept),
        _led_in(found.model, minor, found.fit.rms),
    ]


def _led_in(model: Model, record: Record, sigma: float) -> Comparison:
    """Predict a record of a device that has a past: its first tenth tells offset and memory."""
    lead = np.arange(record.n) < record.n // 10
    experiment = Experiment(record, record.mask & lead, record.mask & ~lead)
    (predicted,) = fit(model, [experiment], [], sigma=[sigma]).predicted([experiment])
    rest = np.where(experiment.held_out, measured(record), np.nan)
    kept = (record.time, record.voltage, rest, predicted, record.range_m)
    return Comparison(OTHER, INSTRUMENT, "minor loops, after a tenth", *kept)


def _compare(kind: str, stack: str, model: Model, record: Record) -> Comparison:
    predicted = simulate(model, record.time, record.voltage, from_rest_at_zero=True).displacement
    x = measured(record)
    size = float(np.mean(x[-record.n // 20 :])) if kind == STEPS else record.range_m
    return Comparison(kind, stack, record.name, record.time, record.voltage, x, predicted, size)


def _with_noise(record: Record, noise: np.random.Generator) -> Record:
    level = NOISE * record.range_m
    noisy = measured(record) + level * noise.standard_normal(record.n)
    return Record(name=record.name, time=record.time, voltage=record.voltage, displacement=noisy)


def _step(p: Values, share: float) -> Record:
    """Return a step from 0 to a share of u_rated at the second sample."""
    length = 12.0 * slowest(p)
    time = time_grid(length, length / _STEP_SAMPLES)
    voltage = np.full(time.shape, share * p["u_rated"])
    voltage[0] = 0.0
    return Record(
        name=f"step to {100 * share:.0f} %",
        time=time,
        voltage=voltage,
        displacement=response(p, time, voltage),
    )


def _loop(p: Values, share: float, frequency: float) -> Record:
    """Return a sine from 0 to a share of u_rated."""
    time = time_grid(_PERIODS / frequency, 1.0 / (_LOOP_SAMPLES * frequency))
    half = 0.5 * share * p["u_rated"]
    return _smooth(
        p,
        f"loop {100 * share:.0f} %, {frequency:g} Hz",
        time,
        lambda t: half * (1.0 - np.cos(2.0 * np.pi * frequency * t)),
    )


def _non_periodic(p: Values) -> Record:
    """Return three sines of incommensurate frequencies, decaying about half the rated voltage."""
    tones = ((0.5, 1.0), (0.3, np.sqrt(7.0)), (0.2, 2.0 * np.pi))

    def voltage(t: float) -> float:
        swing = sum(weight * np.sin(2.0 * np.pi * f * t) for weight, f in tones)
        fade_in = 1.0 - np.exp(-((t / 0.15) ** 2))
        return float(0.5 * p["u_rated"] * fade_in * (1.0 + np.exp(-t / 2.0) * swing))

    time = time_grid(4.0, 4.0 / _OTHER_SAMPLES)
    return _smooth(p, "decaying, 1, 2.65 and 6.28 Hz", time, voltage)


def _smooth(p: Values, name: str, time: FloatArray, voltage: Signal) -> Record:
    """Return the reference's response from rest to a voltage without kinks."""
    samples = np.array([voltage(float(t)) for t in time])
    return Record(
        name=name,
        time=time,
        voltage=samples,
        displacement=reference.simulate(p, voltage, time, rtol=_RTOL).displacement,
    )
