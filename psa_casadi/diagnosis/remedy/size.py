"""How large an effect of a model is, with the interval that its parameters leave."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from psa_casadi.component import Component
from psa_casadi.diagnosis.remedy.trials import SIGNED, TESTS, Figure, drive_of
from psa_casadi.diagnosis.signature import STACK
from psa_casadi.errors import PsaError
from psa_casadi.model.compose import Model
from psa_casadi.model.stacks import stack_model
from psa_casadi.records.record import Record

_NORMAL_95 = 1.959963984540054


@dataclass(frozen=True)
class Size:
    """What an effect changes in a test, in `unit`; signed where it moves on (hold, top).

    `interval` (95 %) is what the uncertainty of the effect's own parameters leaves, None where that
    is not known. `at` says where in the test: time after the step, rate, frequency, duration. The
    test plays between the `voltages`, of a model of one's own as its records do (None), and of that
    one `output` shows it. `beyond_records` says that the records do not reach there.
    """

    test: str
    value: float
    unit: str
    interval: tuple[float, float] | None
    at: float
    at_unit: str
    voltages: tuple[float, float] | None
    beyond_records: bool = False
    output: str = "displacement"


def sizes(
    effect: Component, model: Model, records: Sequence[Record] = (), *, unit: str = "m"
) -> tuple[Size, ...]:
    """Return how large an effect of a model is, none where the test cannot be simulated.

    `records` are those that the model was identified from; without them the one in its evidence is
    played. `unit` is that of their displacement.
    """
    drive = drive_of(model, effect, records)
    off = model.with_values({effect.gain or "": 0.0})
    test = TESTS[effect.what_now.test]
    try:
        found = test(model, off, drive)
        interval = _intervals(effect, model, found, lambda changed: test(changed, off, drive))
    except PsaError:
        return ()
    if not np.isfinite([f.value for f in found]).all():
        return ()
    return tuple(
        Size(
            f.test, f.value, f.unit or unit, within, f.at, f.at_unit, (drive.low, drive.high),
            f.test == "hold" and f.at > drive.longest,
        )
        for f, within in zip(found, interval, strict=True)
    )  # fmt: skip


def example(effect: Component, stack: Model | None = None) -> tuple[Model, tuple[Size, ...]]:
    """Return a stack with an effect, by default the P-885.51, and how large the effect is there.

    A model that holds the effect keeps its values; else its gain has an ordinary size.
    """
    # delta, by which a voltage that leaks slowly makes a force that grows, belongs to no effect
    model = stack or stack_model(STACK).with_values({"delta": 0.0})
    if effect.name not in (c.name for c in model.components):
        model = model.with_effect(effect)
        gain = model.parameter(effect.gain or "")
        ordinary = gain.typical({**model.values, gain.name: 0.0})
        model = model.with_values({gain.name: min(ordinary, gain.bounds[1])})
    return model, sizes(effect, model)


def _intervals(
    effect: Component,
    model: Model,
    found: Sequence[Figure],
    test: Callable[[Model], Sequence[Figure]],
) -> list[tuple[float, float] | None]:
    """Return the 95 % intervals of figures.

    (s_i - s)^2 add up over the columns i of a root of the covariance of the effect's parameters,
    1.96 of which change them, within their bounds.
    """
    known = None if model.evidence is None else model.evidence.covariance.of(effect.fitted)
    if known is None or not known.names or effect.trial_starts:  # its starts share the gain's size
        return [None] * len(found)
    size, directions = np.linalg.eigh(np.array(known.matrix))
    moves = _NORMAL_95 * directions * np.sqrt(np.maximum(size, 0.0))
    spread = np.zeros(len(found))
    for move in moves.T:
        changed = {}
        for name, step in zip(known.names, move.tolist(), strict=True):
            bounds = model.parameter(name).bounds
            changed[name] = float(np.clip(model.values[name] + step, *bounds))
        other = test(model.with_values(changed))
        if len(other) != len(found):
            return [None] * len(found)
        spread += [(o.value - f.value) ** 2 for o, f in zip(other, found, strict=True)]
    return [
        (f.value - half if f.test in SIGNED else max(f.value - half, 0.0), f.value + half)
        for f, half in zip(found, np.sqrt(spread).tolist(), strict=True)
    ]
