"""The hysteresis parameters tracked online: one sample in, one estimate out (paper eq. 38)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from psa_casadi.component import Expression
from psa_casadi.components.online_identification import (
    ONLINE_IDENTIFICATION,
    SAMPLED,
    flattened,
    gathered,
)
from psa_casadi.components.online_recursion import (
    COUNT,
    TRACKED,
    Constants,
    advance,
    constants,
    estimates,
    linearising_voltage,
)
from psa_casadi.design.online.observer import stack_values
from psa_casadi.design.online.streams import Stream
from psa_casadi.errors import InputError
from psa_casadi.model.compose import Model, compose

__all__ = ["AdaptiveFeedForward", "Estimate", "OnlineIdentification", "identifier_for"]

_TRIANGLE = COUNT * (COUNT + 1) // 2
_FORCE = COUNT + _TRIANGLE + 1


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


class OnlineIdentification:
    """Recursive least squares of A, beta, gamma, delta and n, of k_L and of the sensor's offset.

    A streaming object: one sample in, one out. `values` are the parameters of the component of the
    same name, for instance `identifier_for(model, period, noise=...).values`. See
    `psa_casadi.components.online_recursion` for the equations and for what is done when the
    voltage stands still.
    """

    def __init__(self, values: Mapping[str, float]) -> None:
        c = constants(values)

        def recursion(
            kept: list[Expression], given: list[Expression]
        ) -> tuple[Sequence[Expression], Sequence[Expression]]:
            after = advance(c, gathered(kept), given[0], given[1])
            return flattened(after), [after.f]

        self._constants = c
        self._stream = Stream(recursion, [state.start for state in SAMPLED], 2)

    def step(self, voltage: float, displacement: float) -> float:
        """Take one sample [V], [m] and return the estimated hysteresis force [N]."""
        stream = self._stream
        given = stream.given
        given[0], given[1] = voltage, displacement
        stream.step()
        return float(stream.out[0])

    @property
    def estimate(self) -> Estimate:
        """Parameters, force and what is left of their uncertainty after the last sample."""
        return _estimate(self._constants, self._stream.kept)


class AdaptiveFeedForward:
    """Feed-forward whose observer follows the stack: the linearising voltage, tracked online.

    Each step learns from the displacement measured at the voltage that was returned last, and
    returns the next one. The wanted force is that of the model's own k_L, so that the gain from
    command to displacement is held too while k_L drifts.
    """

    def __init__(self, values: Mapping[str, float]) -> None:
        c = constants(values)
        count = len(SAMPLED)

        def recursion(
            kept: list[Expression], given: list[Expression]
        ) -> tuple[Sequence[Expression], Sequence[Expression]]:
            wanted, measured = given
            applied, last = kept[count:]
            m = advance(c, gathered(kept[:count]), applied, measured)
            theta = estimates(c, m.z)
            force = c.start[5] * wanted
            u = linearising_voltage(c, theta, m.f, m.u, applied + wanted - last, force)
            return [*flattened(m), u, wanted], [u]

        self._constants = c
        self._stream = Stream(recursion, [*(state.start for state in SAMPLED), 0.0, 0.0], 2)

    def step(self, wanted: float, measured: float) -> float:
        """Return the voltage for the next wanted voltage of a linear stack [V].

        `measured` [m] is the displacement at the voltage that was returned last.
        """
        stream = self._stream
        given = stream.given
        given[0], given[1] = wanted, measured
        stream.step()
        return float(stream.out[0])

    @property
    def estimate(self) -> Estimate:
        """Parameters, force and what is left of their uncertainty after the last sample."""
        return _estimate(self._constants, self._stream.kept)


def _estimate(c: Constants, kept: Sequence[float]) -> Estimate:
    found = [float(v) for v in estimates(c, kept[:COUNT])]
    left = [kept[COUNT + i * (i + 3) // 2] for i in range(COUNT)]
    names = tuple(TRACKED)
    return Estimate(
        dict(zip(names, found, strict=True)), kept[_FORCE], dict(zip(names, left, strict=True))
    )
