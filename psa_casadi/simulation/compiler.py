"""The C compiler, and the compiled models that are kept.

The compiler is `$CC` or `cc` where there is one, else the one in the `ziglang` wheel, which the
extra `compiler` installs.
"""

import ctypes
import errno
import hashlib
import importlib.util
import os
import platform
import shlex
import shutil
import subprocess
import sys
import threading
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path

import numpy.lib.introspect

from psa_casadi.cache import VARIABLE, cached, writable_room
from psa_casadi.children import run_child
from psa_casadi.errors import MachineError

#: Flags for speed that keep the results of one source the same on every compiler.
OPTIMISE = ("-std=c99", "-O2", "-ffp-contract=off")
#: Environment variable with further flags for the models that are run here; FMUs have none of them.
#: `-Og` compiles in half the time and runs 1.2 to 1.3 times as long, to the same bits.
FLAGS_VARIABLE = "PSA_CASADI_CFLAGS"
#: The command that installs a C compiler where the system has none.
INSTALL_ZIG = "pip install 'psa-casadi[compiler]'"
_CURE = f"set CC to a working C99 compiler, or unset it and run {INSTALL_ZIG}."


def sources_directory() -> Path:
    """Return the folder of the C sources, in the installed package or in the checkout."""
    here = Path(__file__).resolve().parent.parent
    for candidate in (here / "fmu_src", here.parent / "fmu_src"):
        if candidate.is_dir():
            return candidate
    raise MachineError(
        "The C sources (fmu_src) are missing from this installation; reinstall psa_casadi."
    )


def compiler_command() -> list[str]:
    """Return the command that compiles C on this machine.

    Raises MachineError where `$CC` is no command.
    """
    wanted = os.environ.get("CC", "").strip()
    if not wanted:
        found = None if platform.system() == "Windows" else shutil.which("cc")
        return [found] if found and not _only_asks_for_tools(found) else zig_command()
    if shutil.which(wanted):  # a path with spaces
        return [wanted]
    try:
        return shlex.split(wanted, posix=platform.system() != "Windows")
    except ValueError as error:
        raise MachineError(f"CC is {wanted!r}, which is no command ({error}); {_CURE}") from error


@cache
def _only_asks_for_tools(command: str) -> bool:
    """A Mac without developer tools has a `cc` that compiles nothing, but asks to install them."""
    if platform.system() != "Darwin" or command != "/usr/bin/cc":
        return False
    return subprocess.run(["xcode-select", "-p"], capture_output=True, check=False).returncode != 0


def zig_command() -> list[str]:
    """Return the command of the C compiler in the `ziglang` wheel.

    Raises MachineError where the wheel is not installed.
    """
    if not has_zig():
        raise MachineError(
            "There is no C compiler to be found, which turns a model into a fast program: run "
            f"`{INSTALL_ZIG}`, or install the system's compiler (on Debian and Ubuntu `apt install "
            "gcc libc6-dev`, on macOS `xcode-select --install`), or name one in CC."
        )
    return [sys.executable, "-m", "ziglang", "cc"]


def has_zig() -> bool:
    """Whether the `ziglang` wheel is installed."""
    return importlib.util.find_spec("ziglang") is not None


@cache
def vector_flags() -> tuple[str, ...]:
    """Return the flags for this processor's vectors; the results have the same bits without them.

    numpy knows which of its own kernels run here.
    """
    found = numpy.lib.introspect.opt_func_info(func_name="^multiply$", signature="float64")
    kernels = " ".join(str(k.get("current")) for f in found.values() for k in f.values())
    wide = any(name in kernels for name in ("AVX2", "X86_V3", "AVX512", "X86_V4"))
    return ("-mavx2",) if wide else ()


def run_compiler(command: Sequence[str], directory: Path) -> None:
    """Run a compiler command in a directory; raise MachineError with its messages if it fails.

    What it makes for itself lies in the directory too, so that it goes with it. Raises OSError
    where the disk is full.
    """
    own = dict.fromkeys(("TMPDIR", "TMP", "TEMP"), str(directory))
    environment = {**os.environ, **own, "LC_ALL": "C"}  # its messages in English
    if "ziglang" in command:
        environment.setdefault("ZIG_GLOBAL_CACHE_DIR", str(writable_room("zig")))
        environment.setdefault("ZIG_LOCAL_CACHE_DIR", str(directory))
    try:
        done = run_child(command, directory=directory, environment=environment)
    except OSError as error:
        if error.errno not in (errno.ENOENT, errno.EACCES, errno.ENOEXEC):
            raise
        raise MachineError(
            f"The C compiler {command[0]} cannot be started ({error.strerror}); {_CURE}"
        ) from error
    complaint = done.stderr.decode(errors="replace")
    full = os.strerror(errno.ENOSPC)
    if done.returncode and full in complaint:
        raise OSError(errno.ENOSPC, full, str(directory))
    if done.returncode:
        raise MachineError(
            f"The C compiler failed ({' '.join(command[:3])} ...){_how(done.returncode)}:\n"
            f"{complaint[-4000:]}\n{_CURE[0].upper()}{_CURE[1:]}"
        )


def _how(code: int) -> str:
    """Say what stopped a compiler that was killed."""
    if code >= 0:
        return ""
    return f", killed by signal {-code}; too little memory is the likely cause"


def shared_library(
    generated: Mapping[str, str], sources: Sequence[str], flags: Sequence[str] = ()
) -> Path:
    """Compile generated text and files of `fmu_src` to a shared library; cached by content."""
    return generated_library(repr(sorted(generated.items())), lambda: generated, sources, flags)


def generated_library(
    fingerprint: str,
    generate: Callable[[], Mapping[str, str]],
    sources: Sequence[str],
    flags: Sequence[str] = (),
) -> Path:
    """Return the same library; text is generated only where none with the `fingerprint` is cached.

    The fingerprint differs wherever the text does.
    """
    folder = sources_directory()
    command = compiler_command()
    flags = (*flags, *_wanted_flags())
    digest = hashlib.sha256(
        repr((command, OPTIMISE, flags, platform.machine(), sys.platform)).encode()
    )
    digest.update(fingerprint.encode())
    digest.update(_sources(folder))
    suffix = {"Windows": ".dll", "Darwin": ".dylib"}.get(platform.system(), ".so")
    name = digest.hexdigest()[:32] + suffix
    files = [str(folder / s) for s in sources]
    with _turn_of(name):
        try:
            return cached(
                "models", name, lambda work: _compile(work, suffix, generate(), files, flags), _load
            )
        except OSError as error:
            if error.errno != errno.ENOEXEC:
                raise
            raise MachineError(
                f"{error.filename}: a compiled model cannot be loaded ({error.strerror}). A folder"
                f" from which no program may run (noexec), or a CC for another machine, is the"
                f" likely cause; set {VARIABLE} to a folder of another disk, or unset CC."
            ) from error


@cache
def _sources(folder: Path) -> bytes:
    """Return names and text of the C sources."""
    paths = sorted(folder.glob("*.[ch]"))
    return b"".join(path.name.encode() + path.read_bytes() for path in paths)


_TURNS: defaultdict[str, threading.Lock] = defaultdict(threading.Lock)
_TURNS_LOCK = threading.Lock()


def _turn_of(name: str) -> threading.Lock:
    """Return the lock of a library: of threads that want the same one, the first makes it."""
    with _TURNS_LOCK:
        return _TURNS[name]


def _load(path: Path) -> None:
    """Load a library; raise OSError where the system refuses it."""
    try:
        ctypes.CDLL(str(path))
    except OSError as error:
        raise OSError(errno.ENOEXEC, str(error), str(path.parent)) from error


def _wanted_flags() -> list[str]:
    """Return the user's own flags; raise MachineError where their quotes have no end."""
    wanted = os.environ.get(FLAGS_VARIABLE, "")
    try:
        return shlex.split(wanted)
    except ValueError as error:
        raise MachineError(
            f"{FLAGS_VARIABLE} is {wanted!r}, which is no row of flags ({error}); set it to flags"
            " of the C compiler, such as -Og, or unset it."
        ) from error


def _compile(
    work: Path,
    suffix: str,
    generated: Mapping[str, str],
    sources: Sequence[str],
    flags: Sequence[str],
) -> Path:
    """Compile a library in a folder and return its path there.

    As one translation unit: each start of the compiler proper takes as long as a small file.
    """
    for name, text in generated.items():
        (work / name).write_text(text, encoding="utf-8")
    files = [n for n in generated if n.endswith(".c")] + list(sources)
    unit = "".join(f'#include "{Path(name).as_posix()}"\n' for name in files)
    (work / "psa_library.c").write_text(unit, encoding="utf-8")
    output = "model" + suffix
    position = () if platform.system() == "Windows" else ("-fPIC",)
    command = [
        *compiler_command(), *OPTIMISE, *flags, *position, "-fvisibility=hidden", "-shared",
        "-I.", f"-I{sources_directory()}", "psa_library.c", "-lm", "-o", output,
    ]  # fmt: skip
    run_compiler(command, work)
    if not (work / output).is_file():
        raise MachineError(f"The C compiler {command[0]} wrote no library; {_CURE}")
    return work / output
