"""Small FMUs with foreign code that does harm, chosen by the environment when it runs."""

import zipfile
from functools import cache
from pathlib import Path

import fmpy

from psa_casadi.export.check.binaries import FUNCTIONS
from psa_casadi.files import temporary_folder
from psa_casadi.simulation.compiler import OPTIMISE, compiler_command, run_compiler

#: What the library does, and when: "MOMENT:DEED" in this variable; MOMENT is load, make or step.
DEED = "PSA_TEST_DEED"
#: A file of this name takes the number of the process when the deed is done.
PLACE = "PSA_TEST_PLACE"

_SOURCES = Path(__file__).parent / "hostile"
_SOURCE = (_SOURCES / "hostile.c").read_text("utf-8")


#: The functions that do nothing.
_STUBS = "".join(
    f"API int {name}(void) {{ return 0; }}\n"
    for name in sorted(FUNCTIONS[2] | FUNCTIONS[3])
    if f"{name}(" not in _SOURCE
)


@cache
def library() -> bytes:
    """Return the library, compiled once for both versions of FMI, and never loaded here."""
    with temporary_folder() as work:
        (work / "hostile.c").write_text(_SOURCE + _STUBS, encoding="utf-8")
        flags = ("-fPIC", "-fvisibility=hidden", "-shared", "hostile.c", "-o", "hostile.lib")
        run_compiler([*compiler_command(), *OPTIMISE, *flags], work)
        return (work / "hostile.lib").read_bytes()


def hostile_fmu(path: Path, fmi: int, content: bytes | None = None) -> Path:
    """Write the FMU, with another content of its library if one is given."""
    folder = fmpy.platform_tuple if fmi == 3 else fmpy.platform
    with zipfile.ZipFile(path, "w") as archive:
        archive.write(_SOURCES / f"fmi{fmi}.xml", "modelDescription.xml")
        archive.writestr(f"binaries/{folder}/h{fmpy.sharedLibraryExtension}", content or library())
    return path
