"""What a designed input may be, and families of waveforms to choose from.

Families of waveforms to choose from: free-form, triangles, steps, multisines.

Each waveform is a function of a vector p within bounds; the optimiser changes p. All begin with a
rest, a stack's at the lowest voltage, and are linear between samples. Where a model has several
inputs, each has a waveform of the same family, and p holds the vectors of all.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from psa_casadi.common.errors import InputError, Problems
from psa_casadi.common.units import FloatArray
from psa_casadi.records.excitation import time_grid
from psa_casadi.records.record import Record

#: Bandwidth over the sampling rate by default: twenty samples for a whole cycle.
BAND = 0.05
#: A designed record rests at its first voltage for this share of its samples, or this many.
REST_SHARE, REST_SAMPLES = 0.01, 4
_FEWEST = 50


@dataclass(frozen=True)
class Limits:
    """Limits of one input of a designed record, a stack's voltage [V] or any other in its unit.

    Values between `low` and `high`; `samples` samples over `duration` [s]; changes of at most
    `rate` [1/s], and at most what a `current` [A] into a stack's capacitance allows,
    C_p |dv/dt| <= current; no full cycle shorter than 1/`bandwidth` [1/Hz], so that tones stay
    below it and the input turns no sooner than after half of that. `bandwidth` None means a
    twentieth of the sampling rate. The record starts at `rest`, None means `low`. Raises
    InputError with all that is wrong.
    """

    low: float
    high: float
    duration: float
    samples: int
    rate: float = float("inf")
    current: float = float("inf")
    bandwidth: float | None = None
    rest: float | None = None

    def __post_init__(self) -> None:
        problems = Problems()
        if not self.low < self.high:
            problems.add(
                f"The range {self.low:g} to {self.high:g} is empty; give the lowest value below the"
                " highest."
            )
        if not 0.0 < self.duration < float("inf"):
            problems.add(f"The duration is {self.duration:g} s; give a positive number of seconds.")
        if self.samples < _FEWEST:
            problems.add(
                f"{self.samples} samples hold no experiment; give {_FEWEST} or more, a thousand are"
                " usual."
            )
        largest = {"rate [1/s]": self.rate, "current [A]": self.current}
        for name, value in {**largest, "bandwidth [Hz]": self.bandwidth}.items():
            if value is not None and not value > 0.0:
                problems.add(f"The largest {name} is {value:g}; give a positive one, or none.")
        problems.raise_if_any()
        if self.band * self.duration < 1.0:
            problems.add(
                f"A bandwidth of {self.band:g} Hz allows no whole cycle in {self.duration:g} s;"
                " lengthen the record or widen the band."
            )
        elif self.band > 0.5 * self.samples / self.duration:
            problems.add(
                f"A bandwidth of {self.band:g} Hz cannot be resolved by {self.samples} samples in"
                f" {self.duration:g} s; sample at {2.0 * self.band:g} Hz or faster, or narrow it."
            )
        problems.raise_if_any()

    @property
    def band(self) -> float:
        """Bandwidth [Hz], by default a twentieth of the sampling rate."""
        return self.bandwidth or BAND * self.samples / self.duration

    @property
    def span(self) -> float:
        """Width of the range."""
        return self.high - self.low

    @property
    def rest_share(self) -> float:
        """Where the record starts within the range: 0 at `low`, 1 at `high`."""
        rest = self.low if self.rest is None else self.rest
        return float(np.clip((rest - self.low) / self.span, 0.0, 1.0))

    @property
    def shortest(self) -> float:
        """Shortest time between two turns [s]: half a cycle."""
        return 0.5 / self.band

    def steepest(self, capacitance: float | None) -> float:
        """Return the largest rate [V/s] that rate and current allow; C_p [F] or None."""
        by_current = self.current / capacitance if capacitance else float("inf")
        return min(self.rate, by_current)

    def grid(self, samples: int | None = None) -> FloatArray:
        """Return the instants [s] of the record, (samples,), or of a coarser one."""
        return time_grid(self.duration, self.duration / (samples or self.samples))


def limits_of(records: Sequence[Record], **changes: float | None) -> Limits:
    """Return limits like those that records kept: their voltages, the longest one's length.

    `changes` replace fields that are not None.
    """
    longest = max(records, key=lambda r: r.duration)
    table: dict[str, Any] = {
        "low": min(float(np.min(r.voltage)) for r in records),
        "high": max(float(np.max(r.voltage)) for r in records),
        "duration": longest.duration * longest.n / (longest.n - 1),
        "samples": longest.n,
    }
    table |= {name: value for name, value in changes.items() if value is not None}
    return Limits(**table | {"samples": int(table["samples"])})


Kind = Literal["free", "triangles", "steps", "multisine"]
KINDS: tuple[Kind, ...] = get_args(Kind)

#: Corners of free-form voltages, turns of triangles, levels of steps, lines of multisines, at most.
CORNERS, TURNS, LEVELS, LINES = 24, 14, 12, 14
#: Longest over shortest drawn part of a waveform, in natural logarithms.
_SPREAD = 3.0
_FASTEST_RAMP = 1e-9


@dataclass(frozen=True, eq=False)
class Waveform:
    """One input of a family and how it may change.

    `start` (k,) lies between `lower` and `upper`; `values(p, time)` (n,) are those at instants [s];
    `slack(p)` is not negative, up to rounding, where rates and times between turns are allowed.
    """

    start: FloatArray
    lower: FloatArray
    upper: FloatArray
    values: Callable[[FloatArray, FloatArray], FloatArray]
    slack: Callable[[FloatArray], FloatArray] = lambda _: np.zeros(0)


@dataclass(frozen=True, eq=False)
class Drive:
    """Waveforms of all inputs, of one family: the coordinates of one after those of another."""

    kind: Kind
    waves: Mapping[str, Waveform]

    @property
    def start(self) -> FloatArray:
        """Start of the search (k,)."""
        return np.concatenate([w.start for w in self.waves.values()])

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest coordinates (k,)."""
        waves = self.waves.values()
        return np.concatenate([w.lower for w in waves]), np.concatenate([w.upper for w in waves])

    def columns(self, p: FloatArray, time: FloatArray) -> dict[str, FloatArray]:
        """Return the inputs (n,) at instants [s] by name."""
        return {n: w.values(item, time) for (n, w), item in self._parts(p)}

    def slack(self, p: FloatArray) -> FloatArray:
        """Return the slack of all waveforms."""
        return np.concatenate([w.slack(item) for (_, w), item in self._parts(p)])

    def _parts(self, p: FloatArray) -> Iterator[tuple[tuple[str, Waveform], FloatArray]]:
        ends = np.cumsum([len(w.start) for w in self.waves.values()])
        return zip(self.waves.items(), np.split(p, ends[:-1]), strict=True)


def draw(kind: Kind, limits: Limits, steepest: float, rng: np.random.Generator) -> Waveform:
    """Draw a waveform of a family at random within the limits; `steepest` [V/s] bounds its rate.

    Raises InputError for an unknown family, and where the rate allows almost no swing.
    """
    if kind not in KINDS:
        raise InputError(f"There is no family '{kind}'; there are {', '.join(KINDS)}.")
    if steepest * limits.duration < 0.05 * limits.span:
        raise InputError(
            f"At most {steepest:g} a second for {limits.duration:g} s moves the input by less than"
            f" 5 % of its range of {limits.span:g}; lengthen the record, or allow more rate or"
            " current."
        )
    if kind == "multisine":
        return _multisine(limits, steepest, rng)
    return _timed(kind, limits, steepest, rng)


def rest_of(limits: Limits) -> float:
    """Return the length of the rest before a waveform [s]."""
    return limits.duration * max(REST_SHARE, REST_SAMPLES / limits.samples)


def _count(limits: Limits, most: int) -> int:
    """Return how many parts fit between turns, at most `most` and at least two."""
    room = (limits.duration - rest_of(limits)) / limits.shortest
    return int(np.clip(room / 2.0, 2, most))


def _durations(shares: FloatArray, limits: Limits) -> FloatArray:
    """Return durations [s] that fill the record, each at least the shortest; ln shares (k,)."""
    room = limits.duration - rest_of(limits)
    least = min(limits.shortest, 0.9 * room / len(shares))
    weights = np.exp(shares - np.max(shares))
    return np.asarray(least + (room - least * len(shares)) * weights / np.sum(weights))


def _reachable(
    levels: FloatArray, durations: FloatArray, per_second: float, now: float
) -> FloatArray:
    """Return levels whose changes the rate allows, from `now`, each moved as little as needed."""
    values = np.empty_like(levels)
    for k, (level, duration) in enumerate(zip(levels, durations, strict=True)):
        most = 0.999 * per_second * duration
        now += float(np.clip(level - now, -most, most))
        values[k] = now
    return values


def _timed(kind: Kind, limits: Limits, steepest: float, rng: np.random.Generator) -> Waveform:
    """Levels and their durations: ramps lead from one to the next, steps jump and hold.

    Free-form voltages have ramps between fixed corners, whose distances are drawn over a decade or
    more; of triangles and steps the durations change too.
    """
    count = _count(limits, {"free": CORNERS, "triangles": TURNS, "steps": LEVELS}[kind])
    per_second, first, rest = steepest / limits.span, rest_of(limits), limits.rest_share
    limited = bool(np.isfinite(per_second))
    ramp = max(limits.duration / limits.samples, 1.0 / per_second if limited else 0.0)
    shares = rng.uniform(0.0, _SPREAD, count)
    drawn = _durations(shares, limits)

    def durations_of(p: FloatArray) -> FloatArray:
        return drawn if kind == "free" else _durations(p[count:], limits)

    def moving(durations: FloatArray) -> FloatArray:
        return np.minimum(durations, ramp) if kind == "steps" else durations

    def values(p: FloatArray, time: FloatArray) -> FloatArray:
        levels, durations = p[:count], durations_of(p)
        ends = first + np.cumsum(durations)
        if kind == "steps":
            starts = ends - durations
            tops = starts + moving(durations)
            nodes = np.concatenate([[0.0], np.column_stack([starts, tops]).ravel(), ends[-1:]])
            before = np.concatenate([[rest], levels[:-1]])
            heights = np.column_stack([before, levels]).ravel()
            heights = np.concatenate([[rest], heights, levels[-1:]])
        else:
            nodes = np.concatenate([[0.0, first], ends])
            heights = np.concatenate([[rest, rest], levels])
        return np.asarray(limits.low + limits.span * np.interp(time, nodes, heights))

    def slack(p: FloatArray) -> FloatArray:
        change = np.diff(p[:count], prepend=rest)
        room = per_second * moving(durations_of(p))
        return np.concatenate([room - change, room + change])

    levels = rng.uniform(0.0, 1.0, count)
    if kind == "triangles":
        levels = np.where(np.arange(count) % 2 == 0, 0.5 + 0.5 * levels, 0.5 * levels)
        if rng.integers(2):  # loops in the lower half of the range, then in the upper one
            levels = 0.5 * levels + np.where(2 * np.arange(count) < count, 0.0, 0.5)
    if limited or kind == "free":
        levels = _reachable(levels, moving(drawn), per_second, rest)
    start, low, high = levels, np.zeros(count), np.ones(count)
    if kind != "free":
        start, low = np.append(levels, shares), np.append(low, np.full(count, -_SPREAD))
        high = np.append(high, np.full(count, 2.0 * _SPREAD))
    wave = Waveform(start, low, high, values)
    return replace(wave, slack=slack) if limited else wave


def _multisine(limits: Limits, steepest: float, rng: np.random.Generator) -> Waveform:
    """Cosines and sines at lines of 1/T, closer together at low frequencies.

    The sum is scaled to the range, shrunk towards the rest where its rate would be too large, and
    grows from rest over the first tenth.
    """
    period = limits.duration - rest_of(limits)
    highest = max(1, int(limits.band * period))
    lines = np.unique(np.round(np.geomspace(1.0, highest, LINES)))
    first, grow = rest_of(limits), 0.1 * period
    fine, rest = limits.grid(), limits.rest_share

    def raw(p: FloatArray, time: FloatArray) -> FloatArray:
        angle = 2.0 * np.pi * np.outer(np.maximum(time - first, 0.0) / period, lines)
        return np.asarray(np.cos(angle) @ p[: len(lines)] + np.sin(angle) @ p[len(lines) :])

    def values(p: FloatArray, time: FloatArray) -> FloatArray:
        whole = raw(p, fine)
        low, size = np.min(whole), max(np.max(whole) - np.min(whole), 1e-12)

        def risen(wave: FloatArray, at: FloatArray) -> FloatArray:
            """Return a wave within 0 to 1 that grows from the rest."""
            inside = (wave - low) / size
            return np.asarray(rest + (inside - rest) * np.clip((at - first) / grow, 0.0, 1.0))

        slope = np.max(np.abs(np.diff(risen(whole, fine)))) / (fine[1] - fine[0]) * limits.span
        share = min(1.0, steepest / max(slope, _FASTEST_RAMP))
        wave = np.clip(risen(raw(p, time), time), 0.0, 1.0)
        return np.asarray(limits.low + limits.span * (rest + share * (wave - rest)))

    amplitude = lines**-0.6
    phase = rng.uniform(0.0, 2.0 * np.pi, len(lines))
    start = np.concatenate([amplitude * np.cos(phase), amplitude * np.sin(phase)])
    edge = np.full(len(start), 2.0)
    return Waveform(start, -edge, edge, values)
