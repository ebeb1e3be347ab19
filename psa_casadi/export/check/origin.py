"""What an FMU says against the model that it was made from."""

from collections.abc import Iterator
from typing import Any

from psa_casadi.export.common.markup import generation_tool
from psa_casadi.export.common.variable_table import variable_table
from psa_casadi.export.fmu.archive import DESCRIPTIONS
from psa_casadi.export.fmu.dependencies import Key, dependencies, without_sampled
from psa_casadi.export.fmu.sources import compiled_files, export_token, source_files
from psa_casadi.export.importer.archive import Archive
from psa_casadi.model.compose import Model

_XML = "modelDescription.xml"


def wrong_start_values(archive: Archive, model: Model) -> Iterator[str]:
    """The start values of parameters are the model's values; those of states and inputs too."""
    starts = {v.name: v.start for v in archive.description.modelVariables}
    for variable in variable_table(model):
        name, value = variable.name, variable.start
        if variable.kind == "parameter" and name not in starts:
            yield f"the parameter '{name}' of the model is not in the FMU"
        elif value is not None and (starts.get(name) is None or float(starts[name]) != value):
            yield f"'{name}' starts at {starts.get(name)}, the model has {value!r}"


def wrong_dependencies(archive: Archive, model: Model) -> Iterator[str]:
    """The dependencies are the sparsity of the model's Jacobian: none missing, none superfluous."""
    names = {(v.kind, v.index): v.name for v in variable_table(model)}
    found = {names[unknown]: known for unknown, known in dependencies(model.structure).items()}
    initial = {n: {names[k]: kind for k, kind in known.items()} for n, known in found.items()}
    truth = {
        n: {names[k]: kind for k, kind in without_sampled(known).items()}
        for n, known in found.items()
    }
    yield from _listed(archive, names)
    described = archive.description
    indicators = described.eventIndicators if archive.version == 3 else []
    for entry in (*described.outputs, *described.derivatives, *indicators):
        yield from _differences(entry, truth.get(entry.variable.name, {}), kinds=True)
    for entry in described.initialUnknowns:
        yield from _differences(entry, initial.get(entry.variable.name, {}), kinds=False)


def _listed(archive: Archive, names: dict[Key, str]) -> Iterator[str]:
    """The lists of outputs and derivatives name those of the model, in its order."""
    described = archive.description
    for kind, entries in (("output", described.outputs), ("derivative", described.derivatives)):
        expected = [name for (found, _), name in names.items() if found == kind]
        if [e.variable.name for e in entries] != expected:
            yield f"the list of {kind}s is not the model's: {', '.join(expected)}"


def _differences(entry: Any, truth: dict[str, str], *, kinds: bool) -> Iterator[str]:
    unknown = entry.variable.name
    claimed = [v.name for v in entry.dependencies or []]
    for known in sorted(truth.keys() - set(claimed)):
        yield f"'{unknown}' depends on '{known}', which its dependencies do not list"
    for known in sorted(set(claimed) - truth.keys()):
        yield f"'{unknown}' does not depend on '{known}', which its dependencies list"
    if kinds:
        for known, kind in zip(claimed, entry.dependenciesKind or [], strict=False):
            if kind != truth.get(known, kind):
                yield f"'{unknown}' depends on '{known}' in the way '{truth[known]}', not '{kind}'"


def unreproducible_parts(archive: Archive, model: Model) -> Iterator[str]:
    """Exported again, the model gives the same description, token and sources, byte for byte."""
    tool = str(archive.description.generationTool)
    if tool != generation_tool():
        yield f"it was exported by {tool}, this is {generation_tool()}; export it again to compare"
        return
    token = export_token(model, archive.identifier, archive.version)
    if token != archive.token:
        yield f"the token is {archive.token}, not {token}"
    texts = source_files(model, archive.identifier, token, archive.version)
    describe = DESCRIPTIONS[archive.version]
    expected = {f"sources/{name}": text for name, text in texts.items()}
    expected[_XML] = describe(model, archive.identifier, token, compiled_files(texts))
    found = {p.relative_to(archive.directory).as_posix(): p for p in archive.directory.rglob("*")}
    for name, text in sorted(expected.items()):
        if name not in found:
            yield f"{name} is missing"
        elif found[name].read_bytes() != text.encode("utf-8"):
            yield f"{name} differs"
    more = {n for n, p in found.items() if n.startswith("sources/") and p.is_file()} - set(expected)
    for name in sorted(more):
        yield f"{name} is not among the sources of the model"
