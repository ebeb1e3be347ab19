"""FMUs in the resources of one FMU, which steps them in turn (fmu_src/nested.c)."""

import hashlib
import uuid
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from fmpy.model_description import (
    CoSimulation,
    ModelDescription,
    ModelVariable,
    Unknown,
    write_model_description,
)

from psa_casadi.common.files import temporary_folder
from psa_casadi.export.common.markup import generation_tool
from psa_casadi.export.fmu.platforms import Platform, compile_library, host_platform
from psa_casadi.export.fmu.sources import FMI_HEADERS
from psa_casadi.export.importer.archive import Archive
from psa_casadi.export.ssp import OUTSIDE, Port, WiredParts
from psa_casadi.simulation.compiler import sources_directory

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


def nested(
    wiring: WiredParts, fmus: Mapping[str, Path], starts: Mapping[str, float]
) -> dict[str, bytes]:
    """Return the entries of an FMU that holds others, in the order in which they are stepped.

    `starts` are those of the part that is not ours, by the names in it. Raises MachineError where
    it cannot be compiled.
    """
    with ExitStack() as held:
        archives = {n: held.enter_context(Archive(fmus[n])) for n in wiring.parts}
        variables = _variables(wiring, archives, starts)
        digest = hashlib.sha256(
            repr((variables, *(f.read_bytes() for f in fmus.values()))).encode()
        )
        token = f"{{{uuid.UUID(digest.hexdigest()[:32])}}}"
        target = host_platform()
        headers = files("fmpy") / "c-code"
        texts = {n: (headers / n).read_text(encoding="utf-8") for n in FMI_HEADERS[2]}
        texts["nested.c"] = (sources_directory() / "nested.c").read_text(encoding="utf-8")
        texts["nested_config.h"] = _config(wiring, archives, variables, token)
        binary = compile_library(texts, _IDENTIFIER, target)
        entries = {f"binaries/{target.binaries(2)}/{_IDENTIFIER}{target.suffix}": binary}
        for name, archive in archives.items():
            for file in archive.directory.rglob("*"):
                if file.is_file():
                    place = file.relative_to(archive.directory).as_posix()
                    entries[f"resources/{name}/{place}"] = file.read_bytes()
        entries["modelDescription.xml"] = _description(wiring, archives, variables, token)
        return entries


def _variables(
    wiring: WiredParts, archives: Mapping[str, Archive], starts: Mapping[str, float]
) -> list[_Shown]:
    """Return the variables: what is wired outside, and the parameters of every part."""
    items = []
    for wire in wiring.wires:
        if wire.start.part == OUTSIDE:
            part, inner = wire.end.part, wiring.called(wire.end)
            start = archives[part].elements[inner].start
            items.append(_Shown(wire.start.name, part, inner, "input", start))
        elif wire.end.part == OUTSIDE:
            part, inner = wire.start.part, wiring.called(wire.start)
            items.append(_Shown(wire.end.name, part, inner, "output"))
    for name, archive in archives.items():
        for v in archive.description.modelVariables:
            if v.causality == "parameter" and v.type in ("Real", *_KINDS):
                start = starts.get(v.name, archive.elements[v.name].start)
                free = v.name if v.name not in [f.name for f in items] else f"{name}.{v.name}"
                items.append(_Shown(free, name, v.name, "parameter", start))
    inputs = {f.variable for f in items if f.causality == "input"}
    others = [n for n in archives["original"].names("input") if n in starts and n not in inputs]
    items += [_Shown(n, "original", n, "input", starts[n]) for n in others]
    return items


def _config(
    wiring: WiredParts, archives: Mapping[str, Archive], variables: list[_Shown], token: str
) -> str:
    """Return nested_config.h of parts that are wired."""
    order = list(archives)

    def variable(part: str, name: str) -> str:
        return f"{{{archives[part].references[name]}u, {order.index(part)}"

    def reference(port: Port) -> int:
        return archives[port.part].references[wiring.called(port)]

    parts = [
        f'{{"{n}", "{a.identifier}", "{a.token}", {int(a.takes_lines)}}}'
        for n, a in archives.items()
    ]
    wires = [
        f"{{{reference(w.start)}u, {reference(w.end)}u, {order.index(w.start.part)},"
        f" {order.index(w.end.part)}}}"
        for w in wiring.wires
        if OUTSIDE not in (w.start.part, w.end.part)
    ]
    places = [variable(f.part, f.variable) + "}" for f in variables]
    starts = [
        f"{variable(f.part, f.variable)},"
        f" '{_KINDS.get(archives[f.part].elements[f.variable].type, 'R')}', {f.start!r}}}"
        for f in variables
        if f.start is not None
    ]
    return config_text(parts, wires, places, starts, token, host_platform())


def config_text(
    parts: list[str],
    wires: list[str],
    places: list[str],
    starts: list[str],
    token: str,
    target: Platform,
) -> str:
    """Return nested_config.h with the initializers of its arrays."""
    sizes = {"PARTS": parts, "WIRES": wires, "SHOWN": places, "STARTS": starts}
    return "".join(
        [
            *(f"#define NESTED_{n} {len(q)}\n" for n, q in sizes.items()),
            f'#define NESTED_TOKEN "{token}"\n',
            f'#define NESTED_PLATFORM "{target.binaries(2)}"\n',
            f'#define NESTED_SUFFIX "{target.suffix}"\n',
            "static const struct {\n    const char *folder, *identifier, *token;\n    int lines;\n"
            f"}} NESTED[] = {{{', '.join(parts)}}};\n",
            "static const struct {\n    fmi2ValueReference output, input;\n    int from, to;\n"
            f"}} WIRES[] = {{{', '.join([*wires, '{0u, 0u, -1, -1}'])}}};\n",
            "static const struct {\n    fmi2ValueReference variable;\n    int part;\n"
            f"}} SHOWN[] = {{{', '.join(places)}}};\n",
            "static const struct {\n    fmi2ValueReference variable;\n    int part;\n"
            "    char kind;\n    double value;\n"
            f"}} STARTS[] = {{{', '.join([*starts, '{0u, 0, 0, 0.0}'])}}};\n",
        ]
    )


def _description(
    wiring: WiredParts, archives: Mapping[str, Archive], listed: list[_Shown], token: str
) -> bytes:
    """Return modelDescription.xml, as fmpy writes it."""
    variables: list[Any] = []
    for k, f in enumerate(listed):
        of = archives[f.part].variables[f.variable]
        real, start = of.type == "Real", None if f.start is None else repr(f.start)
        if start is not None and not real:
            start = str(bool(f.start)).lower() if of.type == "Boolean" else str(round(f.start or 0))
        parameter = f.causality == "parameter"
        variables.append(
            ModelVariable(
                name=f.name, valueReference=k, causality=f.causality,
                type="Integer" if of.type == "Enumeration" else of.type,
                start=start, description=of.description,
                variability="fixed" if parameter else "continuous" if real else "discrete",
                initial="exact" if parameter else "calculated" if f.causality == "output" else None,
            )
        )  # fmt: skip
    outputs = [Unknown(variable=v) for v in variables if v.causality == "output"]
    model_description = ModelDescription(
        fmiVersion="2.0", modelName=wiring.name, instantiationToken=token,
        description="an FMU with what was found at its inputs and outputs",
        generationTool=generation_tool(), variableNamingConvention="flat",
        defaultExperiment=archives["original"].description.defaultExperiment,
        coSimulation=CoSimulation(
            modelIdentifier=_IDENTIFIER,
            canHandleVariableCommunicationStepSize=all(
                a.description.coSimulation.canHandleVariableCommunicationStepSize
                for a in archives.values()
            ),
            canInterpolateInputs="before" in archives or archives["original"].takes_lines,
        ),
        modelVariables=variables, outputs=outputs, initialUnknowns=outputs,
    )  # fmt: skip
    with temporary_folder() as folder:
        write_model_description(model_description, folder / "modelDescription.xml")
        return (folder / "modelDescription.xml").read_bytes()
