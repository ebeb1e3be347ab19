"""An FMU of another tool with the effects around it, as an SSP or as one FMU.

u -> before (effects of inputs) -> original FMU -> behind (effects of outputs) -> y

The one FMU has the others in its resources, and steps them in turn (fmu_src/nested.c).
"""

import hashlib
import os
import uuid
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from fmpy import model_description as fmi

from psa_casadi.common.errors import InputError
from psa_casadi.common.files import atomic_path, temporary_folder
from psa_casadi.export import ssp
from psa_casadi.export.common.markup import generation_tool
from psa_casadi.export.common.templates import filled
from psa_casadi.export.fmu.archive import write_archive
from psa_casadi.export.fmu.platforms import compile_library, host_platform
from psa_casadi.export.fmu.sources import FMI_HEADERS
from psa_casadi.export.importer.archive import Archive
from psa_casadi.export.importer.fmu import CO_SIMULATION
from psa_casadi.export.importer.played import PLAYED, RUNS, SUPPLIED, Passed
from psa_casadi.export.importer.start_values import FmuPart, fmu_part, start_set
from psa_casadi.model.component import Component, OnDemand
from psa_casadi.model.compose import Model
from psa_casadi.model.ports import Opened, ported
from psa_casadi.model.variables import Input, Output, State
from psa_casadi.simulation.compiler import sources_directory
from psa_casadi.simulation.start import start_for

_BEFORE, _ORIGINAL, _BEHIND = "before", "original", "behind"
_PARAMETERS = "resources/original.ssv"


def export_extended(
    model: Model,
    path: str | os.PathLike[str],
    *,
    step: float | None = None,
    platforms: Sequence[str] = ("host",),
) -> Path:
    """Write the model of an FMU with effects at its inputs and outputs, and return its path.

    NAME.ssp is an archive (SSP 1.0) of the FMU as it is, its parameters as a set, and FMUs of FMI
    2.0 with the effects of inputs and of outputs. A master steps the parts: an output acts on the
    next part `step` [s] later, by default the FMU's step size.

    NAME.fmu is one FMU of FMI 2.0 for co-simulation, for this machine's platform, with the others
    in its resources. It steps them in turn, each with a line of the outputs of the one before:
    nothing is late. The FMU in it must be of FMI 2.0.

    Raises InputError for a model that is of no FMU, one without co-simulation, and for effects in
    rates, which are inside; and as `export_fmu`.
    """
    part = fmu_part(model, "write it with psa.export_fmu")
    file, fmu, target = part.foreign.fmu.file, part.fmu, Path(path)
    single = target.suffix.lower() == ".fmu"
    if fmu.description.coSimulation is None:
        raise InputError(f"{file} has no co-simulation, which can stand between effects.")
    if single and fmu.version != 2:
        raise InputError(f"{file} is of FMI 3.0, which no FMU holds here; write NAME.ssp.")
    wiring = _wired(part, _by_place(part))
    with temporary_folder() as folder:
        fmus = {_ORIGINAL: fmu.path}
        for name, side in wiring.parts.items():
            if name != _ORIGINAL:
                fmus[name] = ssp.part_fmu(side, name, folder, platforms)
        if single:
            entries = nested(wiring, fmus, part.starts)
        else:
            entries = _system(part, wiring, step)
            entries |= {f"resources/{n}.fmu": f.read_bytes() for n, f in fmus.items()}
    with atomic_path(target) as temporary:
        write_archive(temporary, entries)
    return target


def _system(part: FmuPart, wiring: ssp.WiredParts, step: float | None) -> dict[str, bytes]:
    """Return the description of an SSP, its parameter sets and picture."""
    size = step or part.fmu.step_size
    stop = part.fmu.experiment("stopTime") or 1000 * size
    others = {name: side for name, side in wiring.parts.items() if name != _ORIGINAL}
    entries, bindings = ssp.parameter_files(others, part.model.name)
    if part.starts:
        entries[_PARAMETERS] = start_set(part).encode("utf-8")
        bindings = (*bindings, ssp.Binding(_ORIGINAL, _PARAMETERS))
    return entries | ssp.system_entries(wiring, bindings, stop, size)


def _by_place(part: FmuPart) -> dict[str, list[Component]]:
    """Return the effects before and behind an FMU. Raises InputError for any others."""
    places = {f"applied_{i.name}": _BEFORE for i in part.component.inputs}
    places |= {f"shown_{o.name}": _BEHIND for o in part.component.outputs}
    table: dict[str, list[Component]] = {_BEFORE: [], _BEHIND: []}
    for effect in part.model.effects:
        added = {places.get(name) for name in effect.equations(OnDemand()).add}
        if len(added) != 1 or None in added:
            raise InputError(
                f"The effect '{effect.name}' acts inside the FMU; only effects at its inputs and"
                " outputs can stand around it. `psa simulate --model` runs it, and Python."
            )
        table[str(added.pop())].append(effect)
    return table


def _wired(part: FmuPart, effects: dict[str, list[Component]]) -> ssp.WiredParts:
    """Return the parts and their wires; a side without effects has none."""
    model, component, played = part.model, part.component, part.component.played
    inputs, outputs = component.inputs, component.outputs
    parts: dict[str, Model] = {}
    wires: list[ssp.Wire] = []
    if effects[_BEFORE]:
        applied = [Output(SUPPLIED + i.name, i.unit, i.description) for i in inputs]
        parts[_BEFORE] = _side(part, _BEFORE, inputs, applied, effects[_BEFORE])
    parts[_ORIGINAL] = model.with_components([component])
    if effects[_BEHIND]:
        starts = zip(outputs, _first_outputs(part), strict=True)
        read = [Input(PLAYED + o.name, o.unit, o.description, v) for o, v in starts]
        parts[_BEHIND] = _side(part, _BEHIND, read, outputs, effects[_BEHIND])
    for i in inputs:
        outer, end = ssp.Port(ssp.OUTSIDE, i.name), ssp.Port(_ORIGINAL, i.name)
        if effects[_BEFORE]:
            wires.append(ssp.Wire(outer, ssp.Port(_BEFORE, i.name)))
            outer = ssp.Port(_BEFORE, SUPPLIED + i.name)
        wires.append(ssp.Wire(outer, end))
    for o in outputs:
        start, outer = ssp.Port(_ORIGINAL, o.name), ssp.Port(ssp.OUTSIDE, o.name)
        if effects[_BEHIND]:
            wires.append(ssp.Wire(start, ssp.Port(_BEHIND, PLAYED + o.name)))
            start = ssp.Port(_BEHIND, o.name)
        wires.append(ssp.Wire(start, outer))
    names: dict[ssp.Port, str] = {}
    if played is not None:
        ours = [*(i.name for i in inputs), *(o.name for o in outputs)]
        pairs = zip(ours, (*played.selected.inputs, *played.selected.outputs), strict=True)
        names = {ssp.Port(_ORIGINAL, name): known for name, known in pairs}
    return ssp.WiredParts(model.name, parts, tuple(wires), names=names)


def _side(
    part: FmuPart, name: str, inputs: Sequence[Input], outputs: Sequence[Output],
    effects: Sequence[Component],
) -> Model:  # fmt: skip
    """Return the model of one side: outputs are the inputs, in their order, but for its effects."""
    still, opened = f"{name}_still", part.component.equations
    pairs = tuple((o.name, i.name) for o, i in zip(outputs, inputs, strict=True))
    passing = Component(
        name=name,
        description=f"effects {name} the FMU",
        source=part.component.source,
        equations=Passed(pairs, still),
        states=(State(still, "1", "nothing; an FMU has a state", 1.0),),
        inputs=tuple(inputs),
        outputs=tuple(outputs),
    )
    kind = "input" if name == _BEFORE else "output"
    ports = [p for p in opened.ports if p.kind == kind] if isinstance(opened, Opened) else []
    made = part.model.with_components([ported(passing, frozenset(ports)), *effects])
    first = np.array([[i.start for i in inputs]] * 2)
    rest = start_for(made, np.array([0.0, 1.0]), first, {}).x.tolist()
    made = made.with_starts(dict(zip(made.state_names, rest, strict=True)))
    return replace(made, name=name, description=passing.description)


def _first_outputs(part: FmuPart) -> list[float]:
    """Return the outputs of an FMU at its start, with the values of a model."""
    component, played = part.component, part.component.played
    if played is None:
        return [0.0 for _ in component.outputs]
    stepped = replace(played, interface=CO_SIMULATION)  # as what holds it steps it
    starts = np.array([[i.start for i in component.inputs]])
    (outputs,) = RUNS.of([stepped.play(part.model.values, np.zeros(1), starts, "zero")])
    return [float(v) for v in outputs[0]]


_IDENTIFIER = "nested"
#: Kinds of start values in nested_config.h by the type of a variable.
_KINDS = {"Integer": "I", "Enumeration": "I", "Boolean": "B"}


@dataclass(frozen=True)
class _Shown:
    """A variable of the FMU: its name, the part and variable that it is, and its start value.

    The token is a hash of the representation of these, name of the class included.
    """

    name: str
    part: str
    variable: str
    causality: str
    start: float | None = None


@dataclass(frozen=True, eq=False)
class _Nested:
    """An FMU that holds others, in the order in which they are stepped.

    `starts` are those of the part that is not ours, by the names in it.
    """

    wiring: ssp.WiredParts
    archives: Mapping[str, Archive]
    starts: Mapping[str, float]

    @cached_property
    def variables(self) -> list[_Shown]:
        """What is wired outside, and the parameters of every part."""
        items = []
        for wire in self.wiring.wires:
            if wire.start.part == ssp.OUTSIDE:
                part, inner = wire.end.part, self.wiring.called(wire.end)
                start = self.archives[part].elements[inner].start
                items.append(_Shown(wire.start.name, part, inner, "input", start))
            elif wire.end.part == ssp.OUTSIDE:
                part, inner = wire.start.part, self.wiring.called(wire.start)
                items.append(_Shown(wire.end.name, part, inner, "output"))
        for name, archive in self.archives.items():
            for v in archive.description.modelVariables:
                if v.causality == "parameter" and v.type in ("Real", *_KINDS):
                    start = self.starts.get(v.name, archive.elements[v.name].start)
                    free = v.name if v.name not in [f.name for f in items] else f"{name}.{v.name}"
                    items.append(_Shown(free, name, v.name, "parameter", start))
        wired = {f.variable for f in items if f.causality == "input"}
        inputs = [n for n in self.archives[_ORIGINAL].names("input") if n not in wired]
        others = [n for n in inputs if n in self.starts]
        return items + [_Shown(n, _ORIGINAL, n, "input", self.starts[n]) for n in others]

    def config(self, token: str) -> str:
        """Return nested_config.h."""
        order, archives = list(self.archives), self.archives

        def reference(port: ssp.Port) -> int:
            return archives[port.part].references[self.wiring.called(port)]

        inner = [w for w in self.wiring.wires if ssp.OUTSIDE not in (w.start.part, w.end.part)]
        ends = [(w.start, w.end) for w in inner]
        references, starts = [], []
        for f in self.variables:
            references.append((archives[f.part].references[f.variable], order.index(f.part)))
            if f.start is not None:
                kind = _KINDS.get(archives[f.part].elements[f.variable].type, "R")
                starts.append((*references[-1], kind, f.start))
        return filled(
            "nested_config.h",
            parts=[(n, a.identifier, a.token, a.takes_lines) for n, a in archives.items()],
            wires=[(*map(reference, w), *(order.index(p.part) for p in w)) for w in ends],
            shown=references,
            starts=starts,
            token=token,
            target=host_platform(),
        )

    def description(self, token: str) -> bytes:
        """Return modelDescription.xml, as fmpy writes it."""
        variables: list[Any] = []
        for k, f in enumerate(self.variables):
            of = self.archives[f.part].variables[f.variable]
            real, start = of.type == "Real", None if f.start is None else repr(f.start)
            if start is not None and not real:
                whole = str(round(f.start or 0))
                start = str(bool(f.start)).lower() if of.type == "Boolean" else whole
            parameter = f.causality == "parameter"
            initial = {"parameter": "exact", "output": "calculated"}.get(f.causality)
            variables.append(
                fmi.ModelVariable(
                    name=f.name, valueReference=k, causality=f.causality,
                    type="Integer" if of.type == "Enumeration" else of.type,
                    start=start, description=of.description, initial=initial,
                    variability="fixed" if parameter else "continuous" if real else "discrete",
                )
            )  # fmt: skip
        outputs = [fmi.Unknown(variable=v) for v in variables if v.causality == "output"]
        original = self.archives[_ORIGINAL]
        described = fmi.ModelDescription(
            fmiVersion="2.0", modelName=self.wiring.name, instantiationToken=token,
            description="an FMU with the identified effects at its inputs and outputs",
            generationTool=generation_tool(), variableNamingConvention="flat",
            defaultExperiment=original.description.defaultExperiment,
            coSimulation=fmi.CoSimulation(
                modelIdentifier=_IDENTIFIER,
                canHandleVariableCommunicationStepSize=all(
                    a.description.coSimulation.canHandleVariableCommunicationStepSize
                    for a in self.archives.values()
                ),
                canInterpolateInputs=_BEFORE in self.archives or original.takes_lines,
            ),
            modelVariables=variables, outputs=outputs, initialUnknowns=outputs,
        )  # fmt: skip
        with temporary_folder() as folder:
            fmi.write_model_description(described, folder / "modelDescription.xml")
            return (folder / "modelDescription.xml").read_bytes()


def nested(
    wiring: ssp.WiredParts, fmus: Mapping[str, Path], starts: Mapping[str, float]
) -> dict[str, bytes]:
    """Return the entries of an FMU that holds others. Raises MachineError if it cannot be compiled.

    `starts` are those of the part that is not ours, by the names in it.
    """
    with ExitStack() as held:
        archives = {n: held.enter_context(Archive(fmus[n])) for n in wiring.parts}
        whole = _Nested(wiring, archives, starts)
        contents = (whole.variables, *(f.read_bytes() for f in fmus.values()))
        digest = hashlib.sha256(repr(contents).encode())
        token = f"{{{uuid.UUID(digest.hexdigest()[:32])}}}"
        target = host_platform()
        headers = files("fmpy") / "c-code"
        texts = {n: (headers / n).read_text(encoding="utf-8") for n in FMI_HEADERS[2]}
        texts["nested.c"] = (sources_directory() / "nested.c").read_text(encoding="utf-8")
        texts["nested_config.h"] = whole.config(token)
        binary = compile_library(texts, _IDENTIFIER, target)
        entries = {f"binaries/{target.binaries(2)}/{_IDENTIFIER}{target.suffix}": binary}
        for name, archive in archives.items():
            for file in archive.directory.rglob("*"):
                if file.is_file():
                    place = file.relative_to(archive.directory).as_posix()
                    entries[f"resources/{name}/{place}"] = file.read_bytes()
        entries["modelDescription.xml"] = whole.description(token)
        return entries
