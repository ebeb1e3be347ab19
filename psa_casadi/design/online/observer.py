"""The hysteresis observer (paper eq. 37) and the feed-forward that linearises (eqs. 39 to 41)."""

from collections.abc import Mapping

from psa_casadi.components.online_identification import (
    FEED_FORWARD,
    HYSTERESIS_OBSERVER,
    ONLINE_IDENTIFICATION,
)
from psa_casadi.design.online.streams import Block, Following
from psa_casadi.errors import InputError, Problems
from psa_casadi.model.compose import Model

__all__ = ["FeedForward", "HysteresisObserver", "stack_values"]

_NEEDED = {"bouc_wen", "creep_lag", "cascade_mechanics", "drive"}


def stack_values(model: Model, period: float, *, at_electrodes: bool = False) -> dict[str, float]:
    """Return a stack's values under the names that observer, feed-forward and identification use.

    `period` [s] is the sample period. The voltage is the command, to which the amplifier's gain
    and lag then belong, or, with `at_electrodes`, that at the stack's electrodes. `lag` is the
    first moment of everything linear between that voltage and the displacement.

    Raises InputError if the model is no stack of the paper, or beta does not exceed gamma.
    """
    missing = sorted(_NEEDED - {c.name for c in model.components})
    if missing:
        raise InputError(
            f"The model '{model.name}' is no stack of the paper, it lacks {', '.join(missing)};"
            " give one that `psa identify` wrote."
        )
    p, problems = model.values, Problems()
    if not p["beta"] > p["gamma"]:
        problems.add(
            f"beta = {p['beta']:g} N/V does not exceed gamma = {p['gamma']:g} N/V, so that the"
            " hysteresis force has no bound; identify the stack again, or correct the two."
        )
    if not period > 0.0:
        problems.add(f"The sample period is {period:g} s; give a positive one.")
    problems.raise_if_any()
    lag = p["tau"] + p["c_P"] / p["k_P"] + p["c_B"] / p["k_B"]
    lag -= (p["c_B"] + p["c_P"]) / (p["k_B"] + p["k_P"])
    gain = 1.0 if at_electrodes else p["G"]
    return {
        **{q.name: q.value for q in ONLINE_IDENTIFICATION.parameters},
        **{n: p[n] for n in ("n", "h_ref")},
        **{n: gain * p[n] for n in ("k_L", "A", "beta", "gamma", "delta")},
        "hold_rate": p["hold_rate"] / gain,
        "u_rated": p["u_rated"] / gain,
        "stiffness": p["k_P"] * p["k_B"] / (p["k_P"] + p["k_B"]),
        "lag": lag if at_electrodes else lag + p["R_s"] * p["C_p"],
        "period": period,
        "standstill_rate": max(10.0 * p["hold_rate"], 1e-2 * p["u_rated"]) / gain,
    }


class HysteresisObserver(Block):
    """Runs eq. (8) on the known voltage (37): one sample in, one force out.

    Between samples the voltage is taken as linear; one implicit step covers it, whatever its size.
    `values` are those of `stack_values`.
    """

    def __init__(self, values: Mapping[str, float]) -> None:
        super().__init__(HYSTERESIS_OBSERVER, values)

    def step(self, voltage: float) -> float:
        """Take one sample of the voltage [V] and return the hysteresis force [N]."""
        self._given[0] = voltage
        return self._advance()


class FeedForward(Following):
    """Turns a wanted displacement into the voltage that brings the stack there (39 to 41).

    `k_L u + f_H(u) = K w` with the stiffness K of the stack at rest: the observed force is that of
    the instant for which the voltage is returned, so that no sample is lost. Displacements count
    from where the stack rests at 0 V; creep, load and resonances are not in it. `values` are those
    of `stack_values`.
    """

    def __init__(self, values: Mapping[str, float]) -> None:
        super().__init__(FEED_FORWARD, values)

    def step(self, wanted: float) -> float:
        """Return the voltage [V] for a wanted displacement [m].

        Raises InputError, and stays where it is, for what is no displacement of this stack: no
        number, or beyond ten strokes.
        """
        return self._follow(wanted)

    def step_voltage(self, wanted: float) -> float:
        """Return the voltage for the wanted voltage of a linear stack [V]. Raises InputError."""
        return self._follow(self._per_volt * wanted)
