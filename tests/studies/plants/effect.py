"""What a hidden effect is: a displacement added to the base, with a gain that removes it at 0."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from tests.studies.plants.base import Run
from tests.studies.plants.stack import FloatArray

Parameters = Mapping[str, float]


@dataclass(frozen=True)
class HiddenEffect:
    """One effect hidden in a record.

    name: as in the project's table of effects, or a name that the table lacks (foreign). gain,
    unit: what scales it. draw: random secondary parameters, SI. contribution: (run, secondary
    parameters, gain) -> displacement with the effect minus without it at the samples, (N,) [m];
    exactly zero at gain 0. plausible: smallest and largest gain that a real set-up could have.
    linear: the contribution is proportional to the gain. room: (times, secondary parameters) ->
    temperature at the samples, (N,) [degC], where the effect needs a thermometer in the record.
    refit: the base swallows it far beyond its linearisation (a lag: R_s C_p and tau take it over),
    so its visible ratio is that of a base fitted again. called: its name in the project's table,
    where that is another one. driven: of an effect before the stack, (run, secondary parameters,
    gain) -> the run behind it. of_sensor: it acts on the reading. With these two, several effects
    of one record act on each other (`several.py`). random: it is a random signal of its
    own, which goes on in held-out samples as no model can know.
    """

    name: str
    gain: str
    unit: str
    draw: Callable[[np.random.Generator, Run], dict[str, float]]
    contribution: Callable[[Run, Parameters, float], FloatArray]
    plausible: tuple[float, float]
    linear: bool
    foreign: bool = False
    room: Callable[[FloatArray, Parameters], FloatArray] | None = None
    refit: bool = False
    called: str = ""
    driven: Callable[[Run, Parameters, float], Run] | None = None
    of_sensor: bool = False
    random: bool = False
