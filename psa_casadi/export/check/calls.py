"""Calling sequences of an FMU that must succeed, and what must come of them."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from functools import partial

import numpy as np

from psa_casadi.common.units import FloatArray
from psa_casadi.export.importer.fmu import CO_SIMULATION, MODEL_EXCHANGE, Fmu, FmuError, Instance

Problems = Iterator[str]


def _inputs(fmu: Fmu, share: float) -> dict[str, float]:
    """Return inputs of a share of their nominals, each a little smaller than the one before."""
    names = fmu.names("input")
    return {name: share * 0.9**i * fmu.nominals[name] for i, name in enumerate(names)}


def _run(
    instance: Instance, size: float, shares: Sequence[float], begin: float = 0.0
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
        if any(model.fmi.completedIntegratorStep()):
            yield "the end of an integrator step asks for an event or for the end"
        model.require("EnterEventMode")
        *more, timed = model.update_discrete_states()
        if any(more):
            yield "an event asks for more than going on"
        if timed != bool(fmu.sampled()):
            yield "time events are announced without sampled states, or are not with them"
        model.require("EnterContinuousTimeMode")
        model.require("Terminate")


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
    start, shares = partial(fmu.start, CO_SIMULATION), ((0.2, 0.9, 0.4), (1.0, 0.1, 0.6))
    for k, alone, row in taken_in_turn(start, _run, fmu.step_size, shares):
        if _differ(alone, row):
            yield f"two instances disturb each other in step {k}"


def taken_in_turn(
    start: Callable[[], AbstractContextManager[Instance]],
    run: Callable[[Instance, float, Sequence[float], float], FloatArray],
    size: float,
    shares: Sequence[Sequence[float]],
) -> Iterator[tuple[int, FloatArray, FloatArray]]:
    """Yield the number of each step of two instances in turn, its results alone and in turn.

    `run` takes an instance through steps of a `size` [s], an input share each, from a time on.
    """
    alone = []
    for listed in shares:
        with start() as instance:
            alone.append(run(instance, size, listed, 0.0))
    with start() as first, start() as second:
        for k in range(len(shares[0])):
            for instance, listed, rows in zip((first, second), shares, alone, strict=True):
                yield k + 1, rows[k], run(instance, size, listed[k : k + 1], k * size)[0]


def parameter_changes(fmu: Fmu) -> Problems:
    """Parameters set before initialization, in it, and between steps count from then on.

    The states start displaced, where parameters do most; where a change before the run does nothing
    to its end, one between steps may do nothing either.
    """
    names = [*fmu.states(), *fmu.sampled()]
    starts = {name: 0.5 * 0.9**i * fmu.nominals[name] for i, name in enumerate(names)}
    changed = {}  # each 3 % from its start, to the side that its bounds allow
    for v in fmu.description.modelVariables:
        if v.variability == "tunable":
            value, (low, high) = float(v.start), fmu.bounds[v.name]
            near = (1.03 * value, 0.97 * value, value)
            changed[v.name] = next(c for c in near if low <= c <= high)
    size, shares = fmu.step_size, (0.5, 1.0, 0.3)
    with fmu.start(CO_SIMULATION, values=starts) as slave:
        plain = _run(slave, size, shares)
    with fmu.start(CO_SIMULATION, values={**starts, **changed}) as slave:
        before = _run(slave, size, shares)
    with fmu.start(CO_SIMULATION, values=starts) as slave:
        slave.set(changed)
        after = _run(slave, size, shares)
    with fmu.start(CO_SIMULATION, values=starts) as slave:
        past = _run(slave, size, shares[:2])
        slave.set(changed)
        future = _run(slave, size, shares[2:], 2 * size)
    if _differ(before, after):
        yield "parameters set before and after initialization give different results"
    acts = _differ(before[-1], plain[-1])
    if _differ(past, plain[:2]) or _differ(future[-1], plain[-1]) != acts:
        yield "parameters set between steps have no effect, or one on the past"
    x, inputs = np.array([0.1 * fmu.nominals[n] for n in fmu.states()]), _inputs(fmu, 0.7)
    with fmu.start(MODEL_EXCHANGE) as model, fmu.start(MODEL_EXCHANGE, values=changed) as other:
        model.derivatives(0.0, x, inputs)
        model.set(changed)
        if _differ(model.derivatives(0.0, x, inputs), other.derivatives(0.0, x, inputs)):
            yield "parameters set in continuous-time mode do not reach the derivatives"


def snapshots(fmu: Fmu) -> Problems:
    """A state taken, serialised, read back or restored replays the same bits; damage is noticed."""
    size, shares = fmu.step_size, (0.9, 0.1, 0.7)
    with fmu.start(CO_SIMULATION) as slave:
        _run(slave, size, (0.5, 1.0))
        snapshot = slave.fmi.getFMUState()
        data = slave.fmi.serializeFMUState(snapshot)
        first = _run(slave, size, shares, 2 * size)
        slave.fmi.setFMUState(snapshot)
        if _differ(first, _run(slave, size, shares, 2 * size)):
            yield "a restored state does not replay the same bits"
        slave.fmi.freeFMUState(snapshot)
        with fmu.open(CO_SIMULATION) as other:
            copy = other.fmi.deserializeFMUState(data)
            if other.fmi.serializeFMUState(copy) != data:
                yield "a state read back from bytes is serialised to other bytes"
            other.fmi.setFMUState(copy)
            other.fmi.freeFMUState(copy)
            if _differ(first, _run(other, size, shares, 2 * size)):
                yield "a state moved to another instance does not replay the same bits"
        flipped = ((len(data) * share // 16, "damaged") for share in range(4, 16))
        wrongs = [
            (data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :], what)
            for place, what in ((0, "foreign"), *flipped)
        ]
        wrongs += [(data[:-1], "truncated"), (data[:8], "truncated"), (data + b"\0", "lengthened")]
        for wrong, what in wrongs:
            try:
                slave.fmi.freeFMUState(slave.fmi.deserializeFMUState(wrong))
            except FmuError:
                continue
            yield f"a {what} serialised state is accepted"


#: The checks by the name of their row.
CALLS: dict[str, Callable[[Fmu], Problems]] = {
    "life cycle": life_cycle,
    "communication points": communication_points,
    "independent instances": independent_instances,
    "parameter changes": parameter_changes,
    "snapshots": snapshots,
}
