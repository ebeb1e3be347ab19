"""The binaries of all platforms: what is in them, and those that an emulator runs here.

The bytes of an archive are always the same; sanitizers and valgrind find nothing in the C code,
whose calling sequences are those of `c_host`.
"""

import os
import re
import subprocess
import sys
import zipfile
from collections.abc import Sequence
from functools import cache
from io import BytesIO
from pathlib import Path

import lief
import numpy as np
import pytest

from build_scripts.compile_everywhere import complaint
from psa_casadi.common.cache import cache_directory
from psa_casadi.common.units import FloatArray
from psa_casadi.export.fmu.archive import export_fmu
from psa_casadi.export.fmu.platforms import PLATFORMS
from psa_casadi.export.fmu.sources import exported_texts
from psa_casadi.simulation.compiler import OPTIMISE, zig_command
from tests.export.c_host.build import (
    EMULATED,
    HEADERS,
    IDENTIFIER,
    STACK,
    STEPS,
    VERSIONS,
    Runner,
    binary,
    emulated,
    everywhere,
    linked,
    native,
    tool,
)
from tests.export.fmu_models import files_inside, model_named
from tests.tiers import slow

#: Each of them compiles two archives for nine platforms: one process shall do it.
pytestmark = [pytest.mark.xdist_group("platforms"), slow]

HALF = STEPS // 2
LIMIT = 1e-12


def difference(result: FloatArray, expected: FloatArray) -> float:
    """Return the largest difference, each column relative to its largest value."""
    return float(np.max(np.abs(result - expected) / np.max(np.abs(expected), axis=0)))


@pytest.mark.parametrize("fmi", VERSIONS)
def test_native_run_has_a_response(fmi: int) -> None:
    """The comparisons below compare something: the stack moves by most of its stroke."""
    displacement, _, charge = native().run(fmi).T
    assert 5e-6 < np.ptp(displacement) < 20e-6
    assert 0.9 * 1.5e-6 * 80.0 < np.ptp(charge) < 1.1 * 1.5e-6 * 95.0


@pytest.mark.parametrize("fmi", VERSIONS)
@pytest.mark.parametrize("name", EMULATED)
def test_emulated_binary_gives_the_native_result(name: str, fmi: int) -> None:
    assert difference(emulated(name).run(fmi), native().run(fmi)) < LIMIT


def _moved(fmi: int, source: Runner, target: Runner, state: Path) -> None:
    """Run the first half on one platform and the second on another, from the first's state."""
    first = source.run(fmi, steps=(0, HALF), keep=state)
    second = target.run(fmi, steps=(HALF, STEPS), state=state)
    assert difference(np.vstack([first, second]), native().run(fmi)) < LIMIT


@pytest.mark.parametrize("name", EMULATED)
def test_state_moves_between_platforms(name: str, tmp_path: Path) -> None:
    """Both versions have the same state."""
    other = emulated(name)
    _moved(3, native(), other, tmp_path / "there")
    _moved(3, other, native(), tmp_path / "back")


def test_sources_and_states_on_32_bits(tmp_path: Path) -> None:
    """Pointers and longs are short; doubles lie in memory as on 32-bit Windows.

    There they are aligned to eight bytes. Both versions have the same state.
    """
    fmi = 3
    narrow, wide = emulated("x86-linux"), native()
    target = ["-target", narrow.platform.target or "", *narrow.platform.flags, "-malign-double"]
    compiler = [*zig_command(), *target, *OPTIMISE, "-g0"]
    program = linked(fmi, compiler, ("host.c", f"host_fmi{fmi}.c"), "host32")
    whole, kept = wide.run(fmi), tmp_path / "state"
    assert difference(narrow.run(fmi, program=program), whole) < LIMIT
    narrow.run(fmi, program=program, steps=(0, HALF), keep=kept)
    assert difference(wide.run(fmi, steps=(HALF, STEPS), state=kept), whole[HALF:]) < LIMIT
    wide.run(fmi, steps=(0, HALF), keep=kept)
    second = narrow.run(fmi, program=program, steps=(HALF, STEPS), state=kept)
    assert difference(second, whole[HALF:]) < LIMIT


def test_a_model_with_every_effect_links_for_windows() -> None:
    """Its functions are the largest; beyond a page they would need what no runtime there has.

    `build_scripts.compile_everywhere` compiles each effect and each stack for all platforms.
    """
    texts, name = exported_texts(model_named("every_effect"), "psa")[1], "x86_64-windows"
    assert complaint("every effect", texts, PLATFORMS[name]) == ""
    large = "void psa_large(int i) { volatile char page[5000]; page[i] = 1; }"
    texts["large.c"] = f"__declspec(dllexport) {large}\n"
    assert "undefined symbol" in complaint("large", texts, PLATFORMS[name])


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
    """Export in a new process with separate working and temporary folders; return the archive."""
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


def test_same_bytes_elsewhere_and_another_day(tmp_path: Path) -> None:
    """Another zone, date, language, hash seed, compiler cache, and compiler of the simulation.

    One processor of each linker. The text of FMI 2.0 and 3.0 differs in their faces alone.
    """
    fmi, platforms = 3, ("riscv64-linux", "x86_64-windows", "aarch64-darwin")
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
    items = [
        str(p).encode() for p in (Path.home(), Path.cwd(), Path(sys.prefix)) if len(str(p)) > 1
    ]
    entries = files_inside(everywhere(fmi).with_suffix(".fmu"))
    assert len(entries) > 30
    for name, content in entries.items():
        result = {m for root in roots for m in re.findall(root + rb"[ -~]*", content)}
        assert result <= (system if name.endswith(".dylib") else set()), (name, result)
        assert not [path for path in items if path + b"/" in content], name


@cache
def functions(fmi: int) -> frozenset[str]:
    """Return the functions that the headers of the standard declare."""
    text = (HEADERS / f"fmi{fmi}Functions.h").read_text()
    return frozenset(re.findall(rf"^\s*FMI{fmi}_Export\s+\w+TYPE\s+(\w+);", text, re.MULTILINE))


def read(fmi: int, name: str) -> object:
    return lief.parse(str(binary(fmi, PLATFORMS[name])))


@pytest.mark.parametrize("fmi", VERSIONS)
@pytest.mark.parametrize("name", LINUX)
def test_linux(name: str, fmi: int) -> None:
    """FMI functions only, from libc and libm of 2.17 or older, by no path of this machine.

    RISC-V has them from 2.27 on.
    """
    library = read(fmi, name)
    assert isinstance(library, lief.ELF.Binary)
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
    library = read(fmi, name)
    assert isinstance(library, lief.PE.Binary)
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

    The linker exports two symbols, which name the header of the file. What has no effect
    in a library is the load command for a dynamic linker; all others are the usual ones.
    """
    library = read(fmi, name)
    assert isinstance(library, lief.MachO.Binary)
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
    # an unsigned library cannot be loaded on Apple's processors
    assert library.has_code_signature or name == "x86_64-darwin"
    cpu = {"x86_64-darwin": "X86_64", "aarch64-darwin": "ARM64"}[name]
    assert library.header.cpu_type.name == cpu


#: Files of the sequences for each version of FMI.
FILES = {
    2: ("sequences.c", "sequences_fmi2.c"),
    3: ("sequences.c", "sequences_fmi3.c", "sequences_fmi3_refused.c"),
}
SANITIZERS = {
    "memory": ("-fsanitize=address,undefined", "-fno-sanitize-recover=all"),
    "threads": ("-fsanitize=thread",),
}
#: Every allocation in the program is counted.
COUNTED = (
    "-DCOUNT_ALLOCATIONS", "-Wl,--wrap=malloc", "-Wl,--wrap=calloc", "-Wl,--wrap=realloc",
)  # fmt: skip


def complaints(command: Sequence[str | Path]) -> str:
    """Run a program; return its output and its guard's, empty if all sequences ended well."""
    options = {
        "ASAN_OPTIONS": "detect_leaks=1:detect_stack_use_after_return=1",
        "UBSAN_OPTIONS": "print_stacktrace=1",
        "TSAN_OPTIONS": "halt_on_error=1",
    }
    done = subprocess.run(
        [str(c) for c in command], env={**os.environ, **options},
        capture_output=True, text=True, check=False, timeout=300,
    )  # fmt: skip
    fine = done.returncode == 0 and done.stdout == "all sequences done\n"
    return "" if fine else f"status {done.returncode}\n{done.stdout[-500:]}{done.stderr[-3000:]}"


@pytest.mark.parametrize(("kind", "fmi"), [("memory", 2), ("memory", 3), ("threads", 2)])
def test_sanitizers_find_nothing(kind: str, fmi: int) -> None:
    """What threads could share is in the files that both versions have."""
    compiler = [tool("gcc"), "-O1", "-g", *SANITIZERS[kind]]
    assert not complaints([linked(fmi, compiler, FILES[fmi], kind)])


def test_nothing_is_allocated_after_instantiation() -> None:
    """Nor does one of 1,000 instances or 8 threads of small stacks differ from another by a bit."""
    fmi = 3
    compiler = [tool("gcc"), "-O2", "-DSTACK=16384", *COUNTED]
    assert not complaints([linked(fmi, compiler, FILES[fmi], "counted")])


def test_valgrind_finds_nothing() -> None:
    """It sees values that were never set, which the sanitizers do not."""
    fmi = 3
    guard = [tool("valgrind"), "--error-exitcode=9", "--leak-check=full", "--quiet"]
    compiler = [tool("gcc"), "-O1", "-g", "-DINSTANCES=20", "-DSTEPS=30"]
    program = linked(fmi, compiler, FILES[fmi], "watched")
    assert not complaints([*guard, "--show-leak-kinds=all", program])


#: The guard, a word of its message, and the fault: a file, its text, and the replacement.
FAULTS = {
    "a read behind an array": (
        "memory", "AddressSanitizer: global-buffer-overflow",
        "values.c", "vr <= PSA_VARIABLES)", "vr <= 2 * PSA_VARIABLES)",
    ),
    "a leak": (
        "memory", "LeakSanitizer",
        "snapshot.c", "free(*snapshot);", "(void)snapshot;",
    ),
    "memory that threads share": (
        "threads", "ThreadSanitizer: data race",
        "log.c", "    char sentence[PSA_SENTENCE];", "    static char sentence[PSA_SENTENCE];",
    ),
    "an allocation in a step": (
        "counted", "allocations == made",
        "values.c", "    psa_input_at(&state->input, state->solver.since, u);\n",
        "    extern void *calloc(size_t, size_t);\n    if (!calloc(1, 1)) return PSA_ERROR;\n"
        "    psa_input_at(&state->input, state->solver.since, u);\n",
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_reported(fault: str, tmp_path: Path) -> None:
    """Each guard reports a fault of its kind that is put into the sources."""
    kind, word, file, old, new = FAULTS[fault]
    inside = tmp_path / "sources"
    inside.mkdir()
    for path in (everywhere(2) / "sources").iterdir():
        text = path.read_text()
        (inside / path.name).write_text(text.replace(old, new, 1) if path.name == file else text)
        assert path.name != file or old in text
    flags = COUNTED if kind == "counted" else SANITIZERS[kind]
    compiler = [tool("gcc"), "-O1", "-g", *flags]
    assert word in complaints([linked(2, compiler, FILES[2], "faulty", inside)])
