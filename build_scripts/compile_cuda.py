"""`python -m build_scripts.compile_cuda [80 90 ...]`: compile the kernels of a GPU without one.

The kernel of every named stack, of the base with each effect, of five and of all of them is
compiled by NVRTC and assembled by ptxas for each compute capability, which needs no GPU; a line
states what a thread takes. It needs `pip install --group cuda`, on Linux.
"""

import ctypes
import importlib.util
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from psa_casadi.model.components import BASE
from psa_casadi.model.compose import Model, compose
from psa_casadi.model.effects import EFFECTS
from psa_casadi.model.stacks import STACKS, stack_model
from psa_casadi.simulation.device import OPTIONS, kernel_text
from psa_casadi.simulation.simulate import SHOWN

CAPABILITIES = ("80", "90")
KERNEL = "psa_exact_sets"
#: Effects with states, loops and groups, together in one model.
FIVE = (
    "slow_creep", "load_stiffness", "rate_dependent_hysteresis", "backlash", "structural_mode",
)  # fmt: skip
_SAID = re.compile(
    rf"'{KERNEL}'.*?(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads"
    r".*?Used (\d+) registers",
    re.DOTALL,
)


def models() -> Iterator[tuple[str, Model]]:
    """Yield what is compiled, with its name."""
    for stack in STACKS:
        yield stack, stack_model(stack)
    for name, effect in EFFECTS.items():
        yield name, compose((*BASE, effect))
    yield "five effects", compose((*BASE, *(EFFECTS[name] for name in FIVE)))
    yield "every effect", compose((*BASE, *EFFECTS.values()))


def tools() -> tuple[ctypes.CDLL, Path]:
    """Return NVRTC and the path of ptxas, from their wheels."""
    result = importlib.util.find_spec("nvidia")
    for folder in result.submodule_search_locations or () if result else ():
        libraries = sorted(Path(folder).glob("cuda_nvrtc/lib/libnvrtc*.so.1?*"))
        assembler = Path(folder, "cuda_nvcc/bin/ptxas")
        if libraries and assembler.exists():
            for builtins in (q for q in libraries if "builtins.so" in q.name):
                ctypes.CDLL(str(builtins), mode=ctypes.RTLD_GLOBAL)
            (library,) = (q for q in libraries if q.name.startswith("libnvrtc.so"))
            return ctypes.CDLL(str(library)), assembler
    raise SystemExit("NVRTC or ptxas is missing: run `pip install --group cuda`, on Linux.")


def compiled(nvrtc: ctypes.CDLL, text: str, capability: str) -> str:
    """Return the PTX of CUDA C++; raises SystemExit with the output of the compiler."""
    program = ctypes.c_void_p()
    nvrtc.nvrtcCreateProgram(ctypes.byref(program), text.encode(), b"kernel.cu", 0, None, None)
    options = [q.encode() for q in (*OPTIONS, f"--gpu-architecture=compute_{capability}")]
    status = nvrtc.nvrtcCompileProgram(
        program, len(options), (ctypes.c_char_p * len(options))(*options)
    )
    wanted = "ProgramLog" if status else "PTX"
    size = ctypes.c_size_t()
    getattr(nvrtc, f"nvrtcGet{wanted}Size")(program, ctypes.byref(size))
    buffer = ctypes.create_string_buffer(size.value)
    getattr(nvrtc, f"nvrtcGet{wanted}")(program, buffer)
    nvrtc.nvrtcDestroyProgram(ctypes.byref(program))
    result = buffer.value.decode()
    if status:
        raise SystemExit(result)
    return result


def taken(ptxas: Path, ptx: str, capability: str) -> str:
    """Return registers, bytes of a thread's memory and bytes of spilled registers."""
    with tempfile.TemporaryDirectory() as scratch:
        Path(scratch, "kernel.ptx").write_text(ptx, encoding="utf-8")
        command = [str(ptxas), "-v", f"-arch=sm_{capability}", "kernel.ptx", "-o", "kernel.cubin"]
        done = subprocess.run(command, cwd=scratch, capture_output=True, text=True, check=False)
    statement = _SAID.search(done.stderr)
    if done.returncode or statement is None:
        raise SystemExit(done.stdout + done.stderr)
    stack, stores, loads, registers = statement.groups()
    return f"{registers} registers, {stack} bytes a thread, spills {stores} and {loads} bytes"


def main() -> int:
    """Compile all kernels for the capabilities that are named; print a line of each."""
    nvrtc, ptxas = tools()
    texts: dict[str, str] = {}
    for name, model in models():
        output = next(q for q in SHOWN if q in model.output_names)
        text = kernel_text(model.structure, output)
        if text in texts:
            print(f"{name}: the kernel of {texts[text]}")
            continue
        texts[text] = name
        for capability in sys.argv[1:] or CAPABILITIES:
            line = taken(ptxas, compiled(nvrtc, text, capability), capability)
            print(f"{name}, sm_{capability}: {line}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
