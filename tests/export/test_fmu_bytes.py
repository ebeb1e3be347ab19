"""The bytes of an archive: always the same, nothing of this machine in them, no other symbols."""

import os
import re
import subprocess
import sys
import zipfile
from functools import cache
from io import BytesIO
from pathlib import Path

import lief
import pytest

from psa_casadi.cache import cache_directory
from psa_casadi.export.fmu.archive import export_fmu
from psa_casadi.export.fmu.platforms import PLATFORMS
from tests.export.c_host.build import (
    HEADERS,
    IDENTIFIER,
    STACK,
    VERSIONS,
    binary,
    everywhere,
)
from tests.export.fmu_models import model_named
from tests.tiers import slow

pytestmark = [pytest.mark.xdist_group("platforms"), slow]

LINUX = tuple(name for name in PLATFORMS if name.endswith("-linux"))
WINDOWS = ("x86_64-windows", "x86-windows")
MACOS = ("x86_64-darwin", "aarch64-darwin")
#: All that the C sources take from the C library; calloc and free make and free instances.
C_LIBRARY = {
    "bcmp",
    "calloc", "free", "memcmp", "memcpy", "memset", "strcmp", "strlen", "vsnprintf",
    "cos", "exp", "fabs", "floor", "fmax", "fmin", "log", "nearbyint", "pow", "sin", "sqrt", "tanh",
}  # fmt: skip

EXPORT = """
import sys
from psa_casadi.export.fmu.archive import export_fmu
from tests.export.c_host.build import STACK
from tests.export.fmu_models import model_named
export_fmu(model_named(STACK), sys.argv[1], fmi=int(sys.argv[2]), platforms=sys.argv[3:])
"""


def export_apart(folder: Path, fmi: int, *platforms: str, **changes: str) -> bytes:
    """Export in a new process with its own working and temporary folders; return the archive."""
    for name in ("work", "temporary"):
        (folder / name).mkdir(parents=True)
    environment = {
        **os.environ, "TMPDIR": str(folder / "temporary"), "PYTHONPATH": os.getcwd(), **changes,
    }  # fmt: skip
    path = folder / "archive.fmu"
    subprocess.run(
        [sys.executable, "-c", EXPORT, str(path), str(fmi), *platforms],
        cwd=folder / "work", env=environment, check=True, timeout=600,
    )  # fmt: skip
    return path.read_bytes()


@pytest.mark.parametrize(
    ("fmi", "platforms"),
    [
        (2, ("x86_64-linux", "x86_64-windows", "aarch64-darwin")),
        (3, ("riscv64-linux", "x86-windows", "x86_64-darwin")),
    ],
)
def test_same_bytes_elsewhere_and_another_day(
    fmi: int, platforms: tuple[str, ...], tmp_path: Path
) -> None:
    """Another zone, date, language, hash seed, compiler cache, and compiler of the simulation.

    Every linker writes for each version; of the same linker, one processor.
    """
    changes = {
        "TZ": "Pacific/Kiritimati",
        "SOURCE_DATE_EPOCH": "1234567890",
        "LC_ALL": "C.UTF-8",
        "PYTHONHASHSEED": "7",
        "PSA_CASADI_CACHE": str(tmp_path / "cache"),
        "ZIG_GLOBAL_CACHE_DIR": str(cache_directory() / "zig"),
        "ZIG_LOCAL_CACHE_DIR": str(tmp_path / "zig"),
        "CC": "cc -g",
    }
    again = export_apart(tmp_path / "a longer name of a folder", fmi, *platforms, **changes)
    here = export_fmu(model_named(STACK), tmp_path / "here.fmu", platforms=platforms, fmi=fmi)
    assert again == here.read_bytes()
    whole = everywhere(fmi).with_suffix(".fmu")
    with zipfile.ZipFile(BytesIO(again)) as some, zipfile.ZipFile(whole) as all_:
        assert sum(name.startswith("binaries/") for name in some.namelist()) == len(platforms)
        for name in some.namelist():
            assert some.read(name) == all_.read(name), name


@pytest.mark.parametrize("fmi", VERSIONS)
def test_no_absolute_path_inside(fmi: int) -> None:
    """Not in any entry; macOS libraries name two of the system, which every one there does."""
    system = {b"/usr/lib/dyld", b"/usr/lib/libSystem.B.dylib"}
    roots = (
        rb"/(?:tmp|home|root|usr|opt|var|private|Users|mnt|work|build|nix)/",
        rb"[A-Za-z]:\\[A-Za-z]",
    )
    own = [str(p).encode() for p in (Path.home(), Path.cwd(), Path(sys.prefix)) if len(str(p)) > 1]
    with zipfile.ZipFile(everywhere(fmi).with_suffix(".fmu")) as archive:
        entries = {n: archive.read(n) for n in archive.namelist()}
    assert len(entries) > 30
    for name, content in entries.items():
        found = {m for root in roots for m in re.findall(root + rb"[ -~]*", content)}
        assert found <= (system if name.endswith(".dylib") else set()), (name, found)
        assert not [path for path in own if path + b"/" in content], name


@cache
def functions(fmi: int) -> frozenset[str]:
    """Return the functions that the headers of the standard declare."""
    text = (HEADERS / f"fmi{fmi}Functions.h").read_text()
    return frozenset(re.findall(rf"^\s*FMI{fmi}_Export\s+\w+TYPE\s+(\w+);", text, re.MULTILINE))


def elf(fmi: int, name: str) -> lief.ELF.Binary:
    found = lief.parse(str(binary(fmi, PLATFORMS[name])))
    assert isinstance(found, lief.ELF.Binary)
    return found


def pe(fmi: int, name: str) -> lief.PE.Binary:
    found = lief.parse(str(binary(fmi, PLATFORMS[name])))
    assert isinstance(found, lief.PE.Binary)
    return found


def macho(fmi: int, name: str) -> lief.MachO.Binary:
    found = lief.parse(str(binary(fmi, PLATFORMS[name])))
    assert isinstance(found, lief.MachO.Binary)
    return found


@pytest.mark.parametrize("fmi", VERSIONS)
@pytest.mark.parametrize("name", LINUX)
def test_linux(name: str, fmi: int) -> None:
    """FMI functions only, from libc and libm of 2.17 or older, found by no path of this machine.

    RISC-V has them from 2.27 on.
    """
    library = elf(fmi, name)
    assert {s.name for s in library.exported_symbols} == functions(fmi)
    assert {s.name for s in library.imported_symbols} <= C_LIBRARY
    assert set(library.libraries) == {"libc.so.6", "libm.so.6"}
    versions = [
        str(v.name) for r in library.symbols_version_requirement for v in r.get_auxiliary_symbols()
    ]
    assert versions
    numbers = [tuple(map(int, v.removeprefix("GLIBC_").split("."))) for v in versions]
    assert max(numbers) <= ((2, 27) if name == "riscv64-linux" else (2, 17)), versions
    tags = {e.tag for e in library.dynamic_entries}
    assert not tags & {lief.ELF.DynamicEntry.TAG.RPATH, lief.ELF.DynamicEntry.TAG.RUNPATH}


@pytest.mark.parametrize("fmi", VERSIONS)
@pytest.mark.parametrize("name", WINDOWS)
def test_windows(name: str, fmi: int) -> None:
    """FMI functions only, undecorated; from the universal C runtime and the kernel, no date."""
    library = pe(fmi, name)
    export = library.get_export()
    assert export is not None
    assert {e.name for e in export.entries} == functions(fmi)
    assert export.name == IDENTIFIER + ".dll"
    wanted = {str(i.name).lower(): {str(e.name) for e in i.entries} for i in library.imports}
    assert all(n == "kernel32.dll" or n.startswith("api-ms-win-crt-") for n in wanted), wanted
    heap = wanted["api-ms-win-crt-heap-l1-1-0.dll"]
    assert heap == {"calloc", "free"}
    assert [d.type for d in library.debug] == [lief.PE.Debug.TYPES.REPRO]


@pytest.mark.parametrize("fmi", VERSIONS)
@pytest.mark.parametrize("name", MACOS)
def test_macos(name: str, fmi: int) -> None:
    """All FMI functions; a relative install name, the system's library alone, macOS 11 or later.

    The linker exports two symbols of its own, which name the header of the file. What has no effect
    in a library is the load command for a dynamic linker; nothing else is beside the usual ones.
    """
    library = macho(fmi, name)
    exported = {str(s.name) for s in library.exported_symbols}
    assert exported - {"__mh_dylib_header", "___dso_handle"} == {f"_{f}" for f in functions(fmi)}
    linker = {"dyld_stub_binder", "_bzero", "___bzero"}
    assert {str(s.name) for s in library.imported_symbols} - linker <= {f"_{s}" for s in C_LIBRARY}
    names = [str(command.name) for command in library.libraries]
    assert names == [f"@rpath/{IDENTIFIER}.dylib", "/usr/lib/libSystem.B.dylib"]
    usual = {
        "SEGMENT_64", "DYLD_INFO_ONLY", "FUNCTION_STARTS", "DATA_IN_CODE", "SYMTAB", "DYSYMTAB",
        "LOAD_DYLINKER", "ID_DYLIB", "SOURCE_VERSION", "BUILD_VERSION", "UUID", "LOAD_DYLIB",
        "CODE_SIGNATURE",
    }  # fmt: skip
    assert {c.command.name for c in library.commands} <= usual
    assert library.build_version is not None
    assert list(library.build_version.minos) == [11, 0, 0]
    # an unsigned library cannot be loaded on Apple's own processors
    assert library.has_code_signature or name == "x86_64-darwin"
    cpu = {"x86_64-darwin": "X86_64", "aarch64-darwin": "ARM64"}[name]
    assert library.header.cpu_type.name == cpu
