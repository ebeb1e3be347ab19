"""What was identified of an FMU as its start values: a parameter set, or the FMU with these."""

import io
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree as ET

from psa_casadi.component import Component
from psa_casadi.errors import InputError, PsaError
from psa_casadi.export.common.parameter_sets import parameter_rows, set_text
from psa_casadi.export.importer.archive import Archive
from psa_casadi.export.importer.fmu import Fmu
from psa_casadi.files import atomic_path, atomic_write
from psa_casadi.model.compose import Model
from psa_casadi.notes import Note, note

_DESCRIPTION = "modelDescription.xml"
#: Values that differ by this share are the same: those of a Float32.
_SAME = 1e-6


def save_start_values(model: Model, path: str | os.PathLike[str]) -> tuple[Note, ...]:
    """Write the parameters of an FMU's model as start values, and return what is to be noted.

    To NAME.ssv a parameter set of SSP 1.0, in the FMU's names; to NAME.fmu the FMU with these
    starts in its description. Its binary stays as it is: where that has starts of its own, an
    importer must set those of the description, which the note says.

    Raises InputError for a model that is of no FMU, and for another ending.
    """
    target, item = Path(path), [c for c in model.components if c.foreign]
    if not item:
        raise InputError(f"The model '{model.name}' is of no FMU; save it with psa.save_model.")
    component = item[0]
    values = fmu_values(model, component)
    if target.suffix.lower() == ".ssv":
        atomic_write(target, start_set(model, component))
        return ()
    if target.suffix.lower() != ".fmu":
        raise InputError(f"{target}: start values are written to NAME.fmu or NAME.ssv; name it so.")
    place = Path(component.foreign.place) if component.foreign else target
    with atomic_path(target) as temporary:
        _copy(place, temporary, values)
    return _kept_by(target, values)


def start_set(model: Model, component: Component) -> str:
    """Return the parameters of an FMU as a parameter set (SSV), in the names that it has.

    And what else was set in it.
    """
    item = (p.name for p in component.parameters)
    known = dict(zip(item, fmu_values(model, component), strict=True))
    rows = parameter_rows(model)
    items = [(known[n], m, v, "" if u == "1" else u) for n, m, v, u in rows if n in known]
    fixed = component.foreign.fmu.values if component.foreign else {}
    items += [(n, "as it was set", v, "") for n, v in fixed.items()]
    with Archive(Path(component.foreign.place if component.foreign else "")) as archive:
        kinds = {n: archive.elements[n].type for n, *_ in items if not archive.elements[n].real}
    return set_text(component.name, items, kinds)


def fmu_values(model: Model, component: Component) -> dict[str, float]:
    """Return the values of an FMU's parameters by the names that these have in it."""
    names = component.foreign.fmu.parameters if component.foreign else ()
    return {n: model.values[p.name] for n, p in zip(names, component.parameters, strict=True)}


def fmu_starts(model: Model, component: Component) -> dict[str, float]:
    """Return what is set in an FMU before its initialization, by the names in it."""
    fixed = component.foreign.fmu.values if component.foreign else {}
    return {**fixed, **fmu_values(model, component)}


def _copy(place: Path, target: Path, values: Mapping[str, float]) -> None:
    """Copy an FMU with other start values in its description."""
    with Archive(place) as of:
        changed = _starts(of, values)
    with zipfile.ZipFile(place) as old, zipfile.ZipFile(target, "w") as new:
        for entry in old.infolist():
            content = old.read(entry)
            if entry.filename == _DESCRIPTION:
                content = _with_starts(content, changed)
            new.writestr(entry, content)


def _starts(of: Archive, values: Mapping[str, float]) -> dict[str, str]:
    """Return the start of every variable of which an element has a value."""
    table: dict[str, list[float]] = {}
    for name, value in values.items():
        e = of.elements[name]
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


def _kept_by(path: Path, values: Mapping[str, float]) -> tuple[Note, ...]:
    """Return the note that the binary of an FMU starts with other values than its description."""
    try:
        with Fmu(path) as fmu, fmu.open(fmu.interfaces()[0]) as instance:
            instance.setup()
            read = instance.get(list(values))
    except PsaError:
        return ()
    items = [
        n for (n, v), r in zip(values.items(), read, strict=True) if abs(r - v) > _SAME * abs(v)
    ]
    return (note("starts_in_binary", names=tuple(items)),) if items else ()
