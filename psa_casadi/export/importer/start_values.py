"""The identified parameters of an FMU as start values: a parameter set, or the FMU with these."""

import io
import os
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from psa_casadi.common.errors import InputError
from psa_casadi.common.files import atomic_path, atomic_write
from psa_casadi.common.notes import Note, note
from psa_casadi.export.common.parameter_sets import parameter_rows, set_text
from psa_casadi.export.importer.archive import Archive
from psa_casadi.export.importer.fmu import Fmu
from psa_casadi.export.importer.imported import digest_of, opened
from psa_casadi.export.importer.masters import Run, Signals
from psa_casadi.export.importer.played import RUNS
from psa_casadi.model.component import Component, Foreign
from psa_casadi.model.compose import Model
from psa_casadi.simulation.stepper import SimulationError

_DESCRIPTION = "modelDescription.xml"
#: Values that differ by this share are the same: those of a Float32.
_SAME = 1e-6


@dataclass(frozen=True, eq=False)
class FmuPart:
    """A model that is of an FMU, its component, and what that declares of the FMU."""

    model: Model
    component: Component
    foreign: Foreign

    @cached_property
    def fmu(self) -> Fmu:
        """The FMU as it is in its file, which is read and hashed once."""
        file = Path(self.foreign.place)
        return opened(file, digest_of(file))

    @property
    def values(self) -> dict[str, float]:
        """The values of the FMU's parameters by the names that these have in it."""
        names = self.foreign.fmu.parameters
        declared = zip(names, self.component.parameters, strict=True)
        return {n: self.model.values[p.name] for n, p in declared}

    @property
    def starts(self) -> dict[str, float]:
        """The values that are set in the FMU before its initialization, by the names in it."""
        return {**self.foreign.fmu.values, **self.values}


def fmu_part(model: Model, cure: str) -> FmuPart:
    """Return the part of a model that is an FMU; raises InputError, with a cure, if none is."""
    for component in model.components:
        if component.foreign:
            return FmuPart(model, component, component.foreign)
    raise InputError(f"The model '{model.name}' is of no FMU; {cure}.")


def save_start_values(model: Model, path: str | os.PathLike[str]) -> tuple[Note, ...]:
    """Write the parameters of an FMU's model as start values, and return what is to be noted.

    To NAME.ssv a parameter set of SSP 1.0, in the FMU's names; to NAME.fmu the FMU with these
    starts in its description. Its binary stays as it is: if that starts from other values, an
    importer must set those of the description, and a note is returned.

    Raises InputError for a model that is of no FMU, and for another ending.
    """
    target, part = Path(path), fmu_part(model, "save it with psa.save_model")
    if target.suffix.lower() == ".ssv":
        atomic_write(target, start_set(part))
        return ()
    if target.suffix.lower() != ".fmu":
        raise InputError(f"{target}: start values are written to NAME.fmu or NAME.ssv; name it so.")
    with atomic_path(target) as temporary:
        _copy(part.fmu, temporary, part.values)
    return _notes_on_binary(target, part)


def start_set(part: FmuPart) -> str:
    """Return the parameters of an FMU, and what else is set in it, as a parameter set (SSV).

    The names are the FMU's.
    """
    known = {p.name: n for p, n in zip(part.component.parameters, part.values, strict=True)}
    rows = parameter_rows(part.model)
    items = [(known[n], m, v, "" if u == "1" else u) for n, m, v, u in rows if n in known]
    items += [(n, "as it was set", v, "") for n, v in part.foreign.fmu.values.items()]
    elements = part.fmu.elements
    kinds = {n: elements[n].type for n, *_ in items if not elements[n].real}
    return set_text(part.component.name, items, kinds)


def _copy(fmu: Archive, target: Path, values: Mapping[str, float]) -> None:
    """Copy an FMU with other start values in its description."""
    changed = _starts(fmu, values)
    with zipfile.ZipFile(fmu.path) as old, zipfile.ZipFile(target, "w") as new:
        for entry in old.infolist():
            content = old.read(entry)
            if entry.filename == _DESCRIPTION:
                content = _with_starts(content, changed)
            new.writestr(entry, content)


def _starts(fmu: Archive, values: Mapping[str, float]) -> dict[str, str]:
    """Return the start of every variable of which an element has a value."""
    table: dict[str, list[float]] = {}
    for name, value in values.items():
        e = fmu.elements[name]
        table.setdefault(e.variable, list(e.starts))[e.place] = value
    return {name: " ".join(map(repr, starts)) for name, starts in table.items()}


def _with_starts(content: bytes, starts: Mapping[str, str]) -> bytes:
    for _, (prefix, uri) in ET.iterparse(io.BytesIO(content), events=["start-ns"]):
        ET.register_namespace(prefix, uri)
    parser = ET.XMLParser(target=ET.TreeBuilder(insert_comments=True))
    root = ET.fromstring(content, parser)
    for variable in root.iterfind("ModelVariables/*"):
        if variable.get("name") in starts:
            typed = variable if variable.tag != "ScalarVariable" else variable[0]
            typed.set("start", starts[str(variable.get("name"))])
    return bytes(ET.tostring(root, encoding="utf-8", xml_declaration=True))


def _notes_on_binary(path: Path, part: FmuPart) -> tuple[Note, ...]:
    """Return the note that the binary of an FMU starts with other values than its description."""
    names, nothing = tuple(part.values), Signals((), np.zeros(1), np.zeros((1, 0)))
    file = path.resolve()
    start = Run(str(file), digest_of(file), part.fmu.interfaces()[0], names, {}, nothing)
    try:
        (read,) = RUNS.of([start])
    except SimulationError:
        return ()
    other = [
        n
        for (n, v), r in zip(part.values.items(), read[0], strict=True)
        if abs(r - v) > _SAME * abs(v)
    ]
    return (note("starts_in_binary", names=tuple(other)),) if other else ()
