"""What the binaries of an FMU export and need, for every platform; lief reads them.

It reads them in the process of the foreign code, as a hostile file may end it.
"""

import math
import platform
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import fmpy.fmi2
import fmpy.fmi3

from psa_casadi.common.errors import InputError
from psa_casadi.export.check.rows import OF_BINARIES, Check, CheckRow, plain
from psa_casadi.export.fmu.platforms import PLATFORMS, host_platform
from psa_casadi.export.importer.archive import Archive
from psa_casadi.simulation.compiler import INSTALL_ZIG

#: The GNU C library of the oldest systems that a portable binary loads on: of 2012, or the first.
_OLDEST_LIBC: tuple[int, ...] = (2, 17)
_FIRST_LIBC: dict[str, tuple[int, ...]] = {"riscv64-linux": (2, 27)}
#: What Apple's linker exports from every library.
_LINKER = {"__mh_dylib_header", "___dso_handle", "__mh_execute_header"}
#: lief's words for the machines, in those of FMI 3's platform tuples.
_MACHINES = {
    "I386": "x86", "AMD64": "x86_64", "X86_64": "x86_64", "ARM": "aarch32", "AARCH64": "aarch64",
    "ARM64": "aarch64", "RISCV": "riscv64",
}  # fmt: skip
#: The functions of each version of the standard.
FUNCTIONS = {
    2: frozenset(
        n for c in (fmpy.fmi2.FMU2Model, fmpy.fmi2.FMU2Slave) for n in dir(c) if n[:4] == "fmi2"
    ),
    3: frozenset(n for n in dir(fmpy.fmi3.FMU3Slave) if n[:4] == "fmi3"),
}


@dataclass(frozen=True)
class Binary:
    """A library: platform, functions it exports, versions of libraries it needs.

    `platform` is FMI 3's tuple, such as "riscv64-linux"; `needs` has names such as GLIBC_2.2.5 and
    is empty for other systems than Linux.
    """

    platform: str
    exports: frozenset[str]
    needs: frozenset[str] = frozenset()


def has_lief() -> bool:
    """Return whether binaries can be inspected."""
    return find_spec("lief") is not None


def binary_checks(archive: Archive, *, portable: bool) -> Iterator[Check]:
    """Yield the checks of the binaries, none without lief."""
    if has_lief():
        listed = (missing_functions, needless_symbols, misplaced_binaries)
        for name, check in zip(OF_BINARIES, listed, strict=False):
            yield Check(name, partial(check, archive))
        yield Check(OF_BINARIES[-1], partial(libc_row, archive, portable=portable))


@cache
def read_binary(path: Path) -> Binary:
    """Return what a library exports and needs. Raises InputError if it is none."""
    import lief  # noqa: PLC0415 - an extra

    lief.logging.disable()
    result: Any = lief.parse(str(path))
    if isinstance(result, lief.ELF.Binary):
        required = result.symbols_version_requirement
        needs = {str(v.name) for r in required for v in r.get_auxiliary_symbols()}
        exports = {str(s.name) for s in result.exported_symbols}
        machine, system = result.header.machine_type.name, "linux"
    elif isinstance(result, lief.PE.Binary):
        needs, table = set(), result.get_export()
        exports = {str(e.name) for e in table.entries} if table else set()
        machine, system = result.header.machine.name, "windows"
    elif isinstance(result, lief.MachO.Binary):
        names = {str(s.name) for s in result.exported_symbols} - _LINKER
        needs, exports = set(), {n.removeprefix("_") for n in names}
        machine, system = result.header.cpu_type.name, "darwin"
    else:
        raise InputError(f"{path.name}: is no binary of a known format; export the FMU again.")
    known = f"{_MACHINES.get(machine, 'unknown')}-{system}"
    return Binary(known, frozenset(exports), frozenset(needs))


def _binaries(archive: Archive) -> Iterator[tuple[str, Binary]]:
    """Yield folder and binary, one after the other; an archive without any is an error."""
    count = 0
    for path in archive.binaries():
        yield path.parent.name, read_binary(path)
        count += 1
    if not count:
        raise InputError("The FMU has no binary; export it with --platforms host or all.")


def missing_functions(archive: Archive) -> Iterator[str]:
    """Every function of the standard is in every binary, as importers look them all up."""
    for place, binary in _binaries(archive):
        for name in FUNCTIONS[archive.version] - binary.exports:
            yield f"{name} is missing in {place}"


def needless_symbols(archive: Archive) -> Iterator[str]:
    """Nothing but the functions of the standard is exported: two FMUs in a process stay apart."""
    for place, binary in _binaries(archive):
        for name in binary.exports - FUNCTIONS[archive.version]:
            yield f"{name} is exported by {place}"


def misplaced_binaries(archive: Archive) -> Iterator[str]:
    """Every binary is for the platform of its folder; importers load it by the folder alone."""
    for place, binary in _binaries(archive):
        known = PLATFORMS.get(binary.platform)
        if (known.binaries(archive.version) if known else binary.platform) != place:
            yield f"{place} holds a binary for {binary.platform}, which does not load there"


def libc_row(archive: Archive, *, portable: bool = False) -> CheckRow:
    """No Linux binary needs a newer GNU C library than the systems have that it is for.

    One for this machine's platform is for systems like this one, as its compiler makes it. All
    others, and every one if `portable`, are for systems from 2.17 (of 2012) on, or 2.27 on RISC-V.
    """
    problems, oldest = [], []
    for place, binary in _binaries(archive):
        have = _FIRST_LIBC.get(binary.platform, _OLDEST_LIBC)
        if not portable and binary.platform == host_platform().name:
            have = max(have, _libc(platform.libc_ver()[1]) or have)
        needs = sorted(n.removeprefix("GLIBC_") for n in binary.needs if n.startswith("GLIBC_"))
        problems += [
            f"{place} needs GLIBC_{need}, which systems with GNU libc {_dotted(have)} lack;"
            f" for one that loads there run `{INSTALL_ZIG}` and export it again"
            for need in needs
            if (_libc(need) or (math.inf,)) > have
        ]
        if newest := max(filter(None, map(_libc, needs)), default=()):
            oldest.append(f"{place} loads on GNU libc {_dotted(newest)} and later")
    remark = plain("; ".join(problems or oldest))
    return CheckRow("GNU libc", float(len(problems)), 0.0, not problems, remark)


def _libc(version: str) -> tuple[int, ...] | None:
    """Return the numbers of a version of the GNU C library, None if it has others than numbers."""
    parts = version.split(".")
    return tuple(map(int, parts)) if all(p.isdigit() for p in parts) else None


def _dotted(version: tuple[int, ...]) -> str:
    return ".".join(map(str, version))
