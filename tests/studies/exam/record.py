"""What defines a record of the exam: stack, voltage, what is hidden, and which names are right."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.signal import cont2discrete, lfilter

from tests.studies.exam.marks import Group, Question

Floats = NDArray[np.float64]
Values = tuple[float, ...]
#: Changes a signal: (signal, further signals, the run, the values of the cause).
Cause = Callable[..., Floats]
HysteresisKind = Literal[
    "Bouc-Wen", "Preisach", "relays", "Prandtl-Ishlinskii", "Coleman-Hodgdon", "Duhem"
]

#: Two resonances of a stack, unless the record states others: f_1 [Hz], zeta_1, f_2 [Hz], zeta_2.
MECHANICS = (6e3, 0.02, 21e3, 0.03)


@dataclass(frozen=True)
class Stack:
    """A stack: its hysteresis, its stroke over the voltages of the test [um], lag R_s C_p [s].

    `bouc_wen` are A, the height of the loop [V], gamma/(beta + gamma), n and delta [1/V];
    `strain_lag` is a lag of the strain [s].
    """

    hysteresis: HysteresisKind
    stroke: float
    lag: float = 0.8e-3
    mechanics: tuple[float, float, float, float] = MECHANICS
    bouc_wen: tuple[float, float, float, float, float] | None = None
    strain_lag: float = 0.0


@dataclass(frozen=True)
class Test:
    """What is played and how it is measured.

    Kind of voltage with its frequency [Hz], rate of the samples [Hz] and their number, lowest and
    highest voltage [V], rms of the noise [% of the range], steps of the simulation between two
    samples, pole of the noise's colour, and whether the amplifier's monitor is recorded.
    """

    voltage: str
    frequency: float
    rate: float
    samples: int
    limits: tuple[float, float]
    noise: float
    steps: int = 6
    colour: float = 0.0
    monitor: bool = False

    @property
    def span(self) -> float:
        """Highest less lowest voltage [V]."""
        return self.limits[1] - self.limits[0]

    @property
    def largest(self) -> float:
        """Largest magnitude of the voltage [V]."""
        return max(abs(self.limits[0]), abs(self.limits[1]))


@dataclass(frozen=True)
class Record:
    """A record of the exam.

    `hidden` are the causes by name with their values, `accepted` the names that are right: a set
    for each cause; of a foreign record the set of what comes nearest.
    """

    name: str
    seed: int
    hides: str
    stack: Stack
    test: Test
    hidden: Mapping[str, Values] = field(default_factory=dict)
    accepted: tuple[frozenset[str], ...] = ()

    @property
    def question(self) -> Question:
        """What is right to say of it."""
        groups: dict[str, Group] = {"c": "clean", "k": "one", "t": "two", "f": "foreign"}
        other = self.stack.hysteresis != "Bouc-Wen"
        colour = "autoregressive" if self.test.colour else ""
        return Question(groups[self.name[0]], self.accepted, other, colour)

    def draws(self, number: int) -> np.random.Generator:
        """Return the random numbers of one part of the simulation."""
        return np.random.default_rng(self.seed + number)


@dataclass(frozen=True)
class Run:
    """A record that is played: its fine times (M,) [s] and their step [s]."""

    record: Record
    times: Floats
    step: float

    @property
    def share(self) -> Floats:
        """Times as shares of the record's length."""
        return np.asarray(self.times / self.times[-1])

    def changed(self, causes: Mapping[str, Cause], signal: Floats, *more: Floats) -> Floats:
        """Return a signal changed by those of the causes that the record hides, in their order."""
        for name, cause in causes.items():
            if name in self.record.hidden:
                signal = cause(signal, *more, self, self.record.hidden[name])
        return signal


def named(*causes: Cause) -> dict[str, Cause]:
    """Return causes by the names that records have for them: those of their functions."""
    return {cause.__name__.strip("_").replace("_", " "): cause for cause in causes}


def filtered(
    numerator: Sequence[float], denominator: Sequence[float], signal: Floats, step: float
) -> Floats:
    """Return numerator(s)/denominator(s) of a signal, at rest before its first sample.

    Exact steps; the signal is a straight line between two samples. Source: K. J. Astrom, B.
    Wittenmark, "Computer-Controlled Systems", first-order hold.
    """
    b, a, _ = cont2discrete((np.array(numerator), np.array(denominator)), step, method="foh")
    rest = numerator[-1] / denominator[-1] * signal[0]
    out = rest + lfilter(np.ravel(b), np.ravel(a), signal - signal[0])
    return np.asarray(out, dtype=np.float64)


def lagged(signal: Floats, time_constant: float, step: float) -> Floats:
    """Return 1/(tau s + 1) of a signal."""
    return filtered([1.0], [time_constant, 1.0], signal, step)


def resonant(
    signal: Floats, frequency: float, damping: float, step: float, zero: float = 0.0
) -> Floats:
    """Return (zero s + 1)/(s^2/w^2 + 2 zeta s/w + 1) of a signal, w = 2 pi f."""
    w = 2 * math.pi * frequency
    numerator = [zero, 1.0] if zero else [1.0]
    return filtered(numerator, [1 / w**2, 2 * damping / w, 1.0], signal, step)
