"""The hysteresis parameters tracked online: one sample in, one estimate out (paper eq. 38)."""

from collections.abc import Mapping
from dataclasses import dataclass

from psa_casadi.components.online_identification import ADAPTIVE_FEED_FORWARD, ONLINE_IDENTIFICATION
from psa_casadi.components.online_recursion import COUNT, TRACKED, constants, estimates, variances
from psa_casadi.design.online.observer import stack_values
from psa_casadi.design.online.streams import Block, Following
from psa_casadi.errors import InputError
from psa_casadi.model.compose import Model, compose

__all__ = ["AdaptiveFeedForward", "Estimate", "OnlineIdentification", "identifier_for"]


def identifier_for(
    model: Model,
    period: float,
    *,
    noise: float,
    memory: float = 1.0,
    spread: float = 0.3,
    at_electrodes: bool = False,
) -> Model:
    """Return the online identification of a stack as a model that streams, simulates and exports.

    `period` [s] is its sample period, `noise` [m] the rms error of the measured displacement and of
    the model (the smaller, the faster and the rougher the estimates), `memory` [s] the time over
    which it forgets, `spread` how far the stack's parameters may be off, as a share. The
    voltage that it is given is the command, or, with `at_electrodes`, that at the electrodes.

    Raises InputError if the model is no stack of the paper, or beta does not exceed gamma.
    """
    values = stack_values(model, period, at_electrodes=at_electrodes)
    if not noise > 0.0:
        raise InputError(f"The noise is {noise:g} m; give the rms error of the sensor, above 0.")
    values |= {"memory": memory, "noise": noise, "spread": spread}
    return compose([ONLINE_IDENTIFICATION], values, name="online_identification")


@dataclass(frozen=True)
class Estimate:
    """What is known after a sample, SI: each tracked parameter, and the hysteresis force [N].

    `uncertainty` is the share of the prior variance that is left in each parameter's direction.
    """

    parameters: Mapping[str, float]
    hysteresis_force: float
    uncertainty: Mapping[str, float]


class _Learning(Block):
    """A block that learns."""

    @property
    def estimate(self) -> Estimate:
        """Parameters, force and what is left of their uncertainty after the last sample."""
        kept, p = self.kept, self.model.values
        c = constants(p)
        found = [float(v) for v in estimates(c, [kept[f"z_{n}"] for n in TRACKED])]
        left = variances(
            [
                [*(kept[f"U_{i + 1}_{j + 1}"] for i in range(j)), kept[f"D_{j + 1}"]]
                for j in range(COUNT)
            ]
        )
        names = tuple(TRACKED)
        return Estimate(
            dict(zip(names, found, strict=True)), kept["f_H"], dict(zip(names, left, strict=True))
        )


class OnlineIdentification(_Learning):
    """Recursive least squares of A, beta, gamma, delta and n, of k_L and of the sensor's offset.

    A streaming object: one sample in, one out. `values` are the parameters of the component of the
    same name, for instance `identifier_for(model, period, noise=...).values`. See
    `psa_casadi.components.online_recursion` for the equations and for what is done when the
    voltage stands still.
    """

    def __init__(self, values: Mapping[str, float]) -> None:
        super().__init__(ONLINE_IDENTIFICATION, values)

    def step(self, voltage: float, displacement: float) -> float:
        """Take one sample [V], [m] and return the estimated hysteresis force [N]."""
        self._given[0], self._given[1] = voltage, displacement
        self._advance()
        return float(self._out[COUNT])


class AdaptiveFeedForward(_Learning, Following):
    """Feed-forward whose observer follows the stack: the linearising voltage, tracked online.

    Each step learns from the displacement measured at the voltage that was returned last, and
    returns the next one. The wanted force is the wanted displacement times the model's own
    stiffness, so that the gain from wish to displacement is held too while k_L drifts.
    """

    def __init__(self, values: Mapping[str, float]) -> None:
        super().__init__(ADAPTIVE_FEED_FORWARD, values)

    def step(self, wanted: float, measured: float) -> float:
        """Return the voltage [V] for the next wanted displacement [m].

        `measured` [m] is the displacement at the voltage that was returned last.
        Raises InputError, and stays where it is, for a wish that is no displacement of this stack:
        no number, or beyond ten strokes.
        """
        self._given[1] = measured
        return self._follow(wanted)

    def step_voltage(self, wanted: float, measured: float) -> float:
        """Return the next voltage for the wanted voltage of a linear stack [V], as `step` does."""
        self._given[1] = measured
        return self._follow(self._per_volt * wanted)
