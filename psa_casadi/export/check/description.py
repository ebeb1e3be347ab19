"""The checks of modelDescription.xml, without a call of the FMU."""

import math
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import fields, replace
from typing import Any

import casadi as ca
import fmpy
from fmpy.model_description import ValidationError

from psa_casadi.common.errors import InputError
from psa_casadi.common.units import parse_unit
from psa_casadi.export.check.rows import CheckRow
from psa_casadi.export.common import publication
from psa_casadi.export.common.markup import generation_tool
from psa_casadi.export.common.variable_table import variable_table
from psa_casadi.export.fmu import sources
from psa_casadi.export.fmu.archive import planned_step
from psa_casadi.export.fmu.description import Key, at_the_start, dependencies, without_sampled
from psa_casadi.export.importer.archive import Archive
from psa_casadi.model.component import KeptEquations
from psa_casadi.model.compose import Model
from psa_casadi.model.variables import Publication

_BASE = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
#: Names by FMI's grammar of the convention "structured" (FMI 2.0.4, 2.2.9; FMI 3.0.2, 2.4.7.5.1), a
#: pattern whose work is linear in their length; the convention "flat" bars three characters.
_QUOTED = r"""'(?:[\w !#$%&()*+,./:;<=>?@\[\]^{}|~-]|\\['"?\\abfnrtv])+'"""
_PART = rf"(?:[A-Za-z_]\w*|{_QUOTED})(?:\[\d+(?:,\d+)*\])?"
_PARTS = rf"{_PART}(?:\.{_PART})*"
_NAMES = {
    "structured": re.compile(rf"{_PARTS}|der\({_PARTS}(?:,\d+)?\)", re.ASCII),
    "flat": re.compile(r"[^\r\n\t]+"),
}


def invalid(archive: Archive) -> Iterator[str]:
    """What fmpy finds wrong with the description, but its check of names: that takes 1 ms each."""
    try:
        fmpy.read_model_description(str(archive.directory), validate_model_structure=True)
    except ValidationError as error:
        yield from (" ".join(str(problem).split()) for problem in error.problems)
    except Exception as error:  # noqa: BLE001 - fmpy raises it for any damage
        yield str(error)
    convention = archive.description.variableNamingConvention
    for v in archive.description.modelVariables:
        if not _NAMES.get(convention, _NAMES["structured"]).fullmatch(v.name):
            yield f"'{v.name}' (line {v.sourceline}) is no name of the convention '{convention}'"


def undefined_units(archive: Archive) -> Iterator[str]:
    """Every variable but an event indicator has a unit, with a definition; so has its display."""
    units = archive.description.unitDefinitions
    defined = {u.name: {d.name for d in u.displayUnits} for u in units}
    for v in archive.description.modelVariables:
        real = v.type in ("Real", "Float64")
        if not real or (v.unit is None and v.name in archive.indicators()):
            continue
        if v.unit not in defined:
            yield f"'{v.name}' has the unit '{v.unit}', which is not defined"
        elif v.displayUnit and v.displayUnit not in defined[v.unit]:
            yield f"'{v.name}' has the undefined display unit '{v.displayUnit}'"


def inconsistent_units(archive: Archive) -> Iterator[str]:
    """A unit is defined as its name is, and a derivative has the unit of its state per s."""
    powers = {}
    for unit in archive.description.unitDefinitions:
        base = unit.baseUnit
        if base is None:
            yield f"the unit '{unit.name}' has no definition in base units"
            continue
        powers[unit.name] = {n: int(getattr(base, n)) for n in _BASE if int(getattr(base, n))}
        yield from _misnamed(unit, powers[unit.name])
    for entry in archive.description.derivatives:
        rate, state = entry.variable, entry.variable.derivative
        expected = dict(powers.get(state.unit, {}))
        expected["s"] = expected.get("s", 0) - 1
        if powers.get(rate.unit) != {n: k for n, k in expected.items() if k}:
            yield f"'{rate.name}' is in '{rate.unit}', but '{state.name}' is in '{state.unit}'"


def _misnamed(unit: Any, powers: dict[str, int]) -> Iterator[str]:
    """Compare a definition, and the factors of its display units, with the names."""
    try:
        meant = parse_unit(unit.name)
        expected = {n: k for n, k in meant.base_exponents.items() if k}
        if powers != expected or not math.isclose(float(unit.baseUnit.factor), meant.factor):
            yield f"the unit '{unit.name}' is defined as {powers or 'no unit'}"
        for display in unit.displayUnits:
            factor = float(meant.ratio / parse_unit(display.name).ratio)
            if not math.isclose(float(display.factor), factor):
                yield f"the display unit '{display.name}' has the factor {display.factor}"
    except InputError as error:
        yield f"the unit '{unit.name}' is not known: {error}"


def missing_notices(archive: Archive) -> Iterator[str]:
    """An FMU with C code of this package states its licence and holds the notice of that code."""
    for name in ("license", "copyright"):
        if not getattr(archive.description, name):
            yield f"the description states no {name}"
    if not str(archive.description.generationTool).startswith("psa_casadi"):
        return
    places = [publication.LICENSE_ENTRY]
    places += (
        [f"sources/{publication.SOURCES_NOTICE}"]
        if (archive.directory / "sources").is_dir()
        else []
    )
    for place in places:
        path = archive.directory / place
        if not path.is_file():
            yield f"{place} is missing"
        elif publication.code_license() not in path.read_text(encoding="utf-8", errors="replace"):
            yield f"{place} lacks the notice '{publication.copyright_line()}' with its terms"


def published_as(archive: Archive, model: Model) -> Model:
    """Return the model with author, version and terms as the FMU states them.

    They are arguments of the export and change nothing that the model computes.
    """
    texts = {f.name: getattr(archive.description, f.name) or "" for f in fields(Publication)}
    defaults = publication.terms_of_code()
    stated = {name: text for name, text in texts.items() if text != defaults.get(name)}
    return replace(model, publication=Publication(**stated))


#: The checks by the names of their rows.
DESCRIBED: dict[str, Callable[[Archive], Iterable[str]]] = {
    "description valid": invalid,
    "units defined": undefined_units,
    "units consistent": inconsistent_units,
    "licence inside": missing_notices,
}


_XML = "modelDescription.xml"
_CASADI = re.compile(r"generated by CasADi (\d[\w.+-]*?)\.?\n")


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

    def named(table: dict[Key, dict[Key, str]]) -> dict[str, dict[str, str]]:
        return {
            names[unknown]: {names[k]: kind for k, kind in known.items()}
            for unknown, known in table.items()
        }

    table = dependencies(model.structure)
    truth = named({unknown: without_sampled(known) for unknown, known in table.items()})
    initial = named(at_the_start(model))
    if sources.fixed_step_of(archive.directory) is not None:  # there parameters are constants
        for claims in (*truth.values(), *initial.values()):
            for parameter in model.parameter_names:
                claims.pop(parameter, None)
    described = archive.description
    for kind, entries in (("output", described.outputs), ("derivative", described.derivatives)):
        expected = [name for (found_kind, _), name in names.items() if found_kind == kind]
        if [e.variable.name for e in entries] != expected:
            yield f"the list of {kind}s is not the model's: {', '.join(expected)}"
    indicators = described.eventIndicators if archive.version == 3 else []
    for entry in (*described.outputs, *described.derivatives, *indicators):
        yield from _differences(entry, truth.get(entry.variable.name, {}), kinds=True)
    for entry in described.initialUnknowns:
        yield from _differences(entry, initial.get(entry.variable.name, {}), kinds=False)


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
    """Exported again, the model gives the same description, token and sources, byte for byte.

    Another version of CasADi writes other C for the same equations, and so does this one where they
    were read from text: the sources are then taken as they are; their token shows whether they
    were changed.
    """
    tool = str(archive.description.generationTool)
    if tool != generation_tool():
        yield f"it was exported by {tool}, this is {generation_tool()}; export it again to compare"
        return
    contents = {
        p.relative_to(archive.directory).as_posix(): p.read_bytes()
        for p in archive.directory.rglob("*")
        if p.is_file()
    }
    untouched = {}
    if _other_casadi(archive) or _read_from_text(model):
        places = {name: f"sources/{name}" for name in sources.FROM_CASADI}
        untouched = {n: contents[p].decode() for n, p in places.items() if p in contents}
    step = sources.fixed_step_of(archive.directory)
    fixed = planned_step(model, archive.identifier, archive.version, step) if step else None
    token, texts, xml = sources.exported_texts(
        model, archive.identifier, archive.version, fixed, kept=untouched
    )
    if token != archive.token:
        yield f"the token is {archive.token}, not {token}"
    expected = {f"sources/{name}": text for name, text in texts.items()}
    expected[_XML] = xml
    if fixed:
        expected[sources.FIXED_ENTRY] = sources.fixed_entry(fixed).decode("utf-8")
    for name, text in sorted(expected.items()):
        if name not in contents:
            yield f"{name} is missing"
        elif contents[name] != text.encode("utf-8"):
            yield f"{name} differs"
    for name in sorted({n for n in contents if n.startswith("sources/")} - set(expected)):
        yield f"{name} is not among the sources of the model"


def reproducible(archive: Archive, model: Model) -> Iterable[str] | CheckRow:
    """Return what differs in the export made again, or a row with what was taken as it is."""
    problems, other = list(unreproducible_parts(archive, model)), _other_casadi(archive)
    if problems:
        return problems
    made = f"CasADi {other}'s, unchanged since; this is CasADi {ca.CasadiMeta.version()}"
    if not other:
        made = "unchanged since; equations that are read from text have another order"
    remark = f"its C is {made}: 'equations' compares"
    taken = bool(other) or _read_from_text(model)
    return CheckRow("reproducible", 0.0, 0.0, True, remark if taken else "")


def _read_from_text(model: Model) -> bool:
    """Return whether equations of a model come from the text of a MODEL.json."""
    plain = [getattr(c.equations, "component", c).equations for c in model.components]
    return any(isinstance(e, KeptEquations) for e in plain)


def _other_casadi(archive: Archive) -> str:
    """Return the version of CasADi that an FMU was made with; empty if it is the one in use."""
    source = archive.directory / "sources" / "model.c"
    try:
        match = _CASADI.search(source.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError):
        return ""
    return match[1] if match and match[1] != ca.CasadiMeta.version() else ""
