"""An FMU (FMI 2.0, model exchange) written by hand in C, with no code of this package.

A pendulum of 1 kg, l^2 phi'' = torque - d phi' - g l sin(phi), without directional derivatives. It
is strict: its parameters are fixed, its memory is the importer's, and what may not be called or set
in a mode is refused.
"""

import tempfile
import zipfile
from functools import cache
from importlib.resources import files
from pathlib import Path

import fmpy
from fmpy.fmi2 import FMU2Model

from psa_casadi.simulation.compiler import compiler_command, run_compiler

_FOLDER = tempfile.TemporaryDirectory()
_SOURCES = Path(__file__).parent / "pendulum"


@cache
def pendulum(*, indicators: int = 0, once: str = "false") -> Path:
    """Return the FMU of the pendulum, with other words in its description."""
    folder = Path(_FOLDER.name) / f"{indicators}{once}"
    folder.mkdir()
    path = folder / "pendulum.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        said = (_SOURCES / "modelDescription.xml").read_text("utf-8")
        said = said.format(indicators=indicators, once=once)
        archive.writestr("modelDescription.xml", said)
        place = f"binaries/{fmpy.platform}/pendulum{fmpy.sharedLibraryExtension}"
        archive.write(_binary(), place)
    return path


@cache
def _binary() -> Path:
    folder = Path(_FOLDER.name)
    code = (_SOURCES / "pendulum.c").read_text("utf-8")
    (folder / "pendulum.c").write_text(code, encoding="utf-8")
    # further ones of the standard, which importers look up
    names = [n for n in dir(FMU2Model) if n[:4] == "fmi2" and f" {n}(" not in code]
    refused = "".join(f"int {name}(void) {{ return 3; }}\n" for name in names)
    (folder / "refused.c").write_text(refused, encoding="utf-8")
    library = folder / f"pendulum{fmpy.sharedLibraryExtension}"
    headers = files("fmpy") / "c-code"
    command = [*compiler_command(), "-O1", "-fPIC", "-shared", f"-I{headers}"]
    run_compiler([*command, "pendulum.c", "refused.c", "-lm", "-o", str(library)], folder)
    return library
