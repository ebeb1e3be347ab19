"""What a buyer wants to know of an FMU of any tool, each with the clause of the standard.

Only a violation of the standard fails; what it allows and one should know is a note. Clauses are
those of FMI 2.0.5 and FMI 3.0.2.
"""

import gc
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from psa_casadi.export.check.rows import BREAKDOWNS, Check, CheckRow, plain
from psa_casadi.export.importer.archive import Archive
from psa_casadi.export.importer.fmu import CO_SIMULATION, MODEL_EXCHANGE, Fmu, FmuError, Instance
from psa_casadi.processes import memory_of_process
from psa_casadi.units import FloatArray

#: Internal steps in one step, at most.
_MOST_OWN = 100
#: Steps of a run, cycles of making and freeing an instance, and how long these may take [s].
_STEPS, _CYCLES, _PATIENCE = 5, 1000, 20.0
#: Cycles before memory is looked at, and bytes that a cycle may leave: an importer in Python leaves
#: some 300.
_WARM, _LEFT = 100, 1024.0
#: Relative step of a difference, and how far a derivative may be from it.
_DIFFERENCE, _SLOPE = 1e-5, 1e-3
#: Two runs that differ by this share are not the same, but for rounding.
_ROUNDING = 1e-9
#: Interfaces by the words of rows.
_WORDS = {CO_SIMULATION: "co-simulation", MODEL_EXCHANGE: "model exchange"}
#: Clause of each row in FMI 2.0.5 and in FMI 3.0.2.
_CLAUSES: dict[str, tuple[str, str]] = {
    "description valid": ("2.2", "2.4"),
    "units defined": ("2.2.2", "2.4.3"),
    "binary loads": ("2.1.1", "2.2.2"),
    "instances": ("2.1.5", "2.3.1"),
    "life cycle": ("2.1.6", "2.3.1"),
    "same bits again": ("2.1.6", "2.3.1"),
    "several instances": ("4.3.1, 3.3.1", "2.4.2"),
    "memory": ("2.1.5", "2.3.1"),
    "state saved": ("2.1.8", "2.2.7.4"),
    "derivatives": ("2.1.9", "2.2.12.1"),
    "start values": ("2.2.7", "2.4.7.5"),
    "values are taken": ("2.1.7", "2.2.7.2"),
    "dependencies": ("2.2.8", "2.4.8"),
    "inputs at events": ("3.2.2", "2.3.5"),
    "step sizes": ("4.2.2", "4.2.1"),
    "finite": ("2.1.3", "2.2.4"),
    "speed": ("-", "-"),
}


@dataclass
class _Found:
    """What a check of an FMU finds: violations, notes, a figure."""

    failures: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    figure: float | None = None
    limit: float = 0.0

    def row(self, name: str, version: int) -> CheckRow:
        """Return the row of a check."""
        figure = float(len(self.failures)) if self.figure is None else self.figure
        passed = not self.failures and (self.limit <= 0.0 or figure <= self.limit)
        remark = plain("; ".join([*self.failures, *self.notes]))
        clause = f"FMI {version}.0, {_CLAUSES[name][version - 2]}"
        return CheckRow(
            name, figure, self.limit, passed, remark, "" if clause.endswith("-") else clause,
            noted=passed and bool(self.notes),
        )  # fmt: skip


_Look = Callable[[Fmu, _Found], None]


def described(archive: Archive, invalid: Callable[[Archive], Iterator[str]]) -> Iterator[Check]:
    """Yield what is seen without running the FMU; `invalid` lists what its description violates."""
    version = archive.version

    def valid() -> CheckRow:
        return _Found(failures=list(invalid(archive))).row("description valid", version)

    def units() -> CheckRow:
        result, statement = _Found(), archive.description
        known = {u.name for u in statement.unitDefinitions}
        table = {v.name: v.unit for v in statement.modelVariables if v.unit}
        wrong = sorted({u for u in table.values() if u not in known})
        result.failures += [f"the unit '{u}' is not defined" for u in wrong]
        without = [n for n, e in archive.elements.items() if e.real and e.variable not in table]
        if without:
            result.notes.append(f"{len(without)} of {len(archive.elements)} numbers have no unit")
        return result.row("units defined", version)

    yield Check("description valid", valid)
    yield Check("units defined", units)


def foreign_checks(fmu_of: Callable[[], Fmu], archive: Archive) -> Iterator[Check]:
    """Yield the checks that run the code of an FMU, each to be made before the next is taken."""
    version, loaded = archive.version, list[Fmu]()

    def load() -> CheckRow:
        result = _Found()
        try:
            fmu = fmu_of()
            for interface in fmu.interfaces():
                fmu.loaded(interface)
            loaded.append(fmu)
        except BREAKDOWNS as error:
            folders = {p.parent.name for p in archive.binaries()}
            result.failures.append(f"{error} (it has {', '.join(sorted(folders)) or 'none'})")
        return result.row("binary loads", version)

    yield Check("binary loads", load)
    for fmu in loaded:
        for name, look in _LOOKS.items():
            yield Check(name, partial(_looked, fmu, name, look))


def _looked(fmu: Fmu, name: str, look: _Look) -> CheckRow:
    result = _Found()
    try:
        look(fmu, result)
    except BREAKDOWNS as error:
        result.failures.append(str(error))
    return result.row(name, fmu.version)


def _step(fmu: Fmu) -> float:
    """Return a step that the FMU takes: of its default experiment, a multiple of its own."""
    statement, co = fmu.description.defaultExperiment, fmu.description.coSimulation
    item = float(getattr(co, "fixedInternalStepSize", None) or 0.0)
    start, stop = (float(getattr(statement, n, None) or 0.0) for n in ("startTime", "stopTime"))
    output = float(getattr(statement, "stepSize", None) or 0.0) or (stop - start) / 100 or 0.01
    return max(1, min(_MOST_OWN, round(output / item))) * item if item else output


def _inputs(fmu: Fmu, share: float) -> dict[str, float]:
    """Return inputs at their starts, those that are real moved by a share of their nominals."""
    table = {}
    for name, e in fmu.elements.items():
        v = fmu.variables[e.variable]
        if v.causality == "input":
            low, high = fmu.bounds[e.variable]
            moved = e.starts[e.place] + share * fmu.nominals[e.variable] * e.real
            table[name] = float(np.clip(moved, low, high))
    return table


def _states(fmu: Fmu) -> list[str]:
    """Return the continuous states, each element of an array."""
    names = set(fmu.states())
    return [n for n, e in fmu.elements.items() if e.variable in names]


def _nominals(fmu: Fmu, names: Sequence[str]) -> FloatArray:
    return np.array([fmu.nominals[fmu.elements[n].variable] for n in names])


def _told(fmu: Fmu) -> list[str]:
    """Return the outputs and rates of the model structure that are scalar real numbers."""
    listed = (*fmu.description.outputs, *fmu.description.derivatives)
    names = [str(u.variable.name) for u in listed]
    return [n for n in names if n in fmu.elements and fmu.elements[n].real]


def _shown(fmu: Fmu) -> list[str]:
    kinds = ("output", "local")
    return [n for n, e in fmu.elements.items() if fmu.variables[e.variable].causality in kinds]


def _stepped(instance: Instance, size: float, shares: Sequence[float]) -> FloatArray:
    """Step with moved inputs; return what is shown after each step."""
    rows, now = [], 0.0
    for share in shares:
        instance.set(_inputs(instance.fmu, share))
        instance.step(now, size)
        now += size
        rows.append(instance.get(_shown(instance.fmu)))
    return np.array(rows)


def _evaluated(instance: Instance, share: float = 0.1) -> FloatArray:
    """Return the rates and what is shown at the first states, with moved inputs."""
    fmu = instance.fmu
    count = len(_states(fmu))
    x = instance.vector("GetContinuousStates", count) if count else np.zeros(0)
    if count:
        rates = instance.derivatives(0.0, x, _continuous(fmu, share))
        return np.concatenate([rates, instance.get(_shown(fmu))])
    return instance.get(_shown(fmu))


def _continuous(fmu: Fmu, share: float) -> dict[str, float]:
    """Return the inputs that may move between events."""
    moved = _inputs(fmu, share)
    kept = [n for n in moved if fmu.variables[fmu.elements[n].variable].variability != "discrete"]
    return {n: moved[n] for n in kept if fmu.elements[n].real}


_SHARES = (0.0, 0.1, 0.1, -0.1, 0.05)


def _run(instance: Instance) -> FloatArray:
    if instance.interface == CO_SIMULATION:
        return _stepped(instance, _step(instance.fmu), _SHARES)
    return _evaluated(instance)


def _begun(fmu: Fmu, interface: int) -> Instance:
    """Return an instance that is ready for a run, its initial events done."""
    instance = fmu.open(interface)
    try:
        instance.setup()
        _continue(instance)
    except BaseException:
        instance.free()
        raise
    return instance


def _continue(instance: Instance) -> None:
    if instance.interface == MODEL_EXCHANGE:
        instance.leave_event_mode()


def _instances(fmu: Fmu, result: _Found) -> None:
    """Every interface that the description announces gives an instance."""
    for interface in fmu.interfaces():
        try:
            fmu.open(interface).free()
        except FmuError as error:
            result.failures.append(f"{_WORDS[interface]}: {error}")


def _life_cycle(fmu: Fmu, result: _Found) -> None:
    """Initialise, run, terminate, reset, and the same again."""
    for interface in fmu.interfaces():
        with _begun(fmu, interface) as instance:
            first = _run(instance)
            instance.require("Terminate")
            instance.require("Reset")
            instance.setup()
            _continue(instance)
            if off := _off(first, _run(instance)):
                result.failures.append(
                    f"{_WORDS[interface]}: after a reset it gives other results ({off:.2g} off)"
                )


def _off(a: FloatArray, b: FloatArray) -> float:
    """Return by which share of its size one result is off another; 0 for the same bits."""
    if a.tobytes() == b.tobytes():
        return 0.0
    size = np.maximum(np.max(np.abs(a), axis=0, initial=0.0), 1e-300)
    off = float(np.max(np.abs(a - b) / size, initial=0.0))
    return max(off, 1e-16)


def _same_bits(fmu: Fmu, result: _Found) -> None:
    """A second instance gives the same bits."""
    for interface in fmu.interfaces():
        runs = []
        for _ in range(2):
            with _begun(fmu, interface) as instance:
                runs.append(_run(instance))
        if off := _off(*runs):
            result.notes.append(
                f"{_WORDS[interface]}: a second instance is {off:.2g} off the first"
            )


def _several(fmu: Fmu, result: _Found) -> None:
    """Two instances in turn give what each gives alone, where several are allowed."""
    for interface in fmu.interfaces():
        kind = (fmu.description.modelExchange, fmu.description.coSimulation)[interface]
        if kind.canBeInstantiatedOnlyOncePerProcess:
            result.notes.append(f"{_WORDS[interface]}: one instance for each process")
        elif interface == CO_SIMULATION:
            size, (a, b) = _step(fmu), (_SHARES, _SHARES[::-1])
            alone = []
            for item in (a, b):
                with _begun(fmu, interface) as instance:
                    alone.append(_stepped(instance, size, item))
            with _begun(fmu, interface) as first, _begun(fmu, interface) as second:
                for k in range(len(a)):
                    for instance, item, expected in ((first, a, alone[0]), (second, b, alone[1])):
                        instance.set(_inputs(fmu, item[k]))
                        instance.step(k * size, size)
                        off = _off(expected[k], instance.get(_shown(fmu)))
                        if off > _ROUNDING:
                            result.failures.append(
                                f"two instances disturb each other in step {k + 1}"
                            )
                            return


def _memory(fmu: Fmu, result: _Found) -> None:
    """An instance that is freed leaves nothing behind."""
    interface, end = fmu.interfaces()[0], time.monotonic() + _PATIENCE
    before, count = 0, 0
    for count in range(1, _CYCLES + 1):
        with _begun(fmu, interface) as instance:
            _run(instance)
        if count == _WARM:
            before = _resident()
        if time.monotonic() > end and count > _WARM:
            break
    left = max(0.0, float(_resident() - before)) / max(1, count - _WARM)
    if not before:
        result.notes.append("this system does not tell the memory of a process")
        return
    result.figure, result.limit = left, _LEFT
    text = f"{left:.0f} bytes left by each of {count} cycles"
    (result.failures if left > _LEFT else result.notes if count < _CYCLES else []).append(text)


def _resident() -> int:
    """Return the memory of this process that counts [bytes], 0 where the system does not tell."""
    gc.collect()
    return memory_of_process("RssAnon")


def _state(fmu: Fmu, result: _Found) -> None:
    """A state that is saved and restored replays the same, also by way of bytes."""
    for interface in fmu.interfaces():
        kind = (fmu.description.modelExchange, fmu.description.coSimulation)[interface]
        if not kind.canGetAndSetFMUstate:  # fmpy's name in FMI 3.0, too
            result.notes.append(f"{_WORDS[interface]}: it announces no way to save its state")
            continue
        with _begun(fmu, interface) as instance:
            ways = [instance.save()]
            first = _run(instance)
            if any(
                getattr(kind, n, False) for n in ("canSerializeFMUstate", "canSerializeFMUState")
            ):
                ways.append(instance.deserialize(instance.serialize(ways[0])))
            for way, words in zip(ways, ("restored", "read back from bytes"), strict=False):
                instance.restore(way)
                if off := _off(first, _run(instance)):
                    result.failures.append(
                        f"{_WORDS[interface]}: a state that is {words} replays {off:.2g} off"
                    )
            for way in ways:
                instance.drop(way)


def _derivatives(fmu: Fmu, result: _Found) -> None:
    """Directional derivatives of model exchange are those of differences, at two step sizes."""
    exchange = fmu.description.modelExchange
    if exchange is None or not exchange.providesDirectionalDerivative:
        result.notes.append("it provides none")
        return
    states = _states(fmu)
    unknowns = [n for n in _told(fmu) if n not in states]
    if any(fmu.elements[n].count > 1 for n in [*unknowns, *states]):
        result.notes.append("not looked at: arrays")
        return
    with _begun(fmu, MODEL_EXCHANGE) as instance:
        x, inputs = instance.vector("GetContinuousStates", len(states)), _continuous(fmu, 0.1)
        x = x + 0.1 * _nominals(fmu, states)
        knowns = [*states, *inputs]
        seed = _nominals(fmu, knowns)

        def at(way: float) -> FloatArray:
            moved = [inputs[n] + way * s for n, s in zip(inputs, seed[len(x) :], strict=True)]
            instance.derivatives(
                0.0, x + way * seed[: len(x)], dict(zip(inputs, moved, strict=True))
            )
            return instance.get(unknowns)

        off = []
        for h in (_DIFFERENCE, 10 * _DIFFERENCE):
            slopes, here = (at(h) - at(-h)) / (2 * h), at(0.0)
            values = instance.directional(unknowns, knowns, seed)
            off.append(np.abs(slopes - values) / (np.abs(values) + np.abs(here) + 1e-300))
    worst = np.minimum(*off)
    result.figure, result.limit = float(np.max(worst, initial=0.0)), _SLOPE
    for name, one in zip(unknowns, worst, strict=True):
        if one > _SLOPE:
            result.failures.append(f"that of '{name}' is {one:.2g} off a difference")


def _settable(fmu: Fmu) -> dict[str, float]:
    """Return the start values of parameters, inputs and variables that start exactly there."""
    table = {}
    for name, e in fmu.elements.items():
        v = fmu.variables[e.variable]
        statement = (
            v.start is not None and v.causality != "independent" and v.variability != "constant"
        )
        exact = v.initial == "exact" or v.causality in ("parameter", "input")
        if statement and exact and v.causality != "structuralParameter":
            table[name] = e.starts[e.place]
    return table


def _start_values(fmu: Fmu, result: _Found) -> None:
    """What is read after initialization is what the description says, where nothing was set."""
    starts = _settable(fmu)
    if not starts:
        return
    with fmu.open(fmu.interfaces()[0]) as instance:
        instance.setup()
        read = instance.get(list(starts))
    for (name, statement), value in zip(starts.items(), read, strict=True):
        if abs(value - statement) > 1e-6 * max(abs(statement), abs(value)):
            result.failures.append(
                f"'{name}' starts at {value:.6g}, its description says {statement:.6g}"
            )


def _taken(fmu: Fmu, result: _Found) -> None:
    """A start value that is set before initialization is the value after it."""
    moved = {}
    for name, start in _settable(fmu).items():
        e = fmu.elements[name]
        low, high = fmu.bounds[e.variable]
        new = start + 0.01 * (abs(start) or fmu.nominals[e.variable])
        if e.real and fmu.variables[e.variable].variability != "fixed" and low <= new <= high:
            moved[name] = new
    if not moved:
        result.notes.append("nothing can be set")
        return
    with fmu.open(fmu.interfaces()[0]) as instance:
        instance.setup(values=moved)
        read = instance.get(list(moved))
    for (name, new), value in zip(moved.items(), read, strict=True):
        if abs(value - new) > 1e-6 * max(abs(new), abs(value)):
            result.failures.append(f"'{name}' was set to {new:.6g} and is {value:.6g}")


def _dependencies(fmu: Fmu, result: _Found) -> None:
    """What moves an output or a rate is among the dependencies that are told of it."""
    states, real = _states(fmu), set(_told(fmu))
    table = {
        str(e.variable.name): {str(d.name) for d in e.dependencies}
        for e in (*fmu.description.outputs, *fmu.description.derivatives)
        if e.dependencies is not None and e.variable.name in real - {*states}
    }
    if fmu.description.modelExchange is None or not table:
        result.notes.append("none are told, or there is no model exchange to see them by")
        return
    with _begun(fmu, MODEL_EXCHANGE) as instance:
        x, inputs = instance.vector("GetContinuousStates", len(states)), _continuous(fmu, 0.1)
        x = x + 0.1 * _nominals(fmu, states)
        names = list(table)

        def at(states_now: FloatArray, inputs_now: dict[str, float]) -> FloatArray:
            instance.derivatives(0.0, states_now, inputs_now)
            return instance.get(names)

        here = at(x, inputs)
        moves: list[tuple[str, FloatArray]] = []
        for name, move in zip(states, np.diag(0.1 * _nominals(fmu, states)), strict=True):
            moves.append((name, at(x + move, inputs)))
        for name, value in inputs.items():
            size = 0.1 * fmu.nominals[fmu.elements[name].variable]
            moves.append((name, at(x, {**inputs, name: value + size})))
    for known, there in moves:
        for name, moved in zip(names, np.abs(there - here) > _ROUNDING * np.abs(here), strict=True):
            variable = fmu.elements[known].variable
            if moved and known not in table[name] and variable not in table[name]:
                result.failures.append(f"'{name}' depends on '{known}', which is not told")


def _at_events(fmu: Fmu, result: _Found) -> None:
    """An input that is set in event mode is there after the event."""
    inputs = _inputs(fmu, 0.1)
    if MODEL_EXCHANGE not in fmu.interfaces() or not inputs:
        result.notes.append("it has no model exchange, or no inputs")
        return
    with _begun(fmu, MODEL_EXCHANGE) as instance:
        instance.require("EnterEventMode")
        instance.set(inputs)
        _continue(instance)
        read = instance.get(list(inputs))
    for (name, new), value in zip(inputs.items(), read, strict=True):
        if abs(value - new) > 1e-6 * max(abs(new), abs(value)):
            result.failures.append(f"'{name}' was set to {new:.6g} at an event and is {value:.6g}")


def _step_sizes(fmu: Fmu, result: _Found) -> None:
    """Steps of any size are taken where the FMU says so; what smaller ones change is told."""
    if CO_SIMULATION not in fmu.interfaces():
        result.notes.append("it has no co-simulation")
        return
    size, co = _step(fmu), fmu.description.coSimulation
    item = float(getattr(co, "fixedInternalStepSize", None) or 0.0)
    ends = []
    for parts in (1, 2, 4):
        if item and parts * item > size * (1 + 1e-9):
            break
        with _begun(fmu, CO_SIMULATION) as instance:
            ends.append(_stepped(instance, size / parts, [0.1] * (parts * _STEPS))[-1])
    if len(ends) == 3:
        scale = np.maximum(np.abs(ends[2]), 1e-300)
        offs = [float(np.max(np.abs(e - ends[2]) / scale, initial=0.0)) for e in ends[:2]]
        result.figure = offs[0]
        result.notes.append(
            f"steps of {size:g} s end {offs[0]:.2g}, half ones {offs[1]:.2g} off quarter ones"
        )
    if co.canHandleVariableCommunicationStepSize:
        with _begun(fmu, CO_SIMULATION) as instance:
            now = 0.0
            for part in (1, 3, 2, 1):
                length = part * (item or size / 2)
                instance.step(now, length)
                now += length


def _finite(fmu: Fmu, result: _Found) -> None:
    """What a run shows are finite numbers."""
    for interface in fmu.interfaces():
        with _begun(fmu, interface) as instance:
            wrong = ~np.isfinite(np.atleast_2d(_run(instance))).all(axis=0)
        if wrong.any():
            result.notes.append(f"{_WORDS[interface]}: {int(wrong.sum())} numbers are not finite")


def _once(instance: Instance, now: float, size: float) -> None:
    if instance.interface == CO_SIMULATION:
        instance.step(now, size)
    else:
        _evaluated(instance)


def _speed(fmu: Fmu, result: _Found) -> None:
    """How long a step takes, and making an instance."""
    interface, size = fmu.interfaces()[0], _step(fmu)
    stop = float(getattr(fmu.description.defaultExperiment, "stopTime", None) or 100 * size)
    most = max(1, int(stop / size * (1 - 1e-9))) if interface == CO_SIMULATION else 10_000
    begin = time.perf_counter()
    instance = _begun(fmu, interface)
    made, count = time.perf_counter() - begin, 0
    with instance:
        begin = time.perf_counter()
        while time.perf_counter() < begin + 0.2 and count < most:
            try:
                _once(instance, count * size, size)
            except FmuError:  # it may end a run of its own accord
                break
            count += 1
        each = (time.perf_counter() - begin) / max(1, count)
    what = f"a step of {size:g} s" if interface == CO_SIMULATION else "an evaluation"
    result.notes.append(f"{what} takes {1e6 * each:.3g} us, an instance {1e3 * made:.3g} ms")


_LOOKS: dict[str, _Look] = {
    "instances": _instances,
    "life cycle": _life_cycle,
    "same bits again": _same_bits,
    "several instances": _several,
    "finite": _finite,
    "start values": _start_values,
    "values are taken": _taken,
    "dependencies": _dependencies,
    "derivatives": _derivatives,
    "state saved": _state,
    "inputs at events": _at_events,
    "step sizes": _step_sizes,
    "speed": _speed,
    "memory": _memory,
}
