"""What a hidden effect is: a displacement added to the base, with a gain that removes it at 0."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from tests.studies.plants.base import Run, force_to_displacement
from tests.studies.plants.stack import FloatArray

Parameters = Mapping[str, float]
Contribution = Callable[[Run, Parameters, float], FloatArray]


@dataclass(frozen=True)
class Draw:
    """Random secondary parameters of an effect in a base run, SI."""

    rng: np.random.Generator
    run: Run

    def uniform(self, low: float, high: float) -> float:
        """Return a number between two."""
        return float(self.rng.uniform(low, high))

    def sign(self) -> float:
        """Return 1 or -1."""
        return 1.0 if self.rng.integers(2) else -1.0

    def seed(self) -> float:
        """Return the seed of a random signal."""
        return float(self.rng.integers(2**31))

    def place(self, low: float, high: float) -> float:
        """Return a displacement at a share of the range moved between two [m]."""
        return float(self.run.displacement.min()) + self.uniform(low, high) * self.span

    @property
    def span(self) -> float:
        """Range moved [m]."""
        return float(np.ptp(self.run.displacement))

    @property
    def length(self) -> float:
        """Length of the record [s]."""
        return float(self.run.times[-1] - self.run.times[0])


@dataclass(frozen=True)
class HiddenEffect:
    """One effect hidden in a record.

    name: as in the project's table of effects, or a name that the table lacks (foreign). gain,
    unit: what scales it. plausible: smallest and largest gain that a real set-up could have. adds:
    (run, secondary parameters, gain) -> displacement with the effect minus without it at the
    samples, (N,) [m]; not called at gain 0, where it is zero. drawn: its secondary parameters.
    linear: it is proportional to the gain. room: (times, secondary parameters) -> temperature at
    the samples, (N,) [degC], where the effect needs a thermometer in the record. refit: the base
    swallows it far beyond its linearisation (a lag: R_s C_p and tau take it over), so its visible
    ratio is that of a base fitted again. called: its name in the project's table, where that is
    another one. driven: of an effect before the stack, (run, secondary parameters, gain) -> the run
    behind it. of_sensor: it acts on the reading. With these two, several effects of one record act
    on each other (`added_by`). random: it is a further random signal, which goes on in held-out
    samples as no model can know.
    """

    name: str
    gain: str
    unit: str
    plausible: tuple[float, float]
    adds: Contribution
    drawn: Callable[[Draw], dict[str, float]] = lambda _: {}
    linear: bool = False
    foreign: bool = False
    room: Callable[[FloatArray, Parameters], FloatArray] | None = None
    refit: bool = False
    called: str = ""
    driven: Callable[[Run, Parameters, float], Run] | None = None
    of_sensor: bool = False
    random: bool = False

    def draw(self, rng: np.random.Generator, run: Run) -> dict[str, float]:
        """Return random secondary parameters, SI."""
        return self.drawn(Draw(rng, run))

    def contribution(self, run: Run, parameters: Parameters, gain: float) -> FloatArray:
        """Displacement with the effect minus without it at the samples, (N,) [m]."""
        if gain == 0.0:
            return np.zeros_like(run.times)
        return np.asarray(self.adds(run, parameters, gain), dtype=np.float64)


def hidden(
    gain: str, unit: str, plausible: tuple[float, float], **more: Any
) -> Callable[[Contribution], HiddenEffect]:
    """Make an effect from the function of its contribution, which has the effect's name."""
    return lambda adds: HiddenEffect(adds.__name__, gain, unit, plausible, adds, **more)


def of_drive(
    gain: str, unit: str, plausible: tuple[float, float], **more: Any
) -> Callable[[Callable[[Run, Parameters, float], Run]], HiddenEffect]:
    """Make an effect of the run behind it; it adds what that moves more than the run itself."""

    def made(driven: Callable[[Run, Parameters, float], Run]) -> HiddenEffect:
        def adds(run: Run, parameters: Parameters, gain: float) -> FloatArray:
            return driven(run, parameters, gain).displacement - run.displacement

        return HiddenEffect(driven.__name__, gain, unit, plausible, adds, driven=driven, **more)

    return made


def pushed(run: Run, force: FloatArray) -> FloatArray:
    """Displacement at the samples (N,) [m] of a force on the fine grid (M,) [N]."""
    return force_to_displacement(run.stack, force, run.fine_step)[:: run.sub_intervals]
