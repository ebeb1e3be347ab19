"""Compile the FMU of every stack and of every effect for every platform, as an export does.

With the compiler of the `ziglang` wheel that is installed; the nightly check has the lowest and the
highest one that pyproject.toml allows. It takes some twenty minutes on two processors.
"""

import os
import sys
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version

from build_scripts.compile_cuda import models
from psa_casadi.common.errors import MachineError
from psa_casadi.export.fmu.platforms import PLATFORMS, Platform, compile_library
from psa_casadi.export.fmu.sources import exported_texts


def complaint(name: str, texts: dict[str, str], target: Platform) -> str:
    """Compile the sources of an FMU; return what went wrong, "" if nothing did."""
    try:
        compile_library(texts, "psa", target)
    except MachineError as error:
        return f"{name} for {target.name}: {error}"
    return ""


def main() -> int:
    """Compile all; return 1 if one of them failed."""
    cases = [(name, exported_texts(model, "psa")[1]) for name, model in models()]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        items = [pool.submit(complaint, *c, p) for c in cases for p in PLATFORMS.values()]
        complaints = [statement for statement in (f.result() for f in items) if statement]
    print("\n".join(complaints))
    print(f"ziglang {version('ziglang')}: {len(items) - len(complaints)} of {len(items)} binaries.")
    return 1 if complaints else 0


if __name__ == "__main__":
    sys.exit(main())
