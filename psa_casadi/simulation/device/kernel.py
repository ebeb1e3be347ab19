"""The text of exact steps as a CUDA kernel: one file of those in `fmu_src` and of the model's."""

import re

from psa_casadi.model.compose import Structure
from psa_casadi.simulation.compiler import sources_directory
from psa_casadi.simulation.exact.run import model_text

#: Options of its compiler: functions without a place are the device's; products and sums are
#: rounded one by one, as on the CPU.
OPTIONS = ("--std=c++17", "--device-as-default-execution-space", "--fmad=false")
_INCLUDE = re.compile(r'^#include "(.*)"\n', re.MULTILINE)


def kernel_text(structure: Structure, output: str) -> str:
    """Return the CUDA C++ of a model, whose kernel `psa_exact_sets` runs one set a thread.

    Raises NotExact where the model is not for exact steps.
    """
    given = {"exact_model.h": model_text(structure, output)}
    folder = sources_directory()
    seen: set[str] = set()

    def text(name: str) -> str:
        if name in seen:
            return ""
        seen.add(name)
        found = given.get(name) or (folder / name).read_text(encoding="utf-8")
        return _INCLUDE.sub(lambda match: text(match[1]), found)

    return text("exact_kernel.cu")
