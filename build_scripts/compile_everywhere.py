"""Compile the FMU of every stack and of every effect for every platform, as an export does.

With the compiler of the `ziglang` wheel that is installed; the nightly check has the lowest and the
highest one that pyproject.toml allows. It takes some twenty minutes on two processors.
"""

import os
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version

from psa_casadi.components import BASE
from psa_casadi.effects import EFFECTS
from psa_casadi.errors import MachineError
from psa_casadi.export.fmu.platforms import PLATFORMS, Platform, compile_library
from psa_casadi.export.fmu.sources import exported_texts
from psa_casadi.model.compose import Model, compose
from psa_casadi.model.stacks import STACKS


def models() -> Iterator[tuple[str, Model]]:
    """Yield every stack, the base with each effect, and with all of them."""
    for name, stack in STACKS.items():
        yield name, compose(BASE, {k: figure.value for k, figure in stack.values.items()})
    for name, effect in EFFECTS.items():
        yield name, compose((*BASE, effect))
    yield "every effect", compose((*BASE, *EFFECTS.values()))


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
        found = [pool.submit(complaint, *c, p) for c in cases for p in PLATFORMS.values()]
        complaints = [said for said in (f.result() for f in found) if said]
    print("\n".join(complaints))
    print(f"ziglang {version('ziglang')}: {len(found) - len(complaints)} of {len(found)} binaries.")
    return 1 if complaints else 0


if __name__ == "__main__":
    sys.exit(main())
