"""For use sample by sample in a control loop: observers, feed-forward, identification online."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from psa_casadi.common.errors import InputError, Problems
from psa_casadi.model.component import Component
from psa_casadi.model.components import COMPONENTS
from psa_casadi.model.components.online_identification import (
    COUNT,
    TRACKED,
    adaptive_feed_forward,
    constants,
    estimates,
    feed_forward,
    hysteresis_observer,
    online_identification,
    variances,
)
from psa_casadi.model.compose import Model, compose
from psa_casadi.model.nanopositioner import nanopositioner
from psa_casadi.model.parts import PARTS, compensator_for, part_model

__all__ = [
    "AdaptiveFeedForward",
    "FeedForward",
    "HysteresisObserver",
    "OnlineIdentification",
    "identifier_for",
    "part_for",
    "stack_values",
]

#: A wanted displacement beyond this many strokes of the stack is not in metres.
_STROKES = 10.0


class Block:
    """A component that has sampled states only, stepped in place.

    Its equations are evaluated by CasADi's virtual machine on memory that is laid out once: a
    sample allocates nothing. Two copies of what is kept take turns as source and target. Inputs
    and outputs are in the order in which the component declares them. `values`
    may hold more than its parameters. A pickled block goes on where it was.

    Raises InputError for a value that is out of bounds.
    """

    _component: ClassVar[Component]

    def __init__(self, values: Mapping[str, float]) -> None:
        component = self._component
        table = {p.name: values[p.name] for p in component.parameters}
        model = compose([component], table, name=component.name, description=component.description)
        self._begin(model, [state.start for state in component.sampled])

    @property
    def model(self) -> Model:
        """The block as a model, to be exported as C, FMU or Modelica, with its start values."""
        return self._model

    @property
    def kept(self) -> dict[str, float]:
        """What is kept now, by the names of the sampled states."""
        names = self._model.sampled_names
        return dict(zip(names, self._kept[self._turn].tolist(), strict=True))

    def _begin(self, model: Model, kept: Sequence[float]) -> None:
        self._model, s = model, model.structure
        after, out = ca.substitute([s.znext, s.y], [s.p], [ca.DM(model.parameter_vector())])
        out = ca.substitute(out, s.z, after)
        self._function = ca.Function("recursion", [s.z, s.u], [after, out], {"cse": True})
        self._kept = (np.array(kept, dtype=float), np.array(kept, dtype=float))
        inputs, outputs = np.zeros(s.u.numel()), np.zeros(s.y.numel())
        self._inputs: Any = inputs.data
        self._outputs: Any = outputs.data
        # bound to memory twice: each reads from one copy and writes to the other
        self._bound: Any = [self._function.buffer() for _ in self._kept]
        for source, (buffer, _) in enumerate(self._bound):
            for k, memory in enumerate((self._kept[source].data, self._inputs)):
                buffer.set_arg(k, memory)
            for k, memory in enumerate((self._kept[1 - source].data, self._outputs)):
                buffer.set_res(k, memory)
        self._turn = 0

    def _advance(self) -> float:
        """Advance by one sample, for which `_inputs` has been written; return the first output."""
        self._bound[self._turn][1]()
        self._turn = 1 - self._turn
        return float(self._outputs[0])

    def __getstate__(self) -> dict[str, Any]:
        return {"model": self._model, "kept": self.kept}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._begin(state["model"], list(state["kept"].values()))


class Following(Block):
    """A block whose first input is a wanted displacement [m], and whose first output a voltage."""

    def _begin(self, model: Model, kept: Sequence[float]) -> None:
        super()._begin(model, kept)
        p = model.values
        self._per_volt = p["k_L"] / p["stiffness"]
        self._stroke = abs(self._per_volt) * p["u_rated"]

    def _follow(self, wanted: float) -> float:
        """Advance to a wanted displacement [m].

        Raises InputError, and stays where it is, where that is no number or beyond ten strokes.
        """
        if not abs(wanted) <= _STROKES * self._stroke:
            raise InputError(
                f"The wanted displacement is {wanted:g} m, of a stack whose stroke is"
                f" {1e6 * self._stroke:.3g} um; give metres, such as {0.5 * self._stroke:.2g}. For"
                " volts of a linear stack call step_voltage."
            )
        self._inputs[0] = wanted
        return self._advance()


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
        **{q.name: q.value for q in online_identification.parameters},
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

    _component = hysteresis_observer

    def step(self, voltage: float) -> float:
        """Take one sample of the voltage [V] and return the hysteresis force [N]."""
        self._inputs[0] = voltage
        return self._advance()


class FeedForward(Following):
    """Turns a wanted displacement into the voltage that brings the stack there (39 to 41).

    `k_L u + f_H(u) = K w` with the stiffness K of the stack at rest: the observed force is that of
    the instant for which the voltage is returned, so that no sample is lost. Displacements count
    from where the stack rests at 0 V; creep, load and resonances are not in it. `values` are those
    of `stack_values`.
    """

    _component = feed_forward

    def step(self, wanted: float) -> float:
        """Return the voltage [V] for a wanted displacement [m].

        Raises InputError, and stays where it is, for what is no displacement of this stack: no
        number, or beyond ten strokes.
        """
        return self._follow(wanted)

    def step_voltage(self, wanted: float) -> float:
        """Return the voltage for the wanted voltage of a linear stack [V]. Raises InputError."""
        return self._follow(self._per_volt * wanted)


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
    voltage input is the command, or, with `at_electrodes`, that at the electrodes.

    Raises InputError if the model is no stack of the paper, or beta does not exceed gamma.
    """
    values = stack_values(model, period, at_electrodes=at_electrodes)
    if not noise > 0.0:
        raise InputError(f"The noise is {noise:g} m; give the rms error of the sensor, above 0.")
    values |= {"memory": memory, "noise": noise, "spread": spread}
    return compose([online_identification], values, name="online_identification")


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
        values = [float(v) for v in estimates(c, [kept[f"z_{n}"] for n in TRACKED])]
        factors = [
            [*(kept[f"U_{i + 1}_{j + 1}"] for i in range(j)), kept[f"D_{j + 1}"]]
            for j in range(COUNT)
        ]
        parameters, left = (
            dict(zip(TRACKED, v, strict=True)) for v in (values, variances(factors))
        )
        return Estimate(parameters, kept["f_H"], left)


class OnlineIdentification(_Learning):
    """Recursive least squares of A, beta, gamma, delta and n, of k_L and of the sensor's offset.

    A streaming object: one sample in, one out. `values` are the parameters of the component of the
    same name, for instance `identifier_for(model, period, noise=...).values`. See
    `psa_casadi.model.components.online_identification` for the equations and for what is done while
    the voltage is held.
    """

    _component = online_identification

    def step(self, voltage: float, displacement: float) -> float:
        """Take one sample [V], [m] and return the estimated hysteresis force [N]."""
        self._inputs[0], self._inputs[1] = voltage, displacement
        self._advance()
        return float(self._outputs[COUNT])


class AdaptiveFeedForward(_Learning, Following):
    """Feed-forward whose observer follows the stack: the linearising voltage, tracked online.

    Each step learns from the displacement measured at the voltage that was returned last, and
    returns the next one. The wanted force is the wanted displacement times the model's
    stiffness, so that the gain from wish to displacement is held too while k_L drifts.
    """

    _component = adaptive_feed_forward

    def step(self, wanted: float, measured: float) -> float:
        """Return the voltage [V] for the next wanted displacement [m].

        `measured` [m] is the displacement at the voltage that was returned last.
        Raises InputError, and stays where it is, for a wish that is no displacement of this stack:
        no number, or beyond ten strokes.
        """
        self._inputs[1] = measured
        return self._follow(wanted)

    def step_voltage(self, wanted: float, measured: float) -> float:
        """Return the next voltage for the wanted voltage of a linear stack [V], as `step` does."""
        self._inputs[1] = measured
        return self._follow(self._per_volt * wanted)


#: The rms error of sensor and model as a share of the stroke, by default.
_NOISE = 1e-3
_OBSERVING = ("hysteresis_observer", "feed_forward")
_LEARNING = ("online_identification", "adaptive_feed_forward")
_TUNED = ("position_controller", "hysteresis_compensator", *_OBSERVING, *_LEARNING)


def part_for(
    name: str,
    stack: Model | None = None,
    *,
    period: float | None = None,
    noise: float | None = None,
) -> Model:
    """Return a part by name, tuned to `stack` if it is not None, that acts every `period` [s].

    Without `period` it acts as often as the part does by default. The position controller is that
    of `nanopositioner` around the stack. Observers, feed-forward and identification have the
    stack's values; they see the command, amplifier included. `noise` [m] is the rms error of sensor
    and model for those that learn, by default 0.1 % of the stroke.

    Raises InputError for an unknown name, a part that is not tuned to a stack, and for what the
    tuning refuses.
    """
    bare = part_model(name)
    sampled = bare.structure.period
    if period is None:
        period = bare.values[sampled] if sampled else 0.0
    if stack is None:
        return bare.with_values({sampled: period} if sampled else {})
    if name not in _TUNED:
        raise InputError(
            f"The part '{name}' is not tuned to a stack; leave the stack out. Tuned are"
            f" {', '.join(_TUNED)}."
        )
    if name == "position_controller":
        return nanopositioner(stack, sample_time=period).parts["controller"]
    if name == "hysteresis_compensator":
        return compensator_for(stack)
    values = stack_values(stack, period)
    if name in _LEARNING:
        stroke = abs(values["k_L"]) * values["u_rated"] / values["stiffness"]
        error = noise if noise is not None else _NOISE * stroke
        values = dict(identifier_for(stack, period, noise=error).values)
    component = COMPONENTS[name]
    table = {p.name: values[p.name] for p in component.parameters}
    return compose([component], table, name=name, description=PARTS[name].description)
