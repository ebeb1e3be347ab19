"""Compiles and runs the small C importer, and finds the tools that run it on other platforms.

What a test needs from the system's packages may be missing: then the test is skipped, but it fails
if the tool is one of those that PSA_CASADI_REQUIRE_TOOLS names.
"""

import hashlib
import os
import shutil
import subprocess
import tempfile
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NoReturn

import fmpy
import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.export.fmu.platforms import PLATFORMS, RUNTIME, Platform, runtime, windows_alone
from psa_casadi.export.fmu.sources import STRICT
from psa_casadi.simulation.compiler import OPTIMISE, run_compiler, zig_command
from tests.export.fmu_models import model_named

HERE = Path(__file__).parent
HEADERS = Path(fmpy.__file__).parent / "c-code"
VERSIONS = (2, 3)
STACK = "P-885.51"
IDENTIFIER = "psa"
#: Outputs that are compared: not the current, a small difference of large voltages.
OUTPUTS = ("displacement", "velocity", "charge")
STEP, STEPS = 1e-4, 120

_FOLDER = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)

#: Where the packages of the system put what is not in PATH.
_ELSEWHERE = {"wine64": "/usr/lib/wine/wine64"}
#: What runs the programs of another Linux, and its GNU libc, as Debian's packages libc6-*-cross
#: have it.
_EMULATORS = {
    "aarch64-linux": ("qemu-aarch64", "/usr/aarch64-linux-gnu"),
    "riscv64-linux": ("qemu-riscv64", "/usr/riscv64-linux-gnu"),
    "aarch32-linux": ("qemu-arm", "/usr/arm-linux-gnueabihf"),
    "x86-linux": ("qemu-i386", "/usr/i686-linux-gnu"),
}
#: All platforms that an emulator runs here.
EMULATED = (*_EMULATORS, "x86_64-windows")


def tool(*names: str) -> str:
    """Return the path of the first program; skips the test without one, or fails it if required."""
    for name in names:
        text = shutil.which(name) or shutil.which(_ELSEWHERE.get(name, name))
        if text:
            return text
    return _missing(f"{' or '.join(names)} is not installed", names)


def _missing(what: str, names: Sequence[str]) -> NoReturn:
    required = os.environ.get("PSA_CASADI_REQUIRE_TOOLS", "").split()
    if any(name in required for name in names):
        pytest.fail(f"{what}, and PSA_CASADI_REQUIRE_TOOLS requires it")
    pytest.skip(what)


@cache
def everywhere(fmi: int) -> Path:
    """Return the folder of an unpacked FMU of a stack with binaries for all platforms."""
    path = Path(_FOLDER.name) / f"fmi{fmi}.fmu"
    psa.export_fmu(model_named(STACK), path, platforms=["all"], fmi=fmi)
    folder = path.with_suffix("")
    with zipfile.ZipFile(path) as archive:
        archive.extractall(folder)
    return folder


def binary(fmi: int, platform: Platform) -> Path:
    """Return the library of one platform in the unpacked FMU."""
    return everywhere(fmi) / "binaries" / platform.binaries(fmi) / (IDENTIFIER + platform.suffix)


@cache
def host(platform: Platform) -> Path:
    """Compile the importer for a platform and return the program.

    With the flags of the library: others would let the compiler make the C library again.
    """
    windows = platform.suffix == ".dll"
    program = Path(_FOLDER.name) / f"host-{platform.name}{'.exe' if windows else ''}"
    names = ("host.c", "host_fmi2.c", "host_fmi3.c", *(["host_windows.c"] if windows else []))
    sources = [str(HERE / n) for n in names]
    target = ["-target", platform.target or ""]
    options = [*OPTIMISE, *platform.flags, *STRICT, "-isystem", str(HEADERS), "-g0"]
    libraries = ["-ldl"]
    if windows:
        options += [*windows_alone(), "-Wl,-e,mainCRTStartup"]
        libraries = [*RUNTIME, *runtime("convert", "runtime"), "-lkernel32"]
    command = [*zig_command(), *target, *options, *sources, *libraries, "-o", str(program)]
    run_compiler(command, Path(_FOLDER.name))
    return program


@dataclass(frozen=True)
class Runner:
    """A way to run a platform's programs here: a command in front of them, and its environment."""

    platform: Platform
    command: tuple[str, ...] = ()
    environment: tuple[tuple[str, str], ...] = ()

    def run(
        self,
        fmi: int,
        library: Path | None = None,
        *,
        steps: tuple[int, int] = (0, STEPS),
        state: Path | None = None,
        keep: Path | None = None,
        program: Path | None = None,
    ) -> FloatArray:
        """Return OUTPUTS after each of the steps, (n, 3); `state` is read and `keep` written."""
        arguments = importer_arguments(fmi, library or binary(fmi, self.platform), steps)
        arguments[6:6] = [str(state or "-"), str(keep or "-")]
        done = subprocess.run(
            [*self.command, str(program or host(self.platform)), *arguments],
            env={**os.environ, **dict(self.environment)},
            capture_output=True, text=True, check=False, timeout=300,
        )  # fmt: skip
        assert done.returncode == 0, f"status {done.returncode}: {done.stderr[-2000:]}"
        rows = [[float(v) for v in line.split()] for line in done.stdout.splitlines()]
        assert len(rows) == steps[1] - steps[0]
        return np.array(rows)


def importer_arguments(fmi: int, library: Path, steps: tuple[int, int]) -> list[str]:
    """Return the arguments of host.c without the two files of states."""
    description = fmpy.read_model_description(str(everywhere(fmi)))
    token = description.guid if fmi == 2 else description.instantiationToken
    references = {v.name: str(v.valueReference) for v in description.modelVariables}
    numbers = [references[name] for name in ("voltage", *OUTPUTS)]
    return [str(fmi), str(library), token, repr(STEP), str(steps[0]), str(steps[1]), *numbers]


def native() -> Runner:
    """Return the way to run this machine's programs; skips where it is not x86-64 Linux."""
    if os.uname().sysname != "Linux" or os.uname().machine != "x86_64":
        pytest.skip("the emulators are used on Linux, x86-64")
    return Runner(PLATFORMS["x86_64-linux"])


def emulated(name: str) -> Runner:
    """Return the way to run the programs of another platform; skips where there is none."""
    if name in _EMULATORS:
        emulator, libraries = _EMULATORS[name]
        text = tool(emulator)
        if not (Path(libraries) / "lib" / "libc.so.6").exists():
            _missing(f"{libraries} has no C library for {emulator}", [emulator])
        return Runner(PLATFORMS[name], (text, "-L", libraries))
    prefix = str(Path(_FOLDER.name) / "wine")
    quiet = {"WINEPREFIX": prefix, "WINEDEBUG": "-all", "WINEDLLOVERRIDES": "mscoree,mshtml="}
    return Runner(PLATFORMS[name], (tool("wine64", "wine"),), tuple(quiet.items()))


def linked(
    fmi: int, command: Sequence[str], files: Sequence[str], name: str, inside: Path | None = None
) -> Path:
    """Compile C files of this folder together with the sources of the FMU; return the program.

    `command` is a compiler with its flags; the warnings of `STRICT` are errors. `inside` is a
    folder of other sources of the FMU.
    """
    inside = inside or everywhere(fmi) / "sources"
    sources = [*(HERE / n for n in files), *sorted(inside.glob("*.c"))]
    program = Path(_FOLDER.name) / f"{name}-{fmi}"
    compiler = [*command, "-std=c99", *STRICT, f"-DHOST_LINKED={fmi}", "-isystem", str(HEADERS)]
    objects = [_object(compiler, source, inside) for source in sources]
    run_compiler([*command, *objects, "-o", str(program), "-lm", "-pthread"], Path(_FOLDER.name))
    return program


def _object(compiler: Sequence[str], source: Path, inside: Path) -> str:
    """Compile one file with the headers of a folder, unless the same was compiled before."""
    digest = hashlib.sha256(repr(compiler).encode())
    for path in (source, *sorted(inside.glob("*.h"))):
        digest.update(path.read_bytes())
    made = Path(_FOLDER.name) / f"{source.stem}-{digest.hexdigest()[:16]}.o"
    if not made.exists():
        line = [*compiler, "-isystem", str(inside), "-c", str(source), "-o", str(made)]
        run_compiler(line, Path(_FOLDER.name))
    return str(made)
