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
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cache
from pathlib import Path

import casadi as ca
import numpy.lib.introspect

from psa_casadi.common.cache import VARIABLE, cached, writable_room
from psa_casadi.common.children import run_child
from psa_casadi.common.errors import MachineError
from psa_casadi.common.files import temporary_folder
from psa_casadi.common.symbolic import in_turn
from psa_casadi.model.component import Expression
from psa_casadi.model.compose import Structure

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
        system = None if platform.system() == "Windows" else shutil.which("cc")
        return [system] if system and not _only_asks_for_tools(system) else zig_command()
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
            "There is no C compiler, which turns a model into a fast program: run "
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

    numpy reports which of its kernels run here.
    """
    known = numpy.lib.introspect.opt_func_info(func_name="^multiply$", signature="float64")
    kernels = " ".join(str(k.get("current")) for f in known.values() for k in f.values())
    wide = any(name in kernels for name in ("AVX2", "X86_V3", "AVX512", "X86_V4"))
    return ("-mavx2",) if wide else ()


def run_compiler(command: Sequence[str], directory: Path) -> None:
    """Run a compiler command in a directory; raise MachineError with its messages if it fails.

    What it makes for itself lies in the directory too, so that it goes with it. Raises OSError
    where the disk is full.
    """
    folders = dict.fromkeys(("TMPDIR", "TMP", "TEMP"), str(directory))
    environment = {**os.environ, **folders, "LC_ALL": "C"}  # its messages in English
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
        killed = f", killed by signal {-done.returncode}; too little memory is the likely cause"
        raise MachineError(
            f"The C compiler failed ({' '.join(command[:3])} ...)"
            f"{killed if done.returncode < 0 else ''}:\n"
            f"{complaint[-4000:]}\n{_CURE[0].upper()}{_CURE[1:]}"
        )


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
    wanted = os.environ.get(FLAGS_VARIABLE, "")
    try:
        flags = (*flags, *shlex.split(wanted))
    except ValueError as error:
        raise MachineError(
            f"{FLAGS_VARIABLE} is {wanted!r}, which is no row of flags ({error}); set it to flags"
            " of the C compiler, such as -Og, or unset it."
        ) from error
    digest = hashlib.sha256(
        repr((command, OPTIMISE, flags, platform.machine(), sys.platform)).encode()
    )
    digest.update(fingerprint.encode())
    digest.update(_sources(folder))
    suffix = {"Windows": ".dll", "Darwin": ".dylib"}.get(platform.system(), ".so")
    name = digest.hexdigest()[:32] + suffix
    files = [str(folder / s) for s in sources]
    with _TURNS_LOCK:
        turn = _TURNS[name]  # of threads that want the same one, the first makes it
    with turn:
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


def _load(path: Path) -> None:
    """Load a library; raise OSError where the system refuses it."""
    try:
        ctypes.CDLL(str(path))
    except OSError as error:
        raise OSError(errno.ENOEXEC, str(error), str(path.parent)) from error


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


#: Head of generated C.
PRAGMAS = """\
#if defined(__GNUC__)
#pragma GCC diagnostic ignored "-Wunused-parameter"
#pragma GCC diagnostic ignored "-Wunused-function"
#pragma GCC diagnostic ignored "-Wunused-variable"
#endif
#define CASADI_SYMBOL_EXPORT
"""
#: From this many numbers on, those of a function in C are in its caller's workspace: as local
#: variables they could take more of the stack than a page, which not every thread has.
_MANY = 200
#: How a library reaches a function that is in another one; see `Foreign`.
FOREIGN = """\
#include "trajectory.h"

typedef int function(const double **, double **, long long int *, double *, int);
static function *value, *slope;

PSA_API void connect_{name}(function *v, function *s);
function {name}, fwd1_{name};

void connect_{name}(function *v, function *s) {{
    value = v;
    slope = s;
}}

int {name}(const double **arg, double **res, long long int *iw, double *w, int mem) {{
    return value(arg, res, iw, w, mem);
}}

int fwd1_{name}(const double **arg, double **res, long long int *iw, double *w, int mem) {{
    return slope(arg, res, iw, w, mem);
}}
"""


@in_turn
def functions_of(structure: Structure, *, sensitivities: bool) -> dict[str, ca.Function]:
    """Return the CasADi functions behind `model.h`, all of arguments (time, x, u, p).

    psa_ode: xdot; psa_jacobian: df/dx dense (nx, nx); psa_outputs: y; psa_switches: zero
    where xdot has a kink; psa_sample, with sampled states: their values after an instant. With
    sensitivities also psa_sensitivity: (df/dx, df/dp) dense; psa_output_sensitivity: (dg/dx, dg/dp)
    dense. See `c_arguments` for x and p.
    """
    s = structure
    arguments = c_arguments(s)
    x, xdot = arguments[1], c_slopes(s)
    jacobian = s.jacobian(xdot, x)
    table = {
        "psa_ode": [xdot],
        "psa_jacobian": [jacobian],
        "psa_outputs": [s.y],
        "psa_switches": [ca.vertcat(ca.SX(0, 1), *s.switches.values())],
    }
    if s.sampled:
        table["psa_sample"] = [s.znext]
    if sensitivities:
        table["psa_sensitivity"] = [jacobian, s.jacobian(xdot, s.p)]
        table["psa_output_sensitivity"] = [s.jacobian(s.y, x), s.jacobian(s.y, s.p)]
    return {
        name: ca.Function(name, arguments, ca.cse([ca.densify(e) for e in outputs]), {"cse": True})
        for name, outputs in table.items()
    }


def c_arguments(structure: Structure) -> list[Expression]:
    """Return the arguments (time, x, u, p) of the functions in C.

    There the sampled states stand behind the parameters in p, as both are constant over a step; x
    of a model that has only sampled states is one number that stays as it is.
    """
    s = structure
    return [s.time, s.x if s.states else ca.SX.sym("unused"), s.u, ca.vertcat(s.p, s.z)]


def c_slopes(structure: Structure) -> Expression:
    """Return the derivative of `c_arguments`' x."""
    return structure.xdot if structure.states else ca.SX(0)


@in_turn
def generate_c(structure: Structure, *, sensitivities: bool) -> dict[str, str]:
    """Return the generated files of a model: {"model.c": ..., "model_config.h": ...}."""
    functions = functions_of(structure, sensitivities=sensitivities)
    return {
        **{f"{f.name}.c": FOREIGN.format(name=f.name) for f in structure.foreign},
        "model.c": c_code("model.c", functions.values()),
        "model_config.h": _config(structure, list(functions.values()), sensitivities),
    }


def c_code(name: str, functions: Collection[ca.Function]) -> str:
    """Return the text of functions in C; `name` is that of the file."""
    many = any(f.sz_w() > _MANY for f in functions)
    generator = ca.CodeGenerator(name, {"with_header": False, "avoid_stack": many})
    for function in functions:
        generator.add(function)
    with temporary_folder() as folder:
        generator.generate(f"{folder}/")
        body = (folder / name).read_text(encoding="utf-8")
    if not body.endswith("#endif\n"):  # CasADi does not look whether its writing succeeded
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))
    return PRAGMAS + body


@in_turn
def fingerprint(structure: Structure) -> str:
    """Return text that differs where the generated files differ, in a thirtieth of their time."""
    s = structure
    switches: Expression = ca.vertcat(ca.SX(0, 1), *s.switches.values())
    period = s.parameter_names.index(s.period) if s.period else None
    equations = ca.Function("f", c_arguments(s), [c_slopes(s), s.y, switches, s.znext])
    sizes = (len(s.states), len(s.parameters), len(s.sampled), period)
    generator = Path(__file__).read_text(encoding="utf-8")
    return repr((ca.CasadiMeta.version(), generator, sizes, equations.serialize()))


def _config(structure: Structure, functions: list[ca.Function], sensitivities: bool) -> str:
    sizes = {
        "PSA_NX": max(1, len(structure.states)),
        "PSA_STATES": len(structure.states),
        "PSA_NU": len(structure.inputs),
        "PSA_NP": len(structure.parameters),
        "PSA_NY": len(structure.outputs),
        "PSA_NZ": len(structure.switches),
        "PSA_NS": len(structure.sampled),
        "PSA_PERIOD": structure.parameter_names.index(structure.period) if structure.period else 0,
        "PSA_SZ_ARG": max(4, *(f.sz_arg() for f in functions)),
        "PSA_SZ_RES": max(2, *(f.sz_res() for f in functions)),
        "PSA_SZ_IW": max(1, *(f.sz_iw() for f in functions)),
        "PSA_SZ_W": max(1, *(f.sz_w() for f in functions)),
    }
    lines = ["#ifndef PSA_MODEL_CONFIG_H", "#define PSA_MODEL_CONFIG_H"]
    lines += [f"#define {name} {value}" for name, value in sizes.items()]
    if sensitivities:
        lines.append("#define PSA_WITH_SENSITIVITIES 1")
    return "\n".join([*lines, "#endif", ""])
