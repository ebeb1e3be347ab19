"""What modelDescription.xml and the binaries say by themselves, without a call."""

import math
import platform
import re
from collections.abc import Iterator
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
from psa_casadi.export.fmu.platforms import PLATFORMS, host_platform
from psa_casadi.export.importer.archive import FUNCTIONS, Archive
from psa_casadi.export.importer.binary_file import Binary, read_binary
from psa_casadi.export.importer.calls import MODEL_EXCHANGE
from psa_casadi.export.importer.fmu import Fmu
from psa_casadi.model.compose import Model
from psa_casadi.simulation.compiler import INSTALL_ZIG
from psa_casadi.units import parse_unit
from psa_casadi.variables import Publication

#: The GNU C library of the oldest systems that a portable binary loads on: of 2012, or the first.
_OLDEST_LIBC: tuple[int, ...] = (2, 17)
_FIRST_LIBC: dict[str, tuple[int, ...]] = {"riscv64-linux": (2, 27)}
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


def wrong_nominals(fmu: Fmu) -> Iterator[str]:
    """Nominal values are positive; those of the states are the same in description and binary."""
    for name, nominal in fmu.nominals.items():
        if not 0.0 < nominal < math.inf:
            yield f"'{name}' has the nominal value {nominal:g}"
    states = fmu.states()
    with fmu.start(MODEL_EXCHANGE) as instance:
        found = instance.vector("GetNominalsOfContinuousStates", len(states))
    for name, nominal in zip(states, found, strict=True):
        if nominal != fmu.nominals[name]:
            yield f"'{name}' has another nominal value in the binary, {nominal:g}"


def missing_functions(archive: Archive) -> Iterator[str]:
    """Every function of the standard is in every binary, as importers look them all up."""
    for place, binary in _binaries(archive):
        for name in _functions(archive) - binary.exports:
            yield f"{name} is missing in {place}"


def needless_symbols(archive: Archive) -> Iterator[str]:
    """Nothing but the functions of the standard is exported: two FMUs in a process stay apart."""
    for place, binary in _binaries(archive):
        for name in binary.exports - _functions(archive):
            yield f"{name} is exported by {place}"


def new_libraries(archive: Archive, *, portable: bool = False) -> Iterator[str]:
    """No Linux binary needs a newer GNU C library than the systems have that it is for.

    One for this machine's platform is for systems like this one, as its own compiler makes it. All
    others, and every one if `portable`, are for systems from 2.17 (of 2012) on, or 2.27 on RISC-V.
    """
    for place, binary in _binaries(archive):
        have = _FIRST_LIBC.get(binary.platform, _OLDEST_LIBC)
        if not portable and binary.platform == host_platform().name:
            have = max(have, _libc(platform.libc_ver()[1]) or have)
        for need in _libc_needs(binary):
            if (_libc(need) or (math.inf,)) > have:
                yield (
                    f"{place} needs GLIBC_{need}, which systems with GNU libc {_dotted(have)} lack;"
                    f" for one that loads there run `{INSTALL_ZIG}` and export it again"
                )


def oldest_systems(archive: Archive) -> str:
    """Return what the Linux binaries load on, "" if none needs the GNU C library."""
    newest = {
        place: max(filter(None, map(_libc, _libc_needs(binary))), default=())
        for place, binary in _binaries(archive)
    }
    return "; ".join(
        f"{p} loads on GNU libc {_dotted(v)} and later" for p, v in newest.items() if v
    )


def _libc_needs(binary: Binary) -> list[str]:
    return sorted(n.removeprefix("GLIBC_") for n in binary.needs if n.startswith("GLIBC_"))


def _libc(version: str) -> tuple[int, ...] | None:
    """Return the numbers of a version of the GNU C library, None if it has others than numbers."""
    parts = version.split(".")
    return tuple(map(int, parts)) if all(p.isdigit() for p in parts) else None


def _dotted(version: tuple[int, ...]) -> str:
    return ".".join(map(str, version))


def misplaced_binaries(archive: Archive) -> Iterator[str]:
    """Every binary is for the platform of its folder; importers load it by the folder alone."""
    for place, binary in _binaries(archive):
        known = PLATFORMS.get(binary.platform)
        if (known.binaries(archive.version) if known else binary.platform) != place:
            yield f"{place} holds a binary for {binary.platform}, which does not load there"


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


def _functions(archive: Archive) -> frozenset[str]:
    return frozenset(archive.prefix + name for name in FUNCTIONS[archive.version])


def _binaries(archive: Archive) -> Iterator[tuple[str, Binary]]:
    """Yield folder and binary, one after the other; an archive without any is an error."""
    count = 0
    for path in archive.binaries():
        yield path.parent.name, read_binary(path)
        count += 1
    if not count:
        raise InputError("The FMU has no binary; export it with --platforms host or all.")
