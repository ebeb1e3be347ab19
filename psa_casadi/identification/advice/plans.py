"""Records that could be measured next, sized by the model and by the records at hand."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import ceil, floor, log10

import numpy as np

from psa_casadi.model.compose import Model
from psa_casadi.records.drive import reversals
from psa_casadi.records.excitation import decaying_triangle, multisine, sine, time_grid
from psa_casadi.records.record import Record
from psa_casadi.simulation.start import settling_time
from psa_casadi.variables import Values

#: Samples of a planned step, multisine, loop (per period) and hold.
STEP_SAMPLES, MULTISINE_SAMPLES, LOOP_SAMPLES, HOLD_SAMPLES = 2000, 3000, 400, 2000
#: Highest tone of a multisine over the sampling rate.
_BAND = 0.2
#: Sampling intervals that are tried, at most.
_RUNGS = 6
#: Samples within the shortest lag at the fastest rate worth trying.
_FINEST = 5.0
#: A loop this much slower than the stack's settling is quasi-static.
_QUASI_STATIC = 0.05
_CYCLES = 6
_PARTS = ("_P", "_B", "")
#: Longest loops worth advising have this frequency [Hz].
_SLOWEST = 1e-3
_LONGEST_HOLD = 7200.0


@dataclass(frozen=True, eq=False)
class Plan:
    """A planned record (no displacement), the words for it, and the sampling rate [Hz] it needs."""

    kind: str
    words: str
    record: Record
    rate: float

    @property
    def duration(self) -> float:
        """Length [s]."""
        return self.record.duration


def plans(models: Sequence[Model], records: Sequence[Record]) -> list[Plan]:
    """Return steps and multisines at several sampling rates, loops, and holds where effects ask.

    All use the voltages of the records and begin at rest at the lowest; rates and frequencies suit
    every one of the models.
    """
    settling = max(settling_time(m) for m in models)
    shortest = min(_shortest(m.values) for m in models)
    low = min(float(np.min(r.voltage)) for r in records)
    high = max(float(np.max(r.voltage)) for r in records)
    found = [p for rate in _rates(settling, shortest, records) for p in _fast(rate, low, high)]
    found += _loops(_loop_frequency(settling, records), settling, low, high)
    if models[0].effects:
        longest = max(r.duration for r in records)
        lengths = [longest * k for k in (10.0, 100.0) if longest * k <= _LONGEST_HOLD]
        found += [_hold(length, low, high) for length in lengths]
    return found


def quantity(value: float, unit: str) -> str:
    """Return a value with three digits at most and a prefix, such as "200 kHz"."""
    if value == 0.0:
        return f"0 {unit}"
    prefixes = {-9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M"}
    power = int(np.clip(3 * floor(log10(abs(value) * 1.0005) / 3), -9, 6))
    if unit == "s" and value >= 1.0:
        power = 0
    return f"{value / 10.0**power:.3g} {prefixes[power]}{unit}"


def _round(value: float) -> float:
    """Return the next number of the series 1, 2, 5 upwards."""
    power = 10.0 ** floor(log10(value))
    return next(k * power for k in (1.0, 2.0, 5.0, 10.0) if k * power >= 0.999 * value)


def _rates(settling: float, shortest: float, records: Sequence[Record]) -> list[float]:
    """Return round sampling rates [Hz] between the records' and what the stack can show."""
    now = 1.0 / min(r.sample_time for r in records)
    finest = _round(_FINEST / shortest)
    lowest = _round(min(now, 20.0 / settling, finest))
    decades = log10(finest / lowest)
    count = min(_RUNGS, ceil(2.0 * decades) + 1)
    rates = np.geomspace(lowest, finest, count)
    return sorted({_round(float(r)) for r in rates})


def _shortest(values: Values) -> float:
    """Return the shortest lag [s]."""
    lags = [values[f"c{part}"] / values[f"k{part}"] for part in _PARTS if f"c{part}" in values]
    return min(values["tau"], values["R_s"] * values["C_p"], *lags)


def _loop_frequency(settling: float, records: Sequence[Record]) -> float:
    """Return a round frequency [Hz] at which records cycle slowly, else a quasi-static one."""
    limit = _QUASI_STATIC / settling
    turns = [(len(reversals(r.voltage)), r.duration) for r in records]
    cycling = [count / (2.0 * length) for count, length in turns if count >= 2]
    slow = [f for f in cycling if f <= limit]
    return _round(float(np.median(slow)) if slow else 0.1 * limit)


def _fast(rate: float, low: float, high: float) -> Iterator[Plan]:
    between = f"{quantity(low, 'V')} to {quantity(high, 'V')}"

    def sampled(length: float) -> str:
        return f"(sampled at {quantity(rate, 'Hz')} or faster for {quantity(length, 's')})"

    time = time_grid(STEP_SAMPLES / rate, 1.0 / rate)
    voltage = np.full(time.shape, low)
    voltage[STEP_SAMPLES // 100 : STEP_SAMPLES // 2] = high
    words = f"a step from {between} and back {sampled(STEP_SAMPLES / rate)}"
    yield Plan("step", words, Record(name="step", time=time, voltage=voltage), rate)
    length = MULTISINE_SAMPLES / rate
    time = time_grid(length, 1.0 / rate)
    tones = multisine(time, low, high, (2.0 / length, _BAND * rate), seed=1)
    voltage = low + (tones - low) * np.minimum(10.0 * time / length, 1.0)
    band = quantity(_BAND * rate, "Hz")
    words = f"a multisine from {between} up to {band} {sampled(length)}"
    yield Plan("multisine", words, Record(name="multisine", time=time, voltage=voltage), rate)


def _loops(frequency: float, settling: float, low: float, high: float) -> Iterator[Plan]:
    middle = 0.5 * (low + high)
    cases = [(k * frequency, high) for k in (0.01, 0.1, 1.0) if k * frequency > _SLOWEST]
    cases.append((frequency, middle))
    if 10.0 * frequency * settling <= _QUASI_STATIC:
        cases.append((10.0 * frequency, high))
    for f, top in cases:
        time = time_grid(2.0 / f, 1.0 / (LOOP_SAMPLES * f))
        words = (
            f"two loops (a sine) from {quantity(low, 'V')} to {quantity(top, 'V')} at"
            f" {quantity(f, 'Hz')}"
        )
        yield Plan(
            "loop",
            words,
            Record(name="loop", time=time, voltage=sine(time, low, top, f)),
            LOOP_SAMPLES * f,
        )
    time = time_grid(_CYCLES / frequency, 1.0 / (LOOP_SAMPLES * frequency))
    voltage = decaying_triangle(time, low, high, _CYCLES)
    words = (
        f"nested minor loops (a triangle of {_CYCLES} cycles from {quantity(low, 'V')} to"
        f" {quantity(high, 'V')} that closes in on the middle) at {quantity(frequency, 'Hz')}"
    )
    yield Plan(
        "minor loops",
        words,
        Record(name="loops", time=time, voltage=voltage),
        LOOP_SAMPLES * frequency,
    )


def _hold(length: float, low: float, high: float) -> Plan:
    time = time_grid(length, length / HOLD_SAMPLES)
    voltage = np.full(time.shape, high)
    voltage[: HOLD_SAMPLES // 100] = low
    words = (
        f"a step from {quantity(low, 'V')} to {quantity(high, 'V')} held for"
        f" {quantity(length, 's')}"
    )
    return Plan(
        "hold", words, Record(name="hold", time=time, voltage=voltage), HOLD_SAMPLES / length
    )
