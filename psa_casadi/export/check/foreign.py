"""What a buyer wants to know of an FMU of any tool, each with the clause of the standard.

Only a violation of the standard fails; what it allows and one should know is a note. Clauses are
those of FMI 2.0.5 and FMI 3.0.2.
"""

import gc
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial

import numpy as np

from psa_casadi.common.processes import memory_of_process
from psa_casadi.export.check.calls import (
    SHARES,
    WORDS,
    continuous_inputs,
    difference,
    life_cycle,
    moved_inputs,
    ready,
    run_of,
    saved_states,
    several_instances,
    step_of,
    stepped,
)
from psa_casadi.export.check.description import invalid
from psa_casadi.export.check.rows import Check, Findings, Remark
from psa_casadi.export.check.structure import difference_error, movements
from psa_casadi.export.importer.archive import Archive
from psa_casadi.export.importer.fmu import CO_SIMULATION, MODEL_EXCHANGE, Fmu, FmuError, Instance

#: Cycles of making and freeing an instance, and how long these may take [s].
_CYCLES, _PATIENCE = 1000, 20.0
#: Cycles before memory is measured, and bytes that a cycle may leave: an importer in Python leaves
#: some 300.
_WARM, _LEAK = 100, 1024.0
#: Relative step of a difference, and how far a derivative may be from it.
_DIFFERENCE, _SLOPE = 1e-5, 1e-3
#: Two runs that differ by this share are not the same, but for rounding; so are two values of
#: single precision.
_ROUNDING, _SINGLE = 1e-9, 1e-6


def units(archive: Archive) -> Findings:
    """Every unit of a variable or a type is defined; a note has how many numbers have none."""
    description = archive.description
    known = {u.name for u in description.unitDefinitions}
    stated = {v.name: v.unit for v in description.modelVariables if v.unit}
    used = {*stated.values(), *(t.unit for t in description.typeDefinitions if t.unit)}
    yield from (f"the unit '{u}' is not defined" for u in sorted(used - known))
    without = [n for n, e in archive.elements.items() if e.real and e.variable not in stated]
    if without:
        yield Remark(f"{len(without)} of {len(archive.elements)} numbers have no unit")


def instances(fmu: Fmu) -> Findings:
    """Every interface that the description announces gives an instance."""
    for interface in fmu.interfaces():
        try:
            fmu.open(interface).free()
        except FmuError as error:
            yield f"{WORDS[interface]}: {error}"


def same_bits(fmu: Fmu) -> Findings:
    """A second instance gives the same bits."""
    for interface in fmu.interfaces():
        runs = []
        for _ in range(2):
            with ready(fmu, interface) as instance:
                runs.append(run_of(instance))
        if off := difference(*runs):
            yield Remark(f"{WORDS[interface]}: a second instance is {off:.2g} off the first")


def finite(fmu: Fmu) -> Findings:
    """The results of a run are finite numbers."""
    for interface in fmu.interfaces():
        with ready(fmu, interface) as instance:
            wrong = ~np.isfinite(np.atleast_2d(run_of(instance))).all(axis=0)
        if wrong.any():
            yield Remark(f"{WORDS[interface]}: {int(wrong.sum())} numbers are not finite")


def memory(fmu: Fmu) -> Findings:
    """An instance that is freed leaves nothing behind."""
    interface, end = fmu.interfaces()[0], time.monotonic() + _PATIENCE
    before, count = 0, 0
    for count in range(1, _CYCLES + 1):
        with ready(fmu, interface) as instance:
            run_of(instance)
        if count == _WARM:
            before = _resident()
        if time.monotonic() > end and count > _WARM:
            break
    if not before:
        yield Remark("this system does not report the memory of a process")
        return
    leak = max(0.0, float(_resident() - before)) / max(1, count - _WARM)
    yield leak
    text = f"{leak:.0f} bytes left by each of {count} cycles"
    if leak > _LEAK:
        yield text
    elif count < _CYCLES:
        yield Remark(text)


def _resident() -> int:
    """Return the memory of this process that counts [bytes], 0 if the system has no figure."""
    gc.collect()
    return memory_of_process("RssAnon")


@contextmanager
def _moved_point(fmu: Fmu) -> Iterator[tuple[Instance, dict[str, float]]]:
    """Yield an instance of model exchange, and a point with states and inputs off their starts."""
    names = fmu.state_elements
    with ready(fmu, MODEL_EXCHANGE) as instance:
        x = instance.vector("GetContinuousStates", len(names))
        moved = x + 0.1 * np.array([fmu.nominals[n] for n in names])
        states = dict(zip(names, moved.tolist(), strict=True))
        yield instance, {"time": 0.0, **states, **continuous_inputs(fmu)}


def _unknowns(fmu: Fmu) -> list[str]:
    """Return the outputs and rates of the model structure that are scalar real numbers.

    But for states among them.
    """
    listed = (*fmu.description.outputs, *fmu.description.derivatives)
    names = [str(u.variable.name) for u in listed]
    reals = {n for n, e in fmu.elements.items() if e.real} - {*fmu.state_elements}
    return [n for n in names if n in reals]


def derivatives(fmu: Fmu) -> Findings:
    """Directional derivatives of model exchange are those of differences, at two step sizes."""
    exchange = fmu.description.modelExchange
    if exchange is None or not exchange.providesDirectionalDerivative:
        yield Remark("it provides none")
        return
    unknowns = _unknowns(fmu)
    if any(fmu.elements[n].count > 1 for n in [*unknowns, *fmu.state_elements]):
        yield Remark("not looked at: arrays")
        return
    with _moved_point(fmu) as (instance, point):
        seed = {n: fmu.nominals[n] for n in point if n != "time"}
        steps = (_DIFFERENCE, 10 * _DIFFERENCE)
        worst = np.minimum(*(difference_error(instance, point, unknowns, seed, h) for h in steps))
    yield float(np.max(worst, initial=0.0))
    for name, one in zip(unknowns, worst, strict=True):
        if one > _SLOPE:
            yield f"that of '{name}' is {one:.2g} off a difference"


def dependencies(fmu: Fmu) -> Findings:
    """The dependencies list whatever moves an output or a rate."""
    wanted = {*_unknowns(fmu)}
    table = {
        str(e.variable.name): {str(d.name) for d in e.dependencies}
        for e in (*fmu.description.outputs, *fmu.description.derivatives)
        if e.dependencies is not None and e.variable.name in wanted
    }
    if fmu.description.modelExchange is None or not table:
        yield Remark("none are declared, or there is no model exchange to check them by")
        return
    with _moved_point(fmu) as (instance, point):
        moved = {n: v + 0.1 * fmu.nominals[n] for n, v in point.items() if n != "time"}
        for name, known in movements(instance, point, list(table), moved, _ROUNDING):
            if table[name].isdisjoint((known, fmu.elements[known].variable)):
                yield f"'{name}' depends on '{known}', which is not declared"


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


def _other_values(instance: Instance, expected: Mapping[str, float], words: str) -> Iterator[str]:
    """Yield `words` of the variables that have other values, with name, expected and read one."""
    read = instance.get(list(expected))
    for (name, wanted), value in zip(expected.items(), read, strict=True):
        if abs(value - wanted) > _SINGLE * max(abs(wanted), abs(value)):
            yield words.format(name, wanted, value)


def start_values(fmu: Fmu) -> Findings:
    """The values after initialization are those of the description, where nothing was set."""
    if starts := _settable(fmu):
        with fmu.open(fmu.interfaces()[0]) as instance:
            instance.setup()
            words = "'{0}' starts at {2:.6g}, its description has {1:.6g}"
            yield from _other_values(instance, starts, words)


def values_taken(fmu: Fmu) -> Findings:
    """A start value that is set before initialization is the value after it."""
    moved = {}
    for name, start in _settable(fmu).items():
        e = fmu.elements[name]
        low, high = fmu.bounds[name]
        new = start + 0.01 * (abs(start) or fmu.nominals[name])
        if e.real and fmu.variables[e.variable].variability != "fixed" and low <= new <= high:
            moved[name] = new
    if not moved:
        yield Remark("nothing can be set")
        return
    with fmu.open(fmu.interfaces()[0]) as instance:
        instance.setup(values=moved)
        yield from _other_values(instance, moved, "'{}' was set to {:.6g} and is {:.6g}")


def inputs_at_events(fmu: Fmu) -> Findings:
    """An input that is set in event mode has its value after the event."""
    inputs = moved_inputs(fmu, 0.1)
    if MODEL_EXCHANGE not in fmu.interfaces() or not inputs:
        yield Remark("it has no model exchange, or no inputs")
        return
    with ready(fmu, MODEL_EXCHANGE) as instance:
        instance.require("EnterEventMode")
        instance.set(inputs)
        instance.leave_event_mode()
        words = "'{}' was set to {:.6g} at an event and is {:.6g}"
        yield from _other_values(instance, inputs, words)


def step_sizes(fmu: Fmu) -> Findings:
    """Steps of any size are taken if the FMU announces it; a note has the effect of the size."""
    if CO_SIMULATION not in fmu.interfaces():
        yield Remark("it has no co-simulation")
        return
    size, internal, ends = step_of(fmu), fmu.internal_step, []
    for parts in (1, 2, 4):
        if internal and parts * internal > size * (1 + 1e-9):
            break
        with ready(fmu, CO_SIMULATION) as instance:
            ends.append(stepped(instance, size / parts, [0.1] * (parts * len(SHARES)))[-1])
    if len(ends) == 3:
        scale = np.maximum(np.abs(ends[2]), 1e-300)
        offs = [float(np.max(np.abs(e - ends[2]) / scale, initial=0.0)) for e in ends[:2]]
        yield offs[0]
        yield Remark(
            f"steps of {size:g} s end {offs[0]:.2g}, half ones {offs[1]:.2g} off quarter ones"
        )
    if fmu.description.coSimulation.canHandleVariableCommunicationStepSize:
        with ready(fmu, CO_SIMULATION) as instance:
            now = 0.0
            for part in (1, 3, 2, 1):
                length = part * (internal or size / 2)
                instance.step(now, length)
                now += length


def speed(fmu: Fmu) -> Findings:
    """How long a step takes, and making an instance."""
    interface, size = fmu.interfaces()[0], step_of(fmu)
    stepping = interface == CO_SIMULATION
    stop = fmu.experiment("stopTime") or 100 * size
    most = max(1, int(stop / size * (1 - 1e-9))) if stepping else 10_000
    begin, count = time.perf_counter(), 0
    with ready(fmu, interface) as instance:
        made, begin = time.perf_counter() - begin, time.perf_counter()
        while time.perf_counter() < begin + 0.2 and count < most:
            try:
                if stepping:
                    instance.step(count * size, size)
                else:
                    run_of(instance)
            except FmuError:  # it may end a run by itself
                break
            count += 1
        each = (time.perf_counter() - begin) / max(1, count)
    what = f"a step of {size:g} s" if stepping else "an evaluation"
    yield Remark(f"{what} takes {1e6 * each:.3g} us, an instance {1e3 * made:.3g} ms")


_DESCRIBED: dict[str, Callable[[Archive], Findings]] = {
    "description valid": invalid, "units defined": units,
}  # fmt: skip
_LOADED: dict[str, Callable[[Fmu], Findings]] = {
    "instances": instances,
    "life cycle": life_cycle,
    "same bits again": same_bits,
    "several instances": partial(several_instances, rounding=_ROUNDING),
    "finite": finite,
    "start values": start_values,
    "values are taken": values_taken,
    "dependencies": dependencies,
    "derivatives": derivatives,
    "state saved": saved_states,
    "inputs at events": inputs_at_events,
    "step sizes": step_sizes,
    "speed": speed,
    "memory": memory,
}
#: The clauses in FMI 2.0.5 and in FMI 3.0.2, and limits of figures.
_CLAUSES = {
    "description valid": ("2.2", "2.4"),
    "units defined": ("2.2.2", "2.4.3"),
    "binary loads": ("2.1.1", "2.2.2"),
    "instances": ("2.1.5", "2.3.1"),
    "life cycle": ("2.1.6", "2.3.1"),
    "same bits again": ("2.1.6", "2.3.1"),
    "several instances": ("4.3.1, 3.3.1", "2.4.2"),
    "finite": ("2.1.3", "2.2.4"),
    "start values": ("2.2.7", "2.4.7.5"),
    "values are taken": ("2.1.7", "2.2.7.2"),
    "dependencies": ("2.2.8", "2.4.8"),
    "derivatives": ("2.1.9", "2.2.12.1"),
    "state saved": ("2.1.8", "2.2.7.4"),
    "inputs at events": ("3.2.2", "2.3.5"),
    "step sizes": ("4.2.2", "4.2.1"),
    "memory": ("2.1.5", "2.3.1"),
}
_LIMITS = {"derivatives": _SLOPE, "memory": _LEAK}


def by_standard(name: str, run: Callable[[], Findings], version: int) -> Check:
    """Return a check by the standard, with its clause in a version."""
    known = _CLAUSES.get(name)
    clause = f"FMI {version}.0, {known[version - 2]}" if known else ""
    return Check(name, run, _LIMITS.get(name, 0.0), clause)


def described(archive: Archive) -> Iterator[Check]:
    """Yield the checks without running the FMU."""
    for name, check in _DESCRIBED.items():
        yield by_standard(name, partial(check, archive), archive.version)


def foreign_checks(fmu: Fmu) -> Iterator[Check]:
    """Yield the checks that run the code of an FMU, each to be made before the next is taken."""
    for name, check in _LOADED.items():
        yield by_standard(name, partial(check, fmu), fmu.version)
