"""Calling sequences of an FMU that must succeed, and what must come of them."""

import math
from collections.abc import Callable, Iterator

import numpy as np
import numpy.typing as npt

from psa_casadi.export.importer.fmu import CO_SIMULATION, MODEL_EXCHANGE, Fmu, FmuError, Instance

FloatArray = npt.NDArray[np.float64]
Problems = Iterator[str]


def _inputs(fmu: Fmu, share: float) -> dict[str, float]:
    """Return inputs of a share of their nominals, each a little smaller than the one before."""
    names = fmu.names("input")
    return {name: share * 0.9**i * fmu.nominals[name] for i, name in enumerate(names)}


def displaced(fmu: Fmu) -> dict[str, float]:
    """Return values of the states to start from that are not at rest: shares of their nominals."""
    names = [*fmu.states(), *fmu.sampled()]
    return {name: 0.5 * 0.9**i * fmu.nominals[name] for i, name in enumerate(names)}


def _run(
    instance: Instance, size: float, shares: tuple[float, ...], begin: float = 0.0
) -> FloatArray:
    """Step with inputs of some shares of their nominals; return outputs and states of each step."""
    fmu = instance.fmu
    rows = []
    for k, share in enumerate(shares):
        instance.set(_inputs(fmu, share))
        instance.step(begin + k * size, size)
        rows.append(instance.get([*fmu.names("output"), *fmu.states()]))
    return np.array(rows)


def _differ(a: FloatArray, b: FloatArray) -> bool:
    return a.tobytes() != b.tobytes()


def life_cycle(fmu: Fmu) -> Problems:
    """All interfaces: initialise, step or evaluate, terminate, reset, and the same again."""
    size = fmu.step_size
    results = []
    with fmu.start(CO_SIMULATION) as slave:
        for _ in range(2):
            results.append(_run(slave, size, (0.5, 1.0)))
            slave.require("Terminate")
            slave.require("Reset")
            slave.setup()
    if _differ(*results):
        yield "after a reset a co-simulation instance gives other results"
    if MODEL_EXCHANGE in fmu.interfaces():
        yield from _exchanged(fmu)


def _exchanged(fmu: Fmu) -> Problems:
    with fmu.start(MODEL_EXCHANGE) as model:
        names = fmu.states()
        x = np.array([0.1 * fmu.nominals[n] for n in names])
        slope = model.derivatives(0.5, x, _inputs(fmu, 1.0))
        if not np.all(np.isfinite(slope)):
            yield "the derivatives are not finite"
        if _differ(model.get([f"der({n})" for n in names]), slope):
            yield "the values of the variables der(x) differ from the derivatives"
        if any(model.completed_integrator_step()):
            yield "the end of an integrator step asks for an event or for the end"
        model.require("EnterEventMode")
        yield from needless_events(model)
        model.require("EnterContinuousTimeMode")
        model.require("Terminate")


def needless_events(instance: Instance) -> Problems:
    """An update in event mode asks for nothing but the next instant of sampled states."""
    *more, timed = instance.update_discrete_states()
    if any(more):
        yield "an event asks for more than going on"
    if timed != bool(instance.fmu.sampled()):
        yield "time events are announced without sampled states, or are not with them"


def communication_points(fmu: Fmu) -> Problems:
    """A step of zero size changes nothing; a point that differs by rounding is accepted."""
    size = fmu.step_size
    with fmu.start(CO_SIMULATION, start_time=0.1) as slave:
        before = _run(slave, size, (1.0, 0.5), 0.1)
        now = 0.1 + 2 * size
        slave.step(now, 0.0)
        if _differ(before[-1], slave.get([*fmu.names("output"), *fmu.states()])):
            yield "a step of zero size changes the result"
        for point in (math.nextafter(now, 1.0), math.nextafter(now + size, 0.0)):
            try:
                slave.step(point, size)
            except FmuError:
                yield "a communication point that differs by rounding is refused"


def independent_instances(fmu: Fmu) -> Problems:
    """Two instances stepped in turn give what each gives alone."""
    size, shares = fmu.step_size, ((0.2, 0.9, 0.4), (1.0, 0.1, 0.6))
    alone = []
    for own in shares:
        with fmu.start(CO_SIMULATION) as slave:
            alone.append(_run(slave, size, own))
    with fmu.start(CO_SIMULATION) as first, fmu.start(CO_SIMULATION) as second:
        for k in range(3):
            for slave, own, expected in zip((first, second), shares, alone, strict=True):
                row = _run(slave, size, own[k : k + 1], k * size)
                if _differ(row[0], expected[k]):
                    yield f"two instances disturb each other in step {k + 1}"


def parameter_changes(fmu: Fmu) -> Problems:
    """Parameters set before initialization, in it, and between steps count from then on.

    Where they do nothing to a run from the start values, it starts from displaced states; where
    they do nothing to that either, a change between steps may have no effect.
    """
    yield from _changes_at_a_point(fmu)
    for starts in ({}, displaced(fmu)):
        with fmu.start(CO_SIMULATION, values=starts) as slave:
            plain = _run(slave, fmu.step_size, (0.5, 1.0, 0.3))
        before = _run_changed(fmu, starts, 0)
        if _differ(before[-1], plain[-1]):
            break
    if _differ(before, _run_changed(fmu, starts, 1)):
        yield "parameters set before and after initialization give different results"
    during = _run_changed(fmu, starts, 2)
    acts = _differ(before[-1], plain[-1])
    if _differ(during[:2], plain[:2]) or _differ(during[-1], plain[-1]) != acts:
        yield "parameters set between steps have no effect, or one on the past"


def _changed(fmu: Fmu) -> dict[str, float]:
    """Return all tunable parameters, each 3 % from its start, to the side that its bounds allow."""
    with fmu.open(CO_SIMULATION) as slave:
        slave.setup()
        names = fmu.varying("tunable")
        changed, bounds = {}, fmu.bounds
        for name, value in zip(names, slave.get(names), strict=True):
            low, high = bounds[name]
            changed[name] = next(c for c in (1.03 * value, 0.97 * value, value) if low <= c <= high)
        return changed


def _run_changed(fmu: Fmu, starts: dict[str, float], when: int) -> FloatArray:
    """Return a run with parameters changed before (0) or after (1) initialization, or later (2)."""
    size, changed = fmu.step_size, _changed(fmu)
    with fmu.start(CO_SIMULATION, values=starts if when else {**starts, **changed}) as slave:
        if when == 2:
            during = _run(slave, size, (0.5, 1.0))
            slave.set(changed)
            return np.concatenate([during, _run(slave, size, (0.3,), 2 * size)])
        if when:
            slave.set(changed)
        return _run(slave, size, (0.5, 1.0, 0.3))


def _changes_at_a_point(fmu: Fmu) -> Problems:
    """Model exchange: parameters that move the derivatives do so however they were set."""
    changed, inputs = _changed(fmu), _inputs(fmu, 0.7)
    x = np.array([0.1 * fmu.nominals[n] for n in fmu.states()])
    with fmu.start(MODEL_EXCHANGE) as model, fmu.start(MODEL_EXCHANGE, values=changed) as other:
        model.derivatives(0.0, x, inputs)
        model.set(changed)
        slope = model.derivatives(0.0, x, inputs)
        if _differ(slope, other.derivatives(0.0, x, inputs)):
            yield "parameters set in continuous-time mode do not reach the derivatives"


def snapshots(fmu: Fmu) -> Problems:
    """A state taken, serialised, read back or restored replays the same bits; damage is noticed."""
    size, shares = fmu.step_size, (0.9, 0.1, 0.7)
    with fmu.start(CO_SIMULATION) as slave:
        _run(slave, size, (0.5, 1.0))
        snapshot = slave.save()
        data = slave.serialize(snapshot)
        first = _run(slave, size, shares, 2 * size)
        slave.restore(snapshot)
        if _differ(first, _run(slave, size, shares, 2 * size)):
            yield "a restored state does not replay the same bits"
        slave.drop(snapshot)
        with fmu.open(CO_SIMULATION) as other:
            copy = other.deserialize(data)
            if other.serialize(copy) != data:
                yield "a state read back from bytes is serialised to other bytes"
            other.restore(copy)
            other.drop(copy)
            if _differ(first, _run(other, size, shares, 2 * size)):
                yield "a state moved to another instance does not replay the same bits"
        for wrong, what in _damaged(data):
            try:
                slave.drop(slave.deserialize(wrong))
            except FmuError:
                continue
            yield f"a {what} serialised state is accepted"


def _damaged(data: bytes) -> Iterator[tuple[bytes, str]]:
    """Yield serialised states with something wrong, and what."""
    damaged = ((len(data) * share // 16, "damaged") for share in range(4, 16))
    for place, what in ((0, "foreign"), *damaged):
        yield data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :], what
    yield data[:-1], "truncated"
    yield data[:8], "truncated"
    yield data + b"\0", "lengthened"


#: The checks by the name of their row.
CALLS: dict[str, Callable[[Fmu], Problems]] = {
    "life cycle": life_cycle,
    "communication points": communication_points,
    "independent instances": independent_instances,
    "parameter changes": parameter_changes,
    "snapshots": snapshots,
}
