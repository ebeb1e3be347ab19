"""What a buyer wants to know of an FMU of any tool, each with the clause of the standard.

Only a violation of the standard fails; what it allows and one should know is a note. Clauses are
those of FMI 2.0.5 and FMI 3.0.2.
"""

import gc
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from psa_casadi.common.processes import memory_of_process
from psa_casadi.common.units import FloatArray
from psa_casadi.export.check.calls import taken_in_turn
from psa_casadi.export.check.rows import BREAKDOWNS, Check, CheckRow, plain
from psa_casadi.export.check.structure import difference_error, evaluate
from psa_casadi.export.importer.archive import Archive
from psa_casadi.export.importer.fmu import CO_SIMULATION, MODEL_EXCHANGE, Fmu, FmuError, Instance

#: Internal steps in one step, at most.
_MOST_INTERNAL = 100
#: Steps of a run, cycles of making and freeing an instance, and how long these may take [s].
_STEPS, _CYCLES, _PATIENCE = 5, 1000, 20.0
#: Cycles before memory is measured, and bytes that a cycle may leave: an importer in Python leaves
#: some 300.
_WARM, _LEAK = 100, 1024.0
#: Relative step of a difference, and how far a derivative may be from it.
_DIFFERENCE, _SLOPE = 1e-5, 1e-3
#: Two runs that differ by this share are not the same, but for rounding; so are two values of
#: single precision.
_ROUNDING, _SINGLE = 1e-9, 1e-6
#: Inputs of a run, by step, as shares of their nominal values from their starts.
_SHARES = (0.0, 0.1, 0.1, -0.1, 0.05)
#: Interfaces by the words of rows.
_WORDS = {CO_SIMULATION: "co-simulation", MODEL_EXCHANGE: "model exchange"}


@dataclass
class _Finding:
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
        clause = f"FMI {version}.0, {_ROWS[name][version - 2]}"
        return CheckRow(
            name, figure, self.limit, passed, remark, "" if clause.endswith("-") else clause,
            noted=passed and bool(self.notes),
        )  # fmt: skip


_Look = Callable[[Fmu, _Finding], None]


def described(archive: Archive, invalid: Callable[[Archive], Iterator[str]]) -> Iterator[Check]:
    """Yield the checks without running the FMU; `invalid` lists what its description violates."""
    version = archive.version

    def valid() -> CheckRow:
        return _Finding(failures=list(invalid(archive))).row("description valid", version)

    def units() -> CheckRow:
        finding, description = _Finding(), archive.description
        known = {u.name for u in description.unitDefinitions}
        stated = {v.name: v.unit for v in description.modelVariables if v.unit}
        wrong = sorted({u for u in stated.values() if u not in known})
        finding.failures += [f"the unit '{u}' is not defined" for u in wrong]
        without = [n for n, e in archive.elements.items() if e.real and e.variable not in stated]
        if without:
            finding.notes.append(f"{len(without)} of {len(archive.elements)} numbers have no unit")
        return finding.row("units defined", version)

    yield Check("description valid", valid)
    yield Check("units defined", units)


def foreign_checks(fmu_of: Callable[[], Fmu], archive: Archive) -> Iterator[Check]:
    """Yield the checks that run the code of an FMU, each to be made before the next is taken."""
    loaded = list[Fmu]()

    def load() -> CheckRow:
        finding = _Finding()
        try:
            fmu = fmu_of()
            for interface in fmu.interfaces():
                fmu.loaded(interface)
            loaded.append(fmu)
        except BREAKDOWNS as error:
            folders = {p.parent.name for p in archive.binaries()}
            finding.failures.append(f"{error} (it has {', '.join(sorted(folders)) or 'none'})")
        return finding.row("binary loads", archive.version)

    yield Check("binary loads", load)
    for fmu in loaded:
        for name, (*_, look) in _ROWS.items():
            if look is not None:
                yield Check(name, partial(_row, fmu, name, look))


def _row(fmu: Fmu, name: str, look: _Look) -> CheckRow:
    finding = _Finding()
    try:
        look(fmu, finding)
    except BREAKDOWNS as error:
        finding.failures.append(str(error))
    return finding.row(name, fmu.version)


def _step(fmu: Fmu) -> float:
    """Return a step that the FMU takes: its default one, as a multiple of its internal one."""
    internal = fmu.internal_step
    span = fmu.experiment("stopTime") - fmu.experiment("startTime")
    size = fmu.experiment("stepSize") or span / 100 or 0.01
    return max(1, min(_MOST_INTERNAL, round(size / internal))) * internal if internal else size


def _inputs(fmu: Fmu, share: float) -> dict[str, float]:
    """Return inputs at their starts, those that are real moved by a share of their nominals."""
    return {
        name: float(np.clip(e.start + share * fmu.nominals[name] * e.real, *fmu.bounds[name]))
        for name, e in fmu.elements.items()
        if fmu.variables[e.variable].causality == "input"
    }


def _continuous(fmu: Fmu) -> dict[str, float]:
    """Return moved inputs, those that may move between events."""

    def moves(name: str) -> bool:
        e = fmu.elements[name]
        return e.real and fmu.variables[e.variable].variability != "discrete"

    return {n: v for n, v in _inputs(fmu, 0.1).items() if moves(n)}


def _unknowns(fmu: Fmu) -> list[str]:
    """Return the outputs and rates of the model structure that are scalar real numbers."""
    listed = (*fmu.description.outputs, *fmu.description.derivatives)
    names = [str(u.variable.name) for u in listed]
    return [n for n in names if n in fmu.elements and fmu.elements[n].real]


def _results(fmu: Fmu) -> list[str]:
    """Return the outputs and local variables."""
    kinds = ("output", "local")
    return [n for n, e in fmu.elements.items() if fmu.variables[e.variable].causality in kinds]


def _stepped(
    instance: Instance, size: float, shares: Sequence[float], now: float = 0.0
) -> FloatArray:
    """Step with moved inputs from a time on; return the results of each step."""
    rows = []
    for share in shares:
        instance.set(_inputs(instance.fmu, share))
        instance.step(now, size)
        now += size
        rows.append(instance.get(_results(instance.fmu)))
    return np.array(rows)


def _run(instance: Instance) -> FloatArray:
    """Return the results of steps, or rates and results at the first states with moved inputs."""
    fmu = instance.fmu
    if instance.interface == CO_SIMULATION:
        return _stepped(instance, _step(fmu), _SHARES)
    rates, count = np.zeros(0), len(fmu.state_elements)
    if count:
        x = instance.vector("GetContinuousStates", count)
        rates = instance.derivatives(0.0, x, _continuous(fmu))
    return np.concatenate([rates, instance.get(_results(fmu))])


@contextmanager
def _ready(fmu: Fmu, interface: int) -> Iterator[Instance]:
    """Yield an instance that is ready for a run, its initial events done; free it afterwards."""
    with fmu.open(interface) as instance:
        _initialise(instance)
        yield instance


def _initialise(instance: Instance) -> None:
    instance.setup()
    if instance.interface == MODEL_EXCHANGE:
        instance.leave_event_mode()


@contextmanager
def _moved_point(fmu: Fmu) -> Iterator[tuple[Instance, dict[str, float]]]:
    """Yield an instance of model exchange, and a point with states and inputs off their starts."""
    names = fmu.state_elements
    with _ready(fmu, MODEL_EXCHANGE) as instance:
        x = instance.vector("GetContinuousStates", len(names))
        moved = x + 0.1 * np.array([fmu.nominals[n] for n in names])
        states = dict(zip(names, moved.tolist(), strict=True))
        yield instance, {"time": 0.0, **states, **_continuous(fmu)}


def _interface(fmu: Fmu, interface: int) -> Any:
    return (fmu.description.modelExchange, fmu.description.coSimulation)[interface]


def _instances(fmu: Fmu, finding: _Finding) -> None:
    """Every interface that the description announces gives an instance."""
    for interface in fmu.interfaces():
        try:
            fmu.open(interface).free()
        except FmuError as error:
            finding.failures.append(f"{_WORDS[interface]}: {error}")


def _life_cycle(fmu: Fmu, finding: _Finding) -> None:
    """Initialise, run, terminate, reset, and the same again."""
    for interface in fmu.interfaces():
        with _ready(fmu, interface) as instance:
            first = _run(instance)
            instance.require("Terminate")
            instance.require("Reset")
            _initialise(instance)
            if off := _off(first, _run(instance)):
                finding.failures.append(
                    f"{_WORDS[interface]}: after a reset it gives other results ({off:.2g} off)"
                )


def _off(a: FloatArray, b: FloatArray) -> float:
    """Return by which share of its size one result is off another; 0 for the same bits."""
    if a.tobytes() == b.tobytes():
        return 0.0
    size = np.maximum(np.max(np.abs(a), axis=0, initial=0.0), 1e-300)
    off = float(np.max(np.abs(a - b) / size, initial=0.0))
    return max(off, 1e-16)


def _same_bits(fmu: Fmu, finding: _Finding) -> None:
    """A second instance gives the same bits."""
    for interface in fmu.interfaces():
        runs = []
        for _ in range(2):
            with _ready(fmu, interface) as instance:
                runs.append(_run(instance))
        if off := _off(*runs):
            finding.notes.append(
                f"{_WORDS[interface]}: a second instance is {off:.2g} off the first"
            )


def _several(fmu: Fmu, finding: _Finding) -> None:
    """Two instances in turn give what each gives alone, where several are allowed."""
    for interface in fmu.interfaces():
        if _interface(fmu, interface).canBeInstantiatedOnlyOncePerProcess:
            finding.notes.append(f"{_WORDS[interface]}: one instance for each process")
        elif interface == CO_SIMULATION:
            start, shares = partial(_ready, fmu, interface), (_SHARES, _SHARES[::-1])
            for k, alone, row in taken_in_turn(start, _stepped, _step(fmu), shares):
                if _off(alone, row) > _ROUNDING:
                    finding.failures.append(f"two instances disturb each other in step {k}")
                    return


def _memory(fmu: Fmu, finding: _Finding) -> None:
    """An instance that is freed leaves nothing behind."""
    interface, end = fmu.interfaces()[0], time.monotonic() + _PATIENCE
    before, count = 0, 0
    for count in range(1, _CYCLES + 1):
        with _ready(fmu, interface) as instance:
            _run(instance)
        if count == _WARM:
            before = _resident()
        if time.monotonic() > end and count > _WARM:
            break
    leak = max(0.0, float(_resident() - before)) / max(1, count - _WARM)
    if not before:
        finding.notes.append("this system does not tell the memory of a process")
        return
    finding.figure, finding.limit = leak, _LEAK
    text = f"{leak:.0f} bytes left by each of {count} cycles"
    (finding.failures if leak > _LEAK else finding.notes if count < _CYCLES else []).append(text)


def _resident() -> int:
    """Return the memory of this process that counts [bytes], 0 if the system has no figure."""
    gc.collect()
    return memory_of_process("RssAnon")


def _state(fmu: Fmu, finding: _Finding) -> None:
    """A state that is saved and restored replays the same, also by way of bytes."""
    for interface in fmu.interfaces():
        kind = _interface(fmu, interface)
        if not kind.canGetAndSetFMUstate:  # fmpy's name in FMI 3.0, too
            finding.notes.append(f"{_WORDS[interface]}: it announces no way to save its state")
            continue
        with _ready(fmu, interface) as instance:
            ways = {"restored": instance.fmi.getFMUState()}
            first = _run(instance)
            flags = ("canSerializeFMUstate", "canSerializeFMUState")
            if any(getattr(kind, n, False) for n in flags):
                data = instance.fmi.serializeFMUState(ways["restored"])
                ways["read back from bytes"] = instance.fmi.deserializeFMUState(data)
            for words, snapshot in ways.items():
                instance.fmi.setFMUState(snapshot)
                if off := _off(first, _run(instance)):
                    finding.failures.append(
                        f"{_WORDS[interface]}: a state that is {words} replays {off:.2g} off"
                    )
            for snapshot in ways.values():
                instance.fmi.freeFMUState(snapshot)


def _derivatives(fmu: Fmu, finding: _Finding) -> None:
    """Directional derivatives of model exchange are those of differences, at two step sizes."""
    exchange = fmu.description.modelExchange
    if exchange is None or not exchange.providesDirectionalDerivative:
        finding.notes.append("it provides none")
        return
    states = fmu.state_elements
    unknowns = [n for n in _unknowns(fmu) if n not in states]
    if any(fmu.elements[n].count > 1 for n in [*unknowns, *states]):
        finding.notes.append("not looked at: arrays")
        return
    with _moved_point(fmu) as (instance, point):
        seed = {n: fmu.nominals[n] for n in point if n != "time"}
        worst = np.minimum(
            *(
                difference_error(instance, point, unknowns, seed, h)
                for h in (_DIFFERENCE, 10 * _DIFFERENCE)
            )
        )
    finding.figure, finding.limit = float(np.max(worst, initial=0.0)), _SLOPE
    for name, one in zip(unknowns, worst, strict=True):
        if one > _SLOPE:
            finding.failures.append(f"that of '{name}' is {one:.2g} off a difference")


def _settable(fmu: Fmu) -> dict[str, float]:
    """Return the start values of parameters, inputs and variables that start exactly there."""
    table = {}
    for name, e in fmu.elements.items():
        v = fmu.variables[e.variable]
        exact = v.initial == "exact" or v.causality in ("parameter", "input")
        no_value = v.start is None or v.variability == "constant"
        if exact and not no_value and v.causality not in ("independent", "structuralParameter"):
            table[name] = e.start
    return table


def _other_values(
    instance: Instance, expected: Mapping[str, float]
) -> Iterator[tuple[str, float, float]]:
    """Yield name, expected and read value of the variables that have other values."""
    read = instance.get(list(expected))
    for (name, wanted), value in zip(expected.items(), read, strict=True):
        if abs(value - wanted) > _SINGLE * max(abs(wanted), abs(value)):
            yield name, wanted, value


def _start_values(fmu: Fmu, finding: _Finding) -> None:
    """The values after initialization are those of the description, where nothing was set."""
    if starts := _settable(fmu):
        with fmu.open(fmu.interfaces()[0]) as instance:
            instance.setup()
            finding.failures += [
                f"'{name}' starts at {value:.6g}, its description says {stated:.6g}"
                for name, stated, value in _other_values(instance, starts)
            ]


def _taken(fmu: Fmu, finding: _Finding) -> None:
    """A start value that is set before initialization is the value after it."""
    moved = {}
    for name, start in _settable(fmu).items():
        e = fmu.elements[name]
        low, high = fmu.bounds[name]
        new = start + 0.01 * (abs(start) or fmu.nominals[name])
        if e.real and fmu.variables[e.variable].variability != "fixed" and low <= new <= high:
            moved[name] = new
    if not moved:
        finding.notes.append("nothing can be set")
        return
    with fmu.open(fmu.interfaces()[0]) as instance:
        instance.setup(values=moved)
        finding.failures += [
            f"'{name}' was set to {new:.6g} and is {value:.6g}"
            for name, new, value in _other_values(instance, moved)
        ]


def _dependencies(fmu: Fmu, finding: _Finding) -> None:
    """The dependencies list whatever moves an output or a rate."""
    wanted = {*_unknowns(fmu)} - {*fmu.state_elements}
    table = {
        str(e.variable.name): {str(d.name) for d in e.dependencies}
        for e in (*fmu.description.outputs, *fmu.description.derivatives)
        if e.dependencies is not None and e.variable.name in wanted
    }
    if fmu.description.modelExchange is None or not table:
        finding.notes.append("none are told, or there is no model exchange to see them by")
        return
    names = list(table)
    with _moved_point(fmu) as (instance, point):
        here = evaluate(instance, point, names)
        for known in [n for n in point if n != "time"]:
            moved = {**point, known: point[known] + 0.1 * fmu.nominals[known]}
            changed = np.abs(evaluate(instance, moved, names) - here) > _ROUNDING * np.abs(here)
            for name in np.array(names)[changed]:
                if table[name].isdisjoint((known, fmu.elements[known].variable)):
                    finding.failures.append(f"'{name}' depends on '{known}', which is not told")


def _at_events(fmu: Fmu, finding: _Finding) -> None:
    """An input that is set in event mode has its value after the event."""
    inputs = _inputs(fmu, 0.1)
    if MODEL_EXCHANGE not in fmu.interfaces() or not inputs:
        finding.notes.append("it has no model exchange, or no inputs")
        return
    with _ready(fmu, MODEL_EXCHANGE) as instance:
        instance.require("EnterEventMode")
        instance.set(inputs)
        instance.leave_event_mode()
        finding.failures += [
            f"'{name}' was set to {new:.6g} at an event and is {value:.6g}"
            for name, new, value in _other_values(instance, inputs)
        ]


def _step_sizes(fmu: Fmu, finding: _Finding) -> None:
    """Steps of any size are taken if the FMU announces it; a note has the effect of the size."""
    if CO_SIMULATION not in fmu.interfaces():
        finding.notes.append("it has no co-simulation")
        return
    size, internal, ends = _step(fmu), fmu.internal_step, []
    for parts in (1, 2, 4):
        if internal and parts * internal > size * (1 + 1e-9):
            break
        with _ready(fmu, CO_SIMULATION) as instance:
            ends.append(_stepped(instance, size / parts, [0.1] * (parts * _STEPS))[-1])
    if len(ends) == 3:
        scale = np.maximum(np.abs(ends[2]), 1e-300)
        offs = [float(np.max(np.abs(e - ends[2]) / scale, initial=0.0)) for e in ends[:2]]
        finding.figure = offs[0]
        finding.notes.append(
            f"steps of {size:g} s end {offs[0]:.2g}, half ones {offs[1]:.2g} off quarter ones"
        )
    if fmu.description.coSimulation.canHandleVariableCommunicationStepSize:
        with _ready(fmu, CO_SIMULATION) as instance:
            now = 0.0
            for part in (1, 3, 2, 1):
                length = part * (internal or size / 2)
                instance.step(now, length)
                now += length


def _finite(fmu: Fmu, finding: _Finding) -> None:
    """The results of a run are finite numbers."""
    for interface in fmu.interfaces():
        with _ready(fmu, interface) as instance:
            wrong = ~np.isfinite(np.atleast_2d(_run(instance))).all(axis=0)
        if wrong.any():
            finding.notes.append(f"{_WORDS[interface]}: {int(wrong.sum())} numbers are not finite")


def _speed(fmu: Fmu, finding: _Finding) -> None:
    """How long a step takes, and making an instance."""
    interface, size = fmu.interfaces()[0], _step(fmu)
    stepping = interface == CO_SIMULATION
    stop = fmu.experiment("stopTime") or 100 * size
    most = max(1, int(stop / size * (1 - 1e-9))) if stepping else 10_000
    begin, count = time.perf_counter(), 0
    with _ready(fmu, interface) as instance:
        made, begin = time.perf_counter() - begin, time.perf_counter()
        while time.perf_counter() < begin + 0.2 and count < most:
            try:
                if stepping:
                    instance.step(count * size, size)
                else:
                    _run(instance)
            except FmuError:  # it may end a run by itself
                break
            count += 1
        each = (time.perf_counter() - begin) / max(1, count)
    what = f"a step of {size:g} s" if stepping else "an evaluation"
    finding.notes.append(f"{what} takes {1e6 * each:.3g} us, an instance {1e3 * made:.3g} ms")


#: The rows: clause in FMI 2.0.5 and in FMI 3.0.2, and what makes those of a loaded FMU.
_ROWS: dict[str, tuple[str, str, _Look | None]] = {
    "description valid": ("2.2", "2.4", None),
    "units defined": ("2.2.2", "2.4.3", None),
    "binary loads": ("2.1.1", "2.2.2", None),
    "instances": ("2.1.5", "2.3.1", _instances),
    "life cycle": ("2.1.6", "2.3.1", _life_cycle),
    "same bits again": ("2.1.6", "2.3.1", _same_bits),
    "several instances": ("4.3.1, 3.3.1", "2.4.2", _several),
    "finite": ("2.1.3", "2.2.4", _finite),
    "start values": ("2.2.7", "2.4.7.5", _start_values),
    "values are taken": ("2.1.7", "2.2.7.2", _taken),
    "dependencies": ("2.2.8", "2.4.8", _dependencies),
    "derivatives": ("2.1.9", "2.2.12.1", _derivatives),
    "state saved": ("2.1.8", "2.2.7.4", _state),
    "inputs at events": ("3.2.2", "2.3.5", _at_events),
    "step sizes": ("4.2.2", "4.2.1", _step_sizes),
    "speed": ("-", "-", _speed),
    "memory": ("2.1.5", "2.3.1", _memory),
}
