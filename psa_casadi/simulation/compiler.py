"""The C compiler, and a cache of compiled models.

The compiler is `$CC` or `cc` where there is one, else the one in the `ziglang` wheel.
"""

import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import threading
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path

import numpy.lib.introspect

from psa_casadi.errors import PsaError
from psa_casadi.interruption import current_work

#: Time [s] between two looks whether a compilation is to end.
_LOOK = 0.1
#: Flags for speed that keep the results of one source the same on every compiler.
OPTIMISE = ("-std=c99", "-O2", "-ffp-contract=off")


def sources_directory() -> Path:
    """Return the folder of the C sources, in the installed package or in the checkout."""
    here = Path(__file__).resolve().parent.parent
    for candidate in (here / "fmu_src", here.parent / "fmu_src"):
        if candidate.is_dir():
            return candidate
    raise PsaError(
        "The C sources (fmu_src) are missing from this installation; reinstall psa_casadi."
    )


def cache_directory() -> Path:
    """Return the user's cache folder for compiled models (`PSA_CASADI_CACHE` overrides it)."""
    override = os.environ.get("PSA_CASADI_CACHE")
    if override:
        return Path(override)
    if platform.system() == "Windows":
        base = Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    elif platform.system() == "Darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    return base / "psa_casadi"


def compiler_command() -> list[str]:
    """Return the command that compiles C on this machine."""
    wanted = os.environ.get("CC")
    if wanted:
        return wanted.split()
    found = None if platform.system() == "Windows" else shutil.which("cc")
    return [found] if found else zig_command()


def zig_command() -> list[str]:
    """Return the command of the C compiler in the `ziglang` wheel."""
    return [sys.executable, "-m", "ziglang", "cc"]


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
    """Run a compiler command in a directory; raise PsaError with its messages if it fails."""
    environment = dict(os.environ)
    environment.setdefault("ZIG_GLOBAL_CACHE_DIR", str(cache_directory() / "zig"))
    environment.setdefault("ZIG_LOCAL_CACHE_DIR", str(cache_directory() / "zig"))
    code, told = _run_to_end(command, directory, environment)
    if code:
        raise PsaError(
            f"The C compiler failed ({' '.join(command[:3])} ...):\n{told[-4000:]}\n"
            "Set CC to a working C99 compiler, or reinstall the ziglang wheel."
        )


def _run_to_end(
    command: Sequence[str], directory: Path, environment: Mapping[str, str]
) -> tuple[int, str]:
    """Return the exit code of a command and what it said of errors; an interrupt ends it."""
    with subprocess.Popen(
        command,
        cwd=directory,
        env=environment,
        text=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    ) as process:
        while True:
            try:
                _, told = process.communicate(timeout=_LOOK)
                return process.returncode, told
            except subprocess.TimeoutExpired:
                if current_work().stopped:
                    process.kill()
                    raise KeyboardInterrupt from None
            except BaseException:
                process.kill()
                raise


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
    digest = hashlib.sha256(
        repr((command, OPTIMISE, flags, platform.machine(), sys.platform)).encode()
    )
    digest.update(fingerprint.encode())
    for path in sorted(folder.glob("*.[ch]")):
        digest.update(path.name.encode() + path.read_bytes())
    suffix = {"Windows": ".dll", "Darwin": ".dylib"}.get(platform.system(), ".so")
    target = cache_directory() / "models" / (digest.hexdigest()[:32] + suffix)
    with _turn_of(target):
        if not target.exists():
            target.parent.mkdir(parents=True, exist_ok=True)
            _compile(target, generate(), [str(folder / s) for s in sources], flags)
    return target


_TURNS: defaultdict[Path, threading.Lock] = defaultdict(threading.Lock)
_TURNS_LOCK = threading.Lock()


def _turn_of(target: Path) -> threading.Lock:
    """Return the lock of a library: of threads that want the same one, the first makes it."""
    with _TURNS_LOCK:
        return _TURNS[target]


def _compile(
    target: Path, generated: Mapping[str, str], sources: Sequence[str], flags: Sequence[str]
) -> None:
    with tempfile.TemporaryDirectory(dir=target.parent) as work:
        for name, text in generated.items():
            (Path(work) / name).write_text(text)
        files = [n for n in generated if n.endswith(".c")] + list(sources)
        output = "model" + target.suffix
        position = () if platform.system() == "Windows" else ("-fPIC",)
        run_compiler(
            [*compiler_command(), *OPTIMISE, *flags, *position, "-fvisibility=hidden", "-shared",
             "-I.", f"-I{sources_directory()}", *files, "-lm", "-o", output],
            Path(work),
        )  # fmt: skip
        os.replace(Path(work) / output, target)
