"""A master of SSP archives: all FMUs of a system stepped side by side (Jacobi's scheme).

fmpy's own passes values on after a step only, and reads no parameter sets.

At every communication point the parts exchange their outputs, in the order in which outputs depend
on inputs, so that all values belong to that point. Over the step that follows each part sees its
inputs held (an error of first order in the step) or, with `rates`, as straight lines whose slopes
are the rates of the outputs that they come from (second order). No step is repeated.
"""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from fmpy.ssp.ssd import read_ssd

from psa_casadi.errors import InputError
from psa_casadi.export.importer.archive import unpack
from psa_casadi.export.importer.fmu import CO_SIMULATION, FloatArray, Fmu, FmuError, Instance
from psa_casadi.export.importer.masters import Signals
from psa_casadi.export.ssp.drawing import OUTSIDE, Port, Wire
from psa_casadi.scratch import temporary_folder

#: Multiple of a port's nominal size beyond which a co-simulation counts as blown up.
_BEYOND = 1e3


class SspArchive:
    """An SSP archive with its FMUs loaded; a context manager that removes what it extracted.

    `name` is that of the system, `wires` its connections, `parameters` the values that its
    parameter sets give to each part, `fmus` the loaded parts.

    Raises InputError if the file is no SSP archive of FMUs of FMI 2.0.
    """

    def __init__(self, path: Path) -> None:
        self._held = ExitStack()
        folder = self._held.enter_context(temporary_folder())
        try:
            unpack(path, folder)
            system: Any = read_ssd(str(path)).system
        except Exception as error:  # fmpy raises it for any damage
            self._held.close()
            problem = f"{path}: cannot be read as an SSP archive ({error}); export it again."
            raise InputError(problem) from error
        try:
            self.fmus = {
                c.name: self._held.enter_context(Fmu(_inside(folder, str(c.source))))
                for c in system.elements
            }
        except InputError:
            self._held.close()
            raise
        self.name = str(system.name)
        self.wires = tuple(
            Wire(
                Port(c.startElement or OUTSIDE, c.startConnector),
                Port(c.endElement or OUTSIDE, c.endConnector),
            )
            for c in system.connections
        )
        self.parameters = _parameters(system)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._held.close()

    def origin(self, name: str) -> tuple[str, str]:
        """Return (part, variable) of an output of the system, or of "part.variable".

        Raises InputError if there is none.
        """
        for wire in self.wires:
            if wire.end == Port(OUTSIDE, name):
                return wire.start.part, wire.start.name
        part, _, variable = name.partition(".")
        if part not in self.fmus or variable not in self.fmus[part].references:
            known = [w.end.name for w in self.wires if w.end.part == OUTSIDE]
            raise InputError(
                f"The system {self.name} has no output '{name}'; it has {', '.join(known)}, and"
                f" every variable of its parts ({', '.join(self.fmus)}) as 'part.variable'."
            )
        return part, variable


def _inside(folder: Path, source: str) -> Path:
    """Return the place of a part; raises InputError if it is not one inside the archive."""
    place = (folder / source).resolve()
    if not place.is_relative_to(folder.resolve()):
        raise InputError(
            f"The part {source!a} lies outside the SSP archive; export the archive again."
        )
    return place


def _parameters(system: Any) -> dict[str, dict[str, float]]:
    """Return the parameters of each part from the sets of the parts, then those of the system."""
    found: dict[str, dict[str, float]] = {c.name: {} for c in system.elements}
    for component in system.elements:
        for binding in component.parameterBindings:
            for values in binding.parameterValues:
                found[component.name] |= {p.name: float(p.value) for p in values.parameters}
    for binding in system.parameterBindings:
        given = {p.name: float(p.value) for s in binding.parameterValues for p in s.parameters}
        entries = [e for m in binding.parameterMapping for e in m.mappingEntries]
        targets = [(e.target, given[e.source]) for e in entries if e.source in given]
        for name, value in targets or given.items():
            part, _, variable = name.partition(".")
            if part in found:
                found[part][variable] = value
    return found


@dataclass(frozen=True)
class _Exchange:
    """Outputs of one part that become inputs of another, all at once."""

    source: str
    outputs: tuple[str, ...]
    target: str
    inputs: tuple[str, ...]


def couple(
    archive: SspArchive,
    times: FloatArray,
    inputs: Signals,
    outputs: Sequence[str],
    *,
    rates: bool = True,
    tolerance: float | None = None,
    values: Mapping[str, float] | None = None,
) -> FloatArray:
    """Simulate a system over communication points `times` (n,); return its outputs (n, ny).

    `inputs` are the system's; those not given keep their start values. Parameters are those of
    the archive's parameter sets, but for `values` by "part.parameter". `tolerance` is the relative
    tolerance inside each part.

    Raises InputError for names that do not exist and for an algebraic loop, FmuError for a step
    that fails.
    """
    origins = [archive.origin(name) for name in outputs]
    outer = _outer_targets(archive, inputs.names)
    plan = exchanges(archive)
    samples = inputs.at(times)
    rows = [dict(zip(inputs.names, row, strict=True)) for row in samples]
    with ExitStack() as held:
        parts = {
            name: held.enter_context(
                fmu.start(
                    CO_SIMULATION, tolerance=tolerance, start_time=float(times[0]),
                    values=archive.parameters[name] | _own(values or {}, name)
                    | _of_part(outer, name, rows[0]),
                )
            )
            for name, fmu in archive.fmus.items()
        }  # fmt: skip
        result = np.empty((len(times), len(outputs)))
        for k, point in enumerate(times):
            _pass_values(archive, parts, plan, outer, rows[k], float(point))
            result[k] = [float(parts[p].get([v])[0]) for p, v in origins]
            if k + 1 == len(times):
                break
            size = float(times[k + 1] - point)
            if rates:
                slopes = (samples[k + 1] - samples[k]) / size * (not inputs.held)
                _pass_rates(parts, plan, outer, dict(zip(inputs.names, slopes, strict=True)))
            for part in parts.values():
                part.step(float(point), size)
        return result


def _pass_values(
    archive: SspArchive, parts: Mapping[str, Instance], plan: Iterable[_Exchange],
    outer: Mapping[str, Sequence[Port]], row: Mapping[str, float], time: float,
) -> None:  # fmt: skip
    """Give every input the value of what it is wired to."""
    for name, part in parts.items():
        part.set(_of_part(outer, name, row))
    for e in plan:
        given = parts[e.source].get(e.outputs)
        _refuse_growth(archive, e, given, time)
        parts[e.target].set(dict(zip(e.inputs, given, strict=True)))


def _refuse_growth(
    archive: SspArchive, exchange: _Exchange, given: FloatArray, time: float
) -> None:
    """Stop a co-simulation that blows up; the parts' solvers would only get slower and slower."""
    nominals = archive.fmus[exchange.target].nominals
    for name, value in zip(exchange.inputs, given, strict=True):
        if not abs(value) < _BEYOND * nominals[name]:
            raise FmuError(
                f"{exchange.target}.{name} is {value:g} at {time:g} s, {_BEYOND:g} times its usual"
                " size: the coupling is unstable with this communication step; shorten it."
            )


def _pass_rates(
    parts: Mapping[str, Instance],
    plan: Iterable[_Exchange],
    outer: Mapping[str, Sequence[Port]],
    slopes: Mapping[str, float],
) -> None:
    """Give every input the slope of what it is wired to."""
    for name, part in parts.items():
        part.set_rates(_of_part(outer, name, slopes))
    for e in plan:
        found = parts[e.source].output_rates(e.outputs)
        parts[e.target].set_rates(dict(zip(e.inputs, found, strict=True)))


def _own(values: Mapping[str, float], part: str) -> dict[str, float]:
    return {n.removeprefix(f"{part}."): v for n, v in values.items() if n.startswith(f"{part}.")}


def _of_part(
    outer: Mapping[str, Sequence[Port]], part: str, values: Mapping[str, float]
) -> dict[str, float]:
    return {
        port.name: float(values[name])
        for name, ports in outer.items()
        for port in ports
        if port.part == part
    }


def _outer_targets(archive: SspArchive, names: Sequence[str]) -> dict[str, list[Port]]:
    known = dict.fromkeys(w.start.name for w in archive.wires if w.start.part == OUTSIDE)
    unknown = [n for n in names if n not in known]
    if unknown:
        raise InputError(
            f"The system {archive.name} has no input {', '.join(unknown)}; it has"
            f" {', '.join(known) or 'none'}."
        )
    return {n: [w.end for w in archive.wires if w.start == Port(OUTSIDE, n)] for n in names}


def exchanges(archive: SspArchive) -> tuple[_Exchange, ...]:
    """Return the exchanges between parts, each after those that its outputs depend on.

    Raises InputError if outputs and inputs depend on each other in a circle.
    """
    waiting = [w for w in archive.wires if OUTSIDE not in (w.start.part, w.end.part)]
    wired = {w.end for w in waiting}
    needs = {
        w.start: {Port(w.start.part, n) for n in _feedthrough(archive, w.start)} & wired
        for w in waiting
    }
    done: set[Port] = set()
    plan: list[_Exchange] = []
    while waiting:
        ready = [w for w in waiting if needs[w.start] <= done]
        if not ready:
            loop = ", ".join(f"{w.start.part}.{w.start.name}" for w in waiting)
            raise InputError(
                f"The system {archive.name} has an algebraic loop among {loop}; put a part with a"
                " state of its own into it."
            )
        pairs = dict.fromkeys((w.start.part, w.end.part) for w in ready)
        for source, target in pairs:
            group = [w for w in ready if (w.start.part, w.end.part) == (source, target)]
            sent, taken = (tuple(p.name for p in ends) for ends in _ends(group))
            plan.append(_Exchange(source, sent, target, taken))
        done |= {w.end for w in ready}
        waiting = [w for w in waiting if w not in ready]
    return tuple(plan)


def _ends(wires: Sequence[Wire]) -> tuple[list[Port], list[Port]]:
    return [w.start for w in wires], [w.end for w in wires]


def _feedthrough(archive: SspArchive, port: Port) -> set[str]:
    """Return the inputs that an output depends on at once, from the part's description."""
    fmu = archive.fmus[port.part]
    unknown = next(u for u in fmu.description.outputs if u.variable.name == port.name)
    return {d.name for d in unknown.dependencies or () if d.causality == "input"}


def points(step: float, end: float) -> FloatArray:
    """Return the communication points k step from 0 up to the end, shape (n,)."""
    return np.asarray(step * np.arange(round(end / step) + 1), dtype=float)
