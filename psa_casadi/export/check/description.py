"""What modelDescription.xml says by itself, without a call."""

import math
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import fields, replace
from typing import Any

import fmpy
from fmpy.model_description import ValidationError

from psa_casadi.errors import InputError
from psa_casadi.export.common.publication import (
    LICENSE_ENTRY,
    SOURCES_NOTICE,
    code_license,
    copyright_line,
    terms_of_code,
)
from psa_casadi.export.importer.archive import Archive
from psa_casadi.model.compose import Model
from psa_casadi.units import parse_unit
from psa_casadi.variables import Publication

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


def _reals(archive: Archive) -> list[Any]:
    kinds = ("Real", "Float64")
    return [v for v in archive.description.modelVariables if v.type in kinds]


def undefined_units(archive: Archive) -> Iterator[str]:
    """Every variable but an event indicator has a unit, with a definition; so has its display."""
    units = archive.description.unitDefinitions
    defined = {u.name: {d.name for d in u.displayUnits} for u in units}
    for v in _reals(archive):
        if v.unit is None and v.name in archive.indicators():
            continue
        if v.unit not in defined:
            yield f"'{v.name}' has the unit '{v.unit}', which is not defined"
        elif v.displayUnit and v.displayUnit not in defined[v.unit]:
            yield f"'{v.name}' has the undefined display unit '{v.displayUnit}'"


def inconsistent_units(archive: Archive) -> Iterator[str]:
    """A unit is defined as what its name says, and a derivative has the unit of its state per s."""
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
    places = [LICENSE_ENTRY]
    places += [f"sources/{SOURCES_NOTICE}"] if (archive.directory / "sources").is_dir() else []
    for place in places:
        path = archive.directory / place
        if not path.is_file():
            yield f"{place} is missing"
        elif code_license() not in path.read_text(encoding="utf-8", errors="replace"):
            yield f"{place} lacks the notice '{copyright_line()}' with its terms"


def published_as(archive: Archive, model: Model) -> Model:
    """Return the model with author, version and terms as the FMU states them.

    They are given at the export, and say nothing of what the model computes.
    """
    said = {f.name: getattr(archive.description, f.name) or "" for f in fields(Publication)}
    unstated = terms_of_code()
    own = {name: text for name, text in said.items() if text != unstated.get(name)}
    return replace(model, publication=Publication(**own))


#: The checks by the names of their rows.
DESCRIBED: dict[str, Callable[[Archive], Iterable[str]]] = {
    "description valid": invalid,
    "units defined": undefined_units,
    "units consistent": inconsistent_units,
    "licence inside": missing_notices,
}
