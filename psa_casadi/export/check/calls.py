"""Calling sequences of an FMU that must succeed, and what must come of them.

The first ones are for FMUs of any tool, the others for those of this package.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import chain

import numpy as np

from psa_casadi.common.units import FloatArray
from psa_casadi.export.check.rows import Findings, Remark
from psa_casadi.export.importer.fmu import CO_SIMULATION, MODEL_EXCHANGE, Fmu, FmuError, Instance

#: Internal steps in one step, at most.
_MOST_INTERNAL = 100
#: Inputs of a run, by step, as shares of their nominal values from their starts.
SHARES = (0.0, 0.1, 0.1, -0.1, 0.05)
#: Interfaces by the words of rows.
WORDS = {CO_SIMULATION: "co-simulation", MODEL_EXCHANGE: "model exchange"}


def step_of(fmu: Fmu) -> float:
    """Return a step that the FMU takes: its default one, as a multiple of its internal one."""
    internal = fmu.internal_step
    span = fmu.experiment("stopTime") - fmu.experiment("startTime")
    size = fmu.experiment("stepSize") or span / 100 or 0.01
    return max(1, min(_MOST_INTERNAL, round(size / internal))) * internal if internal else size


def moved_inputs(fmu: Fmu, share: float) -> dict[str, float]:
    """Return inputs at their starts, those that are real moved by a share of their nominals."""
    return {
        name: float(np.clip(e.start + share * fmu.nominals[name] * e.real, *fmu.bounds[name]))
        for name, e in fmu.elements.items()
        if fmu.variables[e.variable].causality == "input"
    }


def continuous_inputs(fmu: Fmu) -> dict[str, float]:
    """Return moved inputs, those that may move between events."""

    def moves(name: str) -> bool:
        e = fmu.elements[name]
        return e.real and fmu.variables[e.variable].variability != "discrete"

    return {n: v for n, v in moved_inputs(fmu, 0.1).items() if moves(n)}


def results(instance: Instance) -> FloatArray:
    """Return the outputs and local variables."""
    fmu, kinds = instance.fmu, ("output", "local")
    names = [n for n, e in fmu.elements.items() if fmu.variables[e.variable].causality in kinds]
    return instance.get(names)


def stepped(
    instance: Instance, size: float, shares: Sequence[float], now: float = 0.0
) -> FloatArray:
    """Step with moved inputs from a time on; return the results of each step."""
    rows = []
    for share in shares:
        instance.set(moved_inputs(instance.fmu, share))
        instance.step(now, size)
        now += size
        rows.append(results(instance))
    return np.array(rows)


def run_of(instance: Instance, shares: Sequence[float] = SHARES, now: float = 0.0) -> FloatArray:
    """Return the results of steps, or rates and results at the first states with moved inputs."""
    fmu = instance.fmu
    if instance.interface == CO_SIMULATION:
        return stepped(instance, step_of(fmu), shares, now)
    rates, count = np.zeros(0), len(fmu.state_elements)
    if count:
        x = instance.vector("GetContinuousStates", count)
        rates = instance.derivatives(0.0, x, continuous_inputs(fmu))
    return np.concatenate([rates, results(instance)])


def initialise(instance: Instance) -> None:
    """Make an instance ready for a run, its initial events done."""
    instance.setup()
    if instance.interface == MODEL_EXCHANGE:
        instance.leave_event_mode()


@contextmanager
def ready(fmu: Fmu, interface: int) -> Iterator[Instance]:
    """Yield an instance that is ready for a run; free it afterwards."""
    with fmu.open(interface) as instance:
        initialise(instance)
        yield instance


def difference(a: FloatArray, b: FloatArray) -> float:
    """Return by which share of its size one result is off another; 0 for the same bits."""
    if a.tobytes() == b.tobytes():
        return 0.0
    size = np.maximum(np.max(np.abs(a), axis=0, initial=0.0), 1e-300)
    off = float(np.max(np.abs(a - b) / size, initial=0.0))
    return max(off, 1e-16)


def life_cycle(fmu: Fmu) -> Findings:
    """Initialise, run, terminate, reset, and the same again."""
    for interface in fmu.interfaces():
        with ready(fmu, interface) as instance:
            first = run_of(instance)
            instance.require("Terminate")
            instance.require("Reset")
            initialise(instance)
            if off := difference(first, run_of(instance)):
                yield f"{WORDS[interface]}: after a reset it gives other results ({off:.2g} off)"


def several_instances(fmu: Fmu, rounding: float = 0.0) -> Findings:
    """Two instances in turn give what each gives alone, where several are allowed."""
    for interface in fmu.interfaces():
        if fmu.kind(interface).canBeInstantiatedOnlyOncePerProcess:
            yield Remark(f"{WORDS[interface]}: one instance for each process")
        elif interface == CO_SIMULATION:
            size, alone = step_of(fmu), []
            for shares in (SHARES, SHARES[::-1]):
                with ready(fmu, interface) as instance:
                    alone.append(stepped(instance, size, shares))
            with ready(fmu, interface) as first, ready(fmu, interface) as second:
                for k in range(len(SHARES)):
                    row = stepped(first, size, SHARES[k : k + 1], k * size)[0]
                    other = stepped(second, size, SHARES[::-1][k : k + 1], k * size)[0]
                    offs = difference(alone[0][k], row), difference(alone[1][k], other)
                    if max(offs) > rounding:
                        yield f"two instances disturb each other in step {k + 1}"
                        break


def saved_states(fmu: Fmu) -> Findings:
    """A state that is saved in a run and restored replays the same, also by way of bytes."""
    for interface in fmu.interfaces():
        if not fmu.kind(interface).canGetAndSetFMUstate:  # fmpy's name in FMI 3.0, too
            yield Remark(f"{WORDS[interface]}: it announces no way to save its state")
            continue
        with ready(fmu, interface) as instance:
            run_of(instance, SHARES[:2])
            rest = partial(run_of, instance, SHARES[2:], 2 * step_of(fmu))
            ways = {"restored": instance.fmi.getFMUState()}
            first = rest()
            if getattr(fmu.kind(interface), "canSerializeFMUstate", False):
                data = instance.fmi.serializeFMUState(ways["restored"])
                ways["read back from bytes"] = instance.fmi.deserializeFMUState(data)
            for words, snapshot in ways.items():
                instance.fmi.setFMUState(snapshot)
                if off := difference(first, rest()):
                    yield f"{WORDS[interface]}: a state that is {words} replays {off:.2g} off"
            for snapshot in ways.values():
                instance.fmi.freeFMUState(snapshot)


def derivative_calls(fmu: Fmu) -> Findings:
    """Model exchange has finite rates, equal to der(x), and events that ask for nothing."""
    if MODEL_EXCHANGE not in fmu.interfaces():
        return
    with fmu.start(MODEL_EXCHANGE) as model:
        names = fmu.states()
        x = np.array([0.1 * fmu.nominals[n] for n in names])
        slope = model.derivatives(0.5, x, moved_inputs(fmu, 1.0))
        if not np.all(np.isfinite(slope)):
            yield "the derivatives are not finite"
        if difference(model.get([f"der({n})" for n in names]), slope):
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


def communication_points(fmu: Fmu) -> Findings:
    """A step of zero size changes nothing; a point that differs by rounding is accepted."""
    size = step_of(fmu)
    with fmu.start(CO_SIMULATION, start_time=0.1) as slave:
        before = stepped(slave, size, (1.0, 0.5), 0.1)
        now = 0.1 + 2 * size
        slave.step(now, 0.0)
        if difference(before[-1], results(slave)):
            yield "a step of zero size changes the result"
        for point in (math.nextafter(now, 1.0), math.nextafter(now + size, 0.0)):
            try:
                slave.step(point, size)
            except FmuError:
                yield "a communication point that differs by rounding is refused"


def parameter_changes(fmu: Fmu) -> Findings:
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
    size, shares = step_of(fmu), (0.5, 1.0, 0.3)

    def run(values: dict[str, float], count: int) -> FloatArray:
        """Return the results with values from the start, and changed ones from a step on."""
        with fmu.start(CO_SIMULATION, values=values) as slave:
            past = [stepped(slave, size, shares[:count])] if count else []
            slave.set(changed)
            return np.concatenate([*past, stepped(slave, size, shares[count:], count * size)])

    with fmu.start(CO_SIMULATION, values=starts) as slave:
        plain = stepped(slave, size, shares)
    with fmu.start(CO_SIMULATION, values={**starts, **changed}) as slave:
        before = stepped(slave, size, shares)
    if difference(before, run(starts, 0)):
        yield "parameters set before and after initialization give different results"
    between, acts = run(starts, 2), difference(before[-1], plain[-1]) > 0
    if difference(between[:2], plain[:2]) or (difference(between[-1], plain[-1]) > 0) != acts:
        yield "parameters set between steps have no effect, or one on the past"
    x, inputs = np.array([0.1 * fmu.nominals[n] for n in fmu.states()]), moved_inputs(fmu, 0.7)
    with fmu.start(MODEL_EXCHANGE) as model, fmu.start(MODEL_EXCHANGE, values=changed) as other:
        model.derivatives(0.0, x, inputs)
        model.set(changed)
        if difference(model.derivatives(0.0, x, inputs), other.derivatives(0.0, x, inputs)):
            yield "parameters set in continuous-time mode do not reach the derivatives"


def moved_states(fmu: Fmu) -> Findings:
    """A state replays the same bits in another instance; damage of its bytes is noticed."""
    size, shares = step_of(fmu), (0.9, 0.1, 0.7)
    with fmu.start(CO_SIMULATION) as slave:
        stepped(slave, size, (0.5, 1.0))
        snapshot = slave.fmi.getFMUState()
        data = slave.fmi.serializeFMUState(snapshot)
        slave.fmi.freeFMUState(snapshot)
        first = stepped(slave, size, shares, 2 * size)
        with fmu.open(CO_SIMULATION) as other:
            copy = other.fmi.deserializeFMUState(data)
            if other.fmi.serializeFMUState(copy) != data:
                yield "a state read back from bytes is serialised to other bytes"
            other.fmi.setFMUState(copy)
            other.fmi.freeFMUState(copy)
            if difference(first, stepped(other, size, shares, 2 * size)):
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


#: The checks of an FMU of this package by the name of their row.
CALLS: dict[str, Callable[[Fmu], Findings]] = {
    "life cycle": lambda fmu: chain(life_cycle(fmu), derivative_calls(fmu)),
    "communication points": communication_points,
    "independent instances": several_instances,
    "parameter changes": parameter_changes,
    "snapshots": lambda fmu: chain(saved_states(fmu), moved_states(fmu)),
}
