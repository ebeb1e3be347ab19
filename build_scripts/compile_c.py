"""Compile every C file of the project as strict C99, with warnings as errors.

The sources are those an FMU carries and those of the library that the Python side simulates with:
the files of `fmu_src/` and the code generated for a model. Each is compiled on its own with zig's C
compiler, at two levels of optimisation, because some warnings need the optimiser's analysis. Exact
steps are vectors of numbers, an extension of C99, and compiled for one number and for four.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import fmpy

from build_scripts.measured_data import ROOT
from psa_casadi.components import BASE
from psa_casadi.effects import EFFECTS
from psa_casadi.errors import PsaError
from psa_casadi.export.fmu.texts import write_sources
from psa_casadi.export.web.module import WEB_FLAGS, module_texts
from psa_casadi.model.compose import Model, compose
from psa_casadi.simulation.codegen import generate_c
from psa_casadi.simulation.exact.generate import generate
from psa_casadi.simulation.exact.split import split_of
from psa_casadi.simulation.stepper import SOURCES

FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
OPTIMISATION = ("-O0", "-O2")
EXACT_FLAGS = ("-std=gnu99", "-fno-math-errno", "-Wall", "-Wextra", "-Werror")
#: Sets of parameters side by side.
LANES = (1, 4)


def compile_strictly(
    source: Path, include: Sequence[Path], output: Path, flags: Sequence[str] = FLAGS
) -> list[str]:
    """Compile one file at every level of optimisation; return the complaints."""
    complaints = []
    made = "_".join(source.parts[-2:])  # sources of two FMUs have the same names
    for level in OPTIMISATION:
        includes = [f"-I{directory}" for directory in include]
        command = [sys.executable, "-m", "ziglang", "cc", *flags, level, *includes]
        command += ["-c", str(source), "-o", str(output / f"{made}{flags[-1]}.o")]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            complaints.append(f"{source.name} {flags[-1]} {level}:\n{done.stdout}{done.stderr}")
    return complaints


def write_library(model: Model, directory: Path) -> None:
    """Write the sources of the library that integrates a model with its sensitivities."""
    directory.mkdir(parents=True)
    for name, text in generate_c(model.structure, sensitivities=True).items():
        (directory / name).write_text(text, encoding="utf-8")
    for source in (*SOURCES, *(path.name for path in (ROOT / "fmu_src").glob("*.h"))):
        shutil.copy(ROOT / "fmu_src" / source, directory)


def write_exact(model: Model, directory: Path) -> Path:
    """Write the sources of a model's exact steps; return the file to compile."""
    split = split_of(model.structure)
    if isinstance(split, str):
        raise PsaError(f"The model does not split: {split}.")
    directory.mkdir(parents=True, exist_ok=True)
    text = generate(split, "measured_displacement")
    (directory / "exact_model.h").write_text(text, encoding="utf-8")
    for source in (ROOT / "fmu_src").glob("exact*"):
        shutil.copy(source, directory)
    return directory / "exact.c"


def write_imported(directory: Path) -> Path:
    """Write the sources of what calls an imported FMU; return the file to compile."""
    directory.mkdir(parents=True)
    sizes = "".join(f"#define PSA_N{k} {n}\n" for k, n in zip("XUPY", (2, 1, 3, 1), strict=True))
    text = f"#define PSA_IMPORTED_NAME fmu_f\n{sizes}"
    (directory / "imported_config.h").write_text(text, encoding="utf-8")
    for name in ("imported.c", "imported.h"):
        shutil.copy(ROOT / "fmu_src" / name, directory)
    return directory / "imported.c"


def page_work(
    model: Model, directory: Path
) -> list[tuple[Path, tuple[Path, ...], tuple[str, ...]]]:
    """Write what is generated of a model in a page; return its files with folders and flags."""
    directory.mkdir(parents=True)
    for name, text in module_texts(model.structure).items():
        (directory / name).write_text(text, encoding="utf-8")
    here = ROOT / "fmu_src"
    flags = (*WEB_FLAGS, "-Wall", "-Wextra", "-Werror")
    return [(f, (directory, here / "page", here), flags) for f in sorted(here.glob("page/*.c"))]


def main() -> int:
    """Compile all sources of a model; return 1 if the compiler complained or missed a file.

    The FMUs, of FMI 2 and FMI 3, are those of the base model, the library that of the model with
    every effect. Exact steps are those of the base, and of a load, whose ports feed back.
    """
    headers = Path(fmpy.__file__).parent / "c-code"
    with tempfile.TemporaryDirectory() as scratch:
        sources, objects = Path(scratch, "sources"), Path(scratch, "objects")
        objects.mkdir()
        os.environ.setdefault("ZIG_GLOBAL_CACHE_DIR", str(Path(tempfile.gettempdir()) / "zig"))
        for fmi in (2, 3):
            write_sources(compose(BASE), sources / f"fmi{fmi}", fmi=fmi)
        write_library(compose((*BASE, *EFFECTS.values())), sources / "library")
        files = sorted(sources.rglob("*.c"))
        exact = [
            write_exact(model, sources / f"exact{k}")
            for k, model in enumerate((compose(BASE), compose((*BASE, EFFECTS["load_stiffness"]))))
        ]
        files.append(write_imported(sources / "imported"))
        missing = {path.name for path in (ROOT / "fmu_src").glob("*.c")}
        missing -= {f.name for f in (*files, *exact)}
        complaints = [f"{name}: not among the written sources." for name in sorted(missing)]
        exactly = [(*EXACT_FLAGS, f"-DPSA_LANES={lanes}") for lanes in LANES]
        work: list[tuple[Path, tuple[Path, ...], tuple[str, ...]]]
        work = [(f, (f.parent, headers), FLAGS) for f in files]
        work += [(f, (f.parent,), flags) for f in exact for flags in exactly]
        work += page_work(compose((*BASE, *EFFECTS.values())), sources / "web")

        def compiled(item: tuple[Path, tuple[Path, ...], tuple[str, ...]]) -> list[str]:
            source, include, flags = item
            print(f"{'/'.join(source.parts[-2:])} {flags[-1]}\n", end="", flush=True)
            return compile_strictly(source, include, objects, flags)

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            complaints += [c for found in pool.map(compiled, work) for c in found]
    print("\n".join(complaints) or f"{len(work)} C files compile without a warning.")
    return 1 if complaints or not files else 0


if __name__ == "__main__":
    sys.exit(main())
