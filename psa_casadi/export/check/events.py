"""The event indicators of an FMU."""

from collections.abc import Iterator

import numpy as np

from psa_casadi.export.check.structure import (
    evaluate,
    held_values,
    random_point,
    sampled_starts,
)
from psa_casadi.export.check.truth import Truth
from psa_casadi.export.importer.fmu import MODEL_EXCHANGE, Fmu, Instance

_TOLERANCE = 1e-10
_POINTS = 4
#: Inputs at which an indicator is looked at, in nominal values.
_SIZES = (0.1, -0.1, 1.0, -1.0, 10.0, -10.0, 100.0, -100.0)
#: Of indicators, as shares of the largest value of the switch: error, and margin.
_EXACT, _MARGIN = 1e-9, 1e-2


def event_indicators(fmu: Fmu) -> Iterator[str]:
    """As many as announced, equal to their variables, alive, and turned round by an event.

    One that follows an input at rest has both signs as the inputs go either way, from a tenth to
    many times their nominals. One that follows states, held values, parameters or time need not
    have both within reach; it must move with one of them. After an event none is negative, for an
    importer then waits for the next change of sign.
    """
    names, count = fmu.indicators(), fmu.indicator_count()
    if count != len(names):
        yield f"{count} event indicators are announced, {len(names)} variables switch.* repeat them"
    with fmu.start(MODEL_EXCHANGE, tolerance=_TOLERANCE) as instance:
        if fmu.version == 3:
            yield from _numbers(fmu, instance)
        yield from _one_sided(fmu, instance)
    starts = sampled_starts(fmu, np.random.default_rng(7))
    with fmu.start(MODEL_EXCHANGE, values=starts) as instance:
        yield from dict.fromkeys(_dead_or_not_turned(fmu, instance))


def _one_sided(fmu: Fmu, instance: Instance) -> Iterator[str]:
    """Yield the indicators that follow the inputs at rest, but have one sign for all of them."""
    names, count = fmu.indicators(), fmu.indicator_count()
    rest = np.zeros(len(fmu.states()))
    values = []
    for size in _SIZES:
        inputs = {n: size * fmu.nominals[n] for n in fmu.names("input")}
        instance.derivatives(0.0, rest, inputs)
        values.append(instance.vector("GetEventIndicators", count))
        if values[-1].tobytes() != instance.get(names).tobytes():
            yield "the event indicators differ from the variables that repeat them"
            return
    for name, z in zip(names, np.array(values).T, strict=False):
        if np.ptp(z) > 0.0 and not np.min(z) * np.max(z) < 0.0:
            yield f"'{name}' follows the inputs and does not change its sign when they turn"


def _dead_or_not_turned(fmu: Fmu, instance: Instance) -> Iterator[str]:
    """Yield the indicators that nothing moves, and those that an event leaves negative."""
    names, generator = fmu.indicators(), np.random.default_rng(8)
    points = [random_point(fmu, generator) for _ in range(_POINTS)]
    before = [evaluate(instance, point, names) for point in points]
    for name, z in zip(names, np.array(before).T, strict=True):
        if not np.ptp(z) > 0.0:
            yield f"'{name}' moves with nothing"
    for point in sorted(points, key=lambda p: p["time"]):
        evaluate(instance, point, names)
        instance.require("EnterEventMode")
        instance.update_discrete_states()
        instance.require("EnterContinuousTimeMode")
        for name, z in zip(names, instance.get(names), strict=True):
            if not z >= 0.0:
                yield f"'{name}' stays negative after an event"


def _numbers(fmu: Fmu, instance: Instance) -> Iterator[str]:
    """Yield what the binary counts otherwise than the description."""
    if instance.fmi.getNumberOfEventIndicators() != fmu.indicator_count():
        yield "the binary has another number of event indicators than the description"
    if instance.fmi.getNumberOfContinuousStates() != len(fmu.states()):
        yield "the binary has another number of states than the description"
    if [u.variable.name for u in fmu.description.eventIndicators] != fmu.indicators():
        yield "the event indicators of the description are not the variables switch.*"


def wrong_indicators(fmu: Fmu, truth: Truth) -> Iterator[str]:
    """Each event indicator is a switch of the model or its negative, plus a small fixed margin."""
    generator = np.random.default_rng(5)
    if fmu.indicators() != [f"switch.{name}" for name in truth.switch_names]:
        named = ", ".join(truth.switch_names) or "none"
        yield f"the event indicators are not those of the model: {named}"
        return
    found, expected = [], []
    with fmu.start(MODEL_EXCHANGE) as instance:
        for _ in range(_POINTS):
            point = random_point(fmu, generator)
            found.append(evaluate(instance, point, fmu.indicators()))
            groups = (truth.state_names, truth.input_names, truth.parameter_names)
            vectors = [np.array([point[n] for n in names]) for names in groups]
            vectors += held_values(instance)
            expected.append(np.array(truth.switches(point["time"], *vectors)).ravel())
    for name, z, switch in zip(
        fmu.indicators(), np.array(found).T, np.array(expected).T, strict=True
    ):
        size = float(np.max(np.abs(switch)))
        margins = [z - switch, z + switch]
        if not any(np.ptp(m) <= _EXACT * size and abs(m[0]) <= _MARGIN * size for m in margins):
            yield f"'{name}' is not the switch of the model"
