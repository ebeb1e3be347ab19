"""The platforms an FMU can carry a binary for, and how each is compiled."""

import hashlib
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path

from psa_casadi.common.cache import cached
from psa_casadi.common.errors import InputError
from psa_casadi.common.files import temporary_folder
from psa_casadi.export.fmu.sources import compiled_files
from psa_casadi.simulation.compiler import (
    INSTALL_ZIG,
    OPTIMISE,
    compiler_command,
    has_zig,
    run_compiler,
    sources_directory,
    zig_command,
)


@dataclass(frozen=True)
class Platform:
    """A platform: target of the `ziglang` compiler, FMI folder, suffix and flags of the library.

    `name` is FMI 3's platform tuple and its folder; `folder` is the one of FMI 2, which has names
    for x86 alone and takes the tuples of FMI 3 for the others (FMI 2.0.4, section 2.3).
    The targets are old systems, so that the binary loads everywhere: GNU libc 2.17 (of 2012) on
    Linux, 2.27 on RISC-V, the first one there, and macOS 11 (of 2020), the first for both
    processors. 32-bit ARM is what Debian's and Ubuntu's armhf run on: ARMv7 with 16 registers for
    doubles, in which they are handed over. 32-bit x86 has SSE2, so that doubles are rounded as
    everywhere else. Windows has the universal C runtime, and a library of an FMU needs nothing
    else but `fmu_src/windows/start.c`. The C library of MinGW-w64, which the compiler would
    make at its first use, takes it a minute for each processor.
    """

    name: str
    target: str | None
    folder: str
    suffix: str
    flags: tuple[str, ...] = ()

    def binaries(self, fmi: int = 2) -> str:
        """Return the name of the folder below binaries/ in an archive of FMI 2 or FMI 3."""
        return self.folder if fmi == 2 else self.name


_PIC = ("-fPIC", "-Wl,-s")
_ARMHF = (*_PIC, "-mcpu=generic+v7a+vfp3d16-d32-neon")


def runtime(*parts: str) -> tuple[str, ...]:
    """Return the flags that link parts of the universal C runtime of Windows."""
    return tuple(f"-lapi-ms-win-crt-{part}-l1-1-0" for part in parts)


#: The parts that a library of an FMU takes from.
RUNTIME = runtime("heap", "math", "private", "stdio", "string")

PLATFORMS: dict[str, Platform] = {
    p.name: p
    for p in (
        Platform("x86_64-linux", "x86_64-linux-gnu.2.17", "linux64", ".so", _PIC),
        Platform("aarch64-linux", "aarch64-linux-gnu.2.17", "aarch64-linux", ".so", _PIC),
        Platform("riscv64-linux", "riscv64-linux-gnu.2.27", "riscv64-linux", ".so", _PIC),
        Platform("aarch32-linux", "arm-linux-gnueabihf.2.17", "aarch32-linux", ".so", _ARMHF),
        Platform("x86-linux", "x86-linux-gnu.2.17", "linux32", ".so", (*_PIC, "-mcpu=pentium4")),
        Platform("x86_64-windows", "x86_64-windows-gnu", "win64", ".dll", ("-Wl,-s",)),
        Platform("x86-windows", "x86-windows-gnu", "win32", ".dll", ("-Wl,-s",)),
        Platform("x86_64-darwin", "x86_64-macos.11.0", "darwin64", ".dylib", ("-fPIC",)),
        Platform("aarch64-darwin", "aarch64-macos.11.0", "aarch64-darwin", ".dylib", ("-fPIC",)),
    )
}


def host_platform() -> Platform:
    """Return this machine's platform; one that is not in the table uses the machine's compiler."""
    machine = {"amd64": "x86_64", "arm64": "aarch64", "i686": "x86"}.get(
        platform.machine().lower(), platform.machine().lower()
    )
    system = platform.system().lower()
    name = f"{machine}-{system}"
    return PLATFORMS.get(name, Platform(name, None, name, ".so", ("-fPIC",)))


def chosen_platforms(names: Sequence[str]) -> tuple[Platform, ...]:
    """Return the platforms named: names of `PLATFORMS`, "host" or "all"; each once, in order.

    A platform that is named is one of the table, and its binary loads on old systems; "host" is
    this machine, for which its compiler will do.

    Raises InputError for a name that is not known, and for platforms that are named where the
    `ziglang` compiler is not installed.
    """
    unknown = [n for n in names if n not in (*PLATFORMS, "host", "all")]
    if unknown or not names:
        wanted = ", ".join(repr(n) for n in unknown) or "(none)"
        raise InputError(
            f"The platform {wanted} is not known; choose host, all, or some of"
            f" {', '.join(PLATFORMS)}."
        )
    chosen: dict[str, Platform] = {}
    for name in names:
        result = PLATFORMS.values() if name == "all" else [PLATFORMS.get(name) or host_platform()]
        chosen.update({p.name: p for p in result})
    if {*names} != {"host"} and not has_zig():
        raise InputError(
            f"The machine's compiler makes binaries for systems like this one alone; for"
            f" {', '.join(chosen)} run `{INSTALL_ZIG}`, or export with --platforms host."
        )
    return tuple(chosen.values())


def compile_library(texts: Mapping[str, str], identifier: str, target: Platform) -> bytes:
    """Compile sources to a shared library that exports only FMI functions; return its bytes.

    What the `ziglang` compiler made is kept: its bytes follow from the sources, the flags and its
    version, so that the same model is compiled once. Without it, this machine's compiler makes
    its binary, for its C library; that compiler may change without notice.

    Raises MachineError with the compiler's messages if it fails.
    """
    output = identifier + target.suffix
    own_name = ("-Wl,-install_name,@rpath/" + output,) if target.suffix == ".dylib" else ()
    libraries = ("-lm",) if target.suffix == ".so" else ()
    arguments = [
        *OPTIMISE, *target.flags, *own_name, "-g0", "-fvisibility=hidden",
        "-shared", "-I.", *compiled_files(dict(texts)), *libraries, "-o", output,
    ]  # fmt: skip
    if target.target is None or not has_zig():
        with temporary_folder() as work:
            return _compiled(work, texts, [*compiler_command(), *arguments], output).read_bytes()
    arguments = ["-target", target.target, *arguments]
    if target.suffix == ".dll":
        start = (sources_directory() / "windows" / "start.c").read_text(encoding="utf-8")
        texts = {**texts, "windows_start.c": start}
        arguments += ["windows_start.c", *RUNTIME]
    content = (version("ziglang"), arguments, sorted(texts.items()))
    digest = hashlib.sha256(repr(content).encode("utf-8")).hexdigest()[:32]
    command = [*zig_command(), *arguments]
    if target.suffix == ".dll":
        command += windows_alone()
    kept = cached(
        "binaries", digest + target.suffix, lambda work: _compiled(work, texts, command, output)
    )
    return kept.read_bytes()


def windows_alone() -> list[str]:
    """Return the flags of the `ziglang` compiler for Windows without the library of MinGW-w64.

    They leave its headers out too, so these are named.
    """
    headers = files("ziglang") / "lib" / "libc" / "include" / "any-windows-any"
    return ["-nostdlib", "-D_UCRT", "-isystem", str(headers)]


def make_compiler_ready() -> None:
    """Let the `ziglang` compiler make its libraries for this machine's platform.

    It does so at its first use, in 1 to 4 s; nothing happens where it is not installed.
    """
    if has_zig():
        compile_library({"nothing.c": "int psa_nothing;\n"}, "nothing", host_platform())


def _compiled(work: Path, texts: Mapping[str, str], command: Sequence[str], output: str) -> Path:
    """Run a compiler in a folder, with the sources; return the path of the file it wrote."""
    for name, text in texts.items():
        (work / name).write_text(text, encoding="utf-8", newline="\n")
    run_compiler(command, work)
    return work / output
