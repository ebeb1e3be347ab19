"""Events of an FMU: event indicators, and what only FMI 3.0 has between two steps."""

from collections.abc import Iterator

import casadi as ca
import numpy as np

from psa_casadi.export.check_calls import needless_events
from psa_casadi.export.check_structure import evaluate, held_values, random_point
from psa_casadi.export.fmu_calls import CO_SIMULATION, MODEL_EXCHANGE, FloatArray
from psa_casadi.export.fmu_instance import Fmu
from psa_casadi.export.fmu_instance3 import Instance3, Update
from psa_casadi.model.compose import Model

_TOLERANCE = 1e-10
_SAME = 1e-7
_POINTS = 4
#: Of indicators, as shares of the largest value of the switch: error, and margin.
_EXACT, _MARGIN = 1e-9, 1e-2


def event_indicators(fmu: Fmu) -> Iterator[str]:
    """As many as announced, equal to their variables, of other sign after the inputs turned."""
    names, count = fmu.indicators(), fmu.indicator_count()
    if count != len(names):
        yield f"{count} event indicators are announced, {len(names)} variables switch.* repeat them"
    with fmu.start(MODEL_EXCHANGE) as instance:
        if isinstance(instance, Instance3):
            yield from _numbers(fmu, instance)
        rest = np.zeros(len(fmu.states()))
        ends = []
        for sign in (1.0, -1.0):
            inputs = {n: sign * fmu.nominals[n] for n in fmu.names("input")}
            instance.derivatives(0.0, rest, inputs)
            ends.append(instance.vector("GetEventIndicators", count))
            if ends[-1].tobytes() != instance.get(names).tobytes():
                yield "the event indicators differ from the variables that repeat them"
        for name, (above, below) in zip(names, np.array(ends).T, strict=False):
            if not above * below < 0.0:
                yield f"'{name}' does not change its sign when the inputs turn"


def _numbers(fmu: Fmu, instance: Instance3) -> Iterator[str]:
    """Yield what the binary counts otherwise than the description."""
    if instance.number("GetNumberOfEventIndicators") != fmu.indicator_count():
        yield "the binary has another number of event indicators than the description"
    if instance.number("GetNumberOfContinuousStates") != len(fmu.states()):
        yield "the binary has another number of states than the description"
    if [u.variable.name for u in fmu.description.eventIndicators] != fmu.indicators():
        yield "the event indicators of the description are not the variables switch.*"


def wrong_indicators(fmu: Fmu, model: Model) -> Iterator[str]:
    """Each event indicator is a switch of the model or its negative, plus a small fixed margin."""
    s, generator = model.structure, np.random.default_rng(5)
    if fmu.indicators() != [f"switch.{name}" for name in s.switches]:
        yield f"the event indicators are not those of the model: {', '.join(s.switches) or 'none'}"
        return
    switches = ca.Function("z", s.arguments, [ca.vertcat(*s.switches.values())])
    found, truth = [], []
    with fmu.start(MODEL_EXCHANGE) as instance:
        for _ in range(_POINTS):
            point = random_point(fmu, generator)
            found.append(evaluate(instance, point, fmu.indicators()))
            groups = (model.state_names, model.input_names, model.parameter_names)
            vectors = [np.array([point[n] for n in names]) for names in groups]
            vectors += held_values(instance)
            truth.append(np.array(switches(point["time"], *vectors)).ravel())
    for name, z, switch in zip(fmu.indicators(), np.array(found).T, np.array(truth).T, strict=True):
        size = float(np.max(np.abs(switch)))
        margins = [z - switch, z + switch]
        if not any(np.ptp(m) <= _EXACT * size and abs(m[0]) <= _MARGIN * size for m in margins):
            yield f"'{name}' is not the switch of the model"


def _moving(fmu: Fmu) -> dict[str, float]:
    return {n: 0.7 * fmu.nominals[n] for n in fmu.names("input")}


def intermediate_update(fmu: Fmu) -> Iterator[str]:
    """FMI 3.0: times of updates increase to the end; a step ended early goes on to the same end."""
    size, names = 10.0 * fmu.step_size, [*fmu.names("output"), *fmu.states()]
    seen: list[Update] = []

    def watch(_: Instance3, update: Update) -> None:
        seen.append(update)

    def leave(_: Instance3, update: Update) -> float | None:
        return update.time if update.time > 0.3 * size and update.can_return_early else None

    with fmu.start3(CO_SIMULATION, tolerance=_TOLERANCE, watcher=watch) as instance:
        instance.set(_moving(fmu))
        instance.step(0.0, size)
        whole = instance.get(names)
    times = [u.time for u in seen]
    if not times or times != sorted(set(times)) or abs(times[-1] - size) > 1e-9 * size:
        yield "the times of the intermediate updates do not increase to the end of the step"
    with fmu.start3(CO_SIMULATION, tolerance=_TOLERANCE, watcher=leave) as instance:
        instance.set(_moving(fmu))
        done = instance.try_step(0.0, size)
        if not (done.early and 0.3 * size < done.time < size):
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
    return float(np.max(np.abs(a - b) / np.maximum(nominal, 1e-300)))


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
