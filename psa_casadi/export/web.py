"""A model as a WebAssembly module: parameters and a record in, states and outputs out.

The module is the C code that integrates models everywhere else: exact steps, the stepper behind
them, and the state at the start of a record (`fmu_src/page`). It has no import but functions of
JavaScript's `Math`.
"""

import hashlib
import logging
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from contextvars import copy_context
from functools import cache
from importlib.metadata import version
from pathlib import Path

import casadi as ca

from psa_casadi.common.cache import cached
from psa_casadi.common.errors import InputError, MachineError
from psa_casadi.common.symbolic import in_turn
from psa_casadi.export.common.templates import filled
from psa_casadi.model.compose import Model, Structure
from psa_casadi.simulation.compiler import (
    c_arguments,
    c_code,
    c_slopes,
    generate_c,
    has_zig,
    run_compiler,
    sources_directory,
    zig_command,
)
from psa_casadi.simulation.exact.generate import generate
from psa_casadi.simulation.exact.printing import Unprintable
from psa_casadi.simulation.exact.run import AT, EQUAL_STEPS, FINEST, LENGTHS, MOST
from psa_casadi.simulation.exact.split import split_of
from psa_casadi.simulation.simulate import (
    AGREE,
    LADDER,
    SHOWN,
    SMALLEST_STEP_RTOL,
    STEP_SHARE,
    STILL,
    TIGHTEST,
)
from psa_casadi.simulation.stepper import SOURCES

_PAGE_SOURCES = ("page/page.c", "page/settle.c", "page/library.c")
#: What a page calls, and how many bytes of stack it has.
_EXPORTS = (
    "reserve", "parameters", "nominal", "error_size", "deviation", "start", "times", "inputs",
    "states", "outputs", "steps", "way", "run",
)  # fmt: skip
_STACK = 1 << 20
#: For the compiler, of every module.
WEB_FLAGS = (
    "--target=wasm32-freestanding", "-std=gnu99", "-O2", "-ffp-contract=off", "-fno-math-errno",
    "-fbuiltin", "-msimd128", "-mbulk-memory",
)  # fmt: skip


def web_module(model: Model) -> bytes:
    """Return the WebAssembly module of a model's equations; its values are set in the page.

    What was compiled is kept. Raises MachineError without the `ziglang` compiler, InputError for a
    model with sampled states, which no page runs.
    """
    return _compiled(model.structure)()


def future_module(model: Model) -> "Future[bytes | None]":
    """Compile a model's module in a thread; the result is None where there is none.

    The log has the reason, unless the compiler is not installed.
    """
    nothing: Future[bytes | None] = Future()
    nothing.set_result(None)
    if not has_zig() or model.sampled_names or model.structure.foreign:
        return nothing
    compiled = _compiled(model.structure)  # the text is CasADi's, which takes one thread

    def module() -> bytes | None:
        try:
            return compiled()
        except (MachineError, OSError) as error:
            logging.getLogger("psa_casadi").warning("The page stays still: %s", error)
            return None

    pool = ThreadPoolExecutor(max_workers=1)
    future = pool.submit(copy_context().run, module)
    pool.shutdown(wait=False)
    return future


@cache
def _compiled(structure: Structure) -> Callable[[], bytes]:
    """Return the function that returns the module's bytes: from the cache, or compiled."""
    if structure.sampled:
        names = ", ".join(s.name for s in structure.sampled)
        raise InputError(
            [f"A page cannot run sampled states ({names}); leave the sampled components out."]
        )
    command = [*zig_command(), *WEB_FLAGS]  # before anything is made: raises where there is none
    texts = module_texts(structure)
    folder = sources_directory()
    digest = hashlib.sha256(repr((version("ziglang"), command[1:], _EXPORTS)).encode())
    digest.update(repr(sorted(texts.items())).encode())
    for path in sorted([*folder.glob("*.[ch]"), *folder.glob("page/*.[ch]")]):
        digest.update(path.name.encode() + path.read_bytes())
    name = f"{digest.hexdigest()[:32]}.wasm"
    return lambda: cached("web", name, lambda work: _compile(work, texts)).read_bytes()


@in_turn
def module_texts(structure: Structure) -> Mapping[str, str]:
    """Return the generated files of a module by their names."""
    s = structure
    outputs = [o.name for o in s.outputs]
    output, split = next((n for n in SHOWN if n in outputs), None), split_of(s)
    exact = {}
    if output is not None and not isinstance(split, str):
        with suppress(Unprintable):  # then it takes no exact steps
            exact["exact_model.h"] = generate(split, (output,))
    by_input = ca.Function(
        "psa_by_input", c_arguments(s), [ca.densify(ca.jacobian(c_slopes(s), s.u))], {"cse": True}
    )
    return {
        **generate_c(s, sensitivities=False),
        **exact,
        "by_input.c": c_code("by_input.c", [by_input]),
        "page_config.h": _config(s, by_input, exact=bool(exact)),
    }


def _config(structure: Structure, by_input: ca.Function, *, exact: bool) -> str:
    s = structure
    gains = [s.parameter_names.index(c.gain) for c in s.components if c.gain is not None]
    ladder = ", ".join(f"{{{share!r}, {coarsest}}}" for share, coarsest in LADDER)
    numbers = {
        "EXACT": int(exact), "LADDER": f"{{{ladder}}}", "AGREE": AGREE, "TIGHTEST": TIGHTEST,
        "STILL": STILL, "STEP_SHARE": STEP_SHARE, "SMALLEST_RTOL": SMALLEST_STEP_RTOL,
        "MOST": MOST, "AT": AT, "ALIKE": EQUAL_STEPS, "LENGTHS": LENGTHS, "FINEST": FINEST,
        "GAINS": len(gains), "SZ_ARG": max(4, by_input.sz_arg()), "SZ_RES": by_input.sz_res(),
        "SZ_IW": max(1, by_input.sz_iw()), "SZ_W": max(1, by_input.sz_w()),
    }  # fmt: skip
    arrays = {
        "page_memory": [int(q.memory) for q in s.states],
        "page_settles": [int(q.settles) for q in s.states],
        "page_gains": gains,
    }
    defined = {f"PAGE_{name}": value for name, value in numbers.items()}
    return filled("config.h", guard="PAGE_CONFIG_H", defined=defined, arrays=arrays)


def _compile(work: Path, texts: Mapping[str, str]) -> Path:
    """Compile the module in a folder and return its path there."""
    for name, text in texts.items():
        (work / name).write_text(text, encoding="utf-8")
    folder = sources_directory()
    sources = [*_PAGE_SOURCES, *SOURCES, *(["exact.c"] if "exact_model.h" in texts else [])]
    command = [
        *zig_command(), *WEB_FLAGS, "-I.", f"-I{folder / 'page'}", f"-I{folder}",
        *(str(folder / name) for name in sources), "model.c", "by_input.c",
        "-Wl,--no-entry", "-Wl,--strip-all", f"-Wl,-z,stack-size={_STACK}",
        *(f"-Wl,--export=page_{name}" for name in _EXPORTS), "-o", "model.wasm",
    ]  # fmt: skip
    run_compiler(command, work)
    if not (work / "model.wasm").is_file():
        raise MachineError(f"The C compiler {command[0]} wrote no module of WebAssembly.")
    return work / "model.wasm"
