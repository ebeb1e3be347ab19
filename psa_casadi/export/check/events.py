"""Events of an FMU: event indicators, and what only FMI 3.0 has between two steps."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from psa_casadi.export.check.calls import displaced, needless_events
from psa_casadi.export.check.structure import (
    evaluate,
    held_values,
    random_point,
    sampled_starts,
)
from psa_casadi.export.check.truth import Truth
from psa_casadi.export.importer.calls import CO_SIMULATION, MODEL_EXCHANGE, FloatArray, Instance
from psa_casadi.export.importer.fmu import Fmu
from psa_casadi.export.importer.instance3 import Instance3, Update

_TOLERANCE = 1e-10
_SAME = 1e-7
#: Share of a step after which it is asked to return early.
_LEAVE = 0.3
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
        if isinstance(instance, Instance3):
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


def _numbers(fmu: Fmu, instance: Instance3) -> Iterator[str]:
    """Yield what the binary counts otherwise than the description."""
    if instance.number("GetNumberOfEventIndicators") != fmu.indicator_count():
        yield "the binary has another number of event indicators than the description"
    if instance.number("GetNumberOfContinuousStates") != len(fmu.states()):
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


def _moving(fmu: Fmu) -> dict[str, float]:
    return {n: 0.7 * fmu.nominals[n] for n in fmu.names("input")}


def intermediate_update(fmu: Fmu) -> Iterator[str]:
    """FMI 3.0: times of updates increase to the end; a step ended early goes on to the same end.

    At rest, and where all rates are constant, one step of the solver spans a communication step:
    then the states start elsewhere, and a step that still cannot be left early need not be.
    """
    size = 10.0 * fmu.step_size
    starts: dict[str, float] = {}
    times, straight = _update_times(fmu, size, starts)
    if straight:
        starts = displaced(fmu)
        times, straight = _update_times(fmu, size, starts)
    if not times or times != sorted(set(times)) or abs(times[-1] - size) > 1e-9 * size:
        yield "the times of the intermediate updates do not increase to the end of the step"
    if not straight:
        yield from _left_early(fmu, size, starts)


def _update_times(fmu: Fmu, size: float, starts: dict[str, float]) -> tuple[list[float], bool]:
    """Return the times of the updates of one step, and whether it is straight: all rates constant.

    A step in which there is an update before the end is none of those.
    """
    times: list[float] = []

    def watch(_: Instance3, update: Update) -> None:
        times.append(update.time)

    rates = [u.variable.name for u in fmu.description.derivatives]
    with fmu.start3(CO_SIMULATION, tolerance=_TOLERANCE, watcher=watch, values=starts) as instance:
        instance.set(_moving(fmu))
        before = instance.get(rates)
        instance.step(0.0, size)
        after = instance.get(rates)
    inner = any(_LEAVE * size < t < size * (1.0 - 1e-9) for t in times)
    change, largest = np.abs(after - before), np.maximum(np.abs(before), np.abs(after))
    return times, not inner and bool(np.all(change <= _SAME * largest))


def _left_early(fmu: Fmu, size: float, starts: dict[str, float]) -> Iterator[str]:
    names = [*fmu.names("output"), *fmu.states()]

    def leave(_: Instance3, update: Update) -> float | None:
        return update.time if update.time > _LEAVE * size and update.can_return_early else None

    options: dict[str, Any] = {"tolerance": _TOLERANCE, "values": starts}
    with fmu.start3(CO_SIMULATION, **options) as instance:
        instance.set(_moving(fmu))
        instance.step(0.0, size)
        whole = instance.get(names)
    with fmu.start3(CO_SIMULATION, watcher=leave, **options) as instance:
        instance.set(_moving(fmu))
        done = instance.try_step(0.0, size)
        if not (done.early and _LEAVE * size < done.time < size):
            yield f"a step does not return early when asked to (it reached {done.time:g} s)"
        elif _apart(fmu, names, whole, _rest_of_step(instance, done.time, size, names)) > _SAME:
            yield "a step that returned early and went on ends elsewhere"


def _rest_of_step(instance: Instance3, now: float, size: float, names: list[str]) -> FloatArray:
    """Go on from an early return, however often there is another, and return values at the end."""
    while now < size * (1.0 - 1e-12):
        done = instance.try_step(now, size - now)
        if done.status or done.time <= now:
            break
        now = done.time
    return instance.get(names)


def _apart(fmu: Fmu, names: list[str], a: FloatArray, b: FloatArray) -> float:
    """Return the largest difference in nominal values."""
    nominal = np.array([fmu.nominals[n] for n in names])
    return float(np.max(np.abs(a - b) / np.maximum(nominal, 1e-300), initial=0.0))


def event_mode(fmu: Fmu) -> Iterator[str]:
    """FMI 3.0: inputs set in event mode between two steps act as those set in step mode."""
    size, names = fmu.step_size, [*fmu.names("output"), *fmu.states()]
    results = []
    for events in (False, True):
        with fmu.start3(CO_SIMULATION, events=events) as instance:
            for k, share in enumerate((1.0, 0.2)):
                if events and k:
                    instance.require("EnterEventMode")
                instance.set({n: share * v for n, v in _moving(fmu).items()})
                if events:
                    yield from needless_events(instance)
                    instance.require("EnterStepMode")
                instance.step(k * size, size)
            results.append(instance.get(names).tobytes())
    if results[0] != results[1]:
        yield "with event mode the same inputs give other results"
