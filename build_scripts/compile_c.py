"""Compile every C file of the project as strict C99, with warnings as errors.

The sources are those an FMU carries and those of the library that the Python side simulates with:
the files of `fmu_src/` and the code generated for a model. Each is a separate translation unit
for zig's C compiler, which is started once for a folder: its start took most of the time. They are
optimised, because some warnings need the optimiser's analysis; all others come at every level.
Exact steps are vectors of numbers, an extension of C99, and compiled for one number and for four.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import fmpy

from build_scripts.measured_data import ROOT
from psa_casadi.common.errors import PsaError
from psa_casadi.export.common.templates import filled
from psa_casadi.export.fmu.platforms import PLATFORMS
from psa_casadi.export.fmu.sources import STRICT, exported_texts
from psa_casadi.export.web import WEB_FLAGS, module_texts
from psa_casadi.model.components import BASE
from psa_casadi.model.compose import compose
from psa_casadi.model.effects import EFFECTS
from psa_casadi.simulation.compiler import generate_c
from psa_casadi.simulation.exact.generate import generate
from psa_casadi.simulation.exact.split import split_of
from psa_casadi.simulation.stepper import SOURCES

SOURCE = ROOT / "fmu_src"
FLAGS = ("-std=c99", *STRICT)
OPTIMISATION = "-O2"
EXACT_FLAGS = ("-std=gnu99", "-fno-math-errno", *STRICT, "-Wno-pedantic")
#: Sets of parameters side by side.
LANES = (1, 4)


@dataclass(frozen=True)
class Work:
    """Files of one folder with the same flags, where their headers are, and the flags."""

    sources: tuple[Path, ...]
    include: tuple[Path, ...]
    flags: tuple[str, ...] = FLAGS

    @property
    def name(self) -> str:
        """Folder and last flag."""
        return f"{self.sources[0].parent.name} {self.flags[-1]}"


def compile_strictly(work: Work) -> list[str]:
    """Compile the files, each separately; return the complaints."""
    includes = [f"-I{directory}" for directory in work.include]
    command = [sys.executable, "-m", "ziglang", "cc", *work.flags, OPTIMISATION, *includes]
    command += ["-c", *map(str, work.sources)]
    with tempfile.TemporaryDirectory() as objects:
        done = subprocess.run(command, cwd=objects, capture_output=True, text=True, check=False)
    return [f"{work.name}:\n{done.stdout}{done.stderr}"] if done.returncode != 0 else []


def write(directory: Path, texts: Mapping[str, str], copied: Iterable[str] = ()) -> Path:
    """Write texts, and files of `fmu_src/`, to a new directory; return it."""
    directory.mkdir(parents=True)
    for name, text in texts.items():
        (directory / name).write_text(text, encoding="utf-8")
    for name in copied:
        shutil.copy(SOURCE / name, directory)
    return directory


def write_all(sources: Path) -> list[Work]:
    """Write every source into separate folders; return what is to be compiled.

    The FMU of FMI 2 is that of the base model, that of FMI 3 and the library are those of the model
    with every effect, whose functions are the largest. Exact steps are those of the base, and of a
    load, whose ports feed back.
    """
    headers = Path(fmpy.__file__).parent / "c-code"
    every_effect = compose((*BASE, *EFFECTS.values()))
    for model, fmi in ((compose(BASE), 2), (every_effect, 3)):
        write(sources / f"fmi{fmi}", exported_texts(model, "psa", fmi)[1])
    library = generate_c(every_effect.structure, sensitivities=True)
    write(sources / "library", library, (*SOURCES, *(p.name for p in SOURCE.glob("*.h"))))
    sizes = "".join(f"#define PSA_N{k} {n}\n" for k, n in zip("XUPY", (2, 1, 3, 1), strict=True))
    config = {"imported_config.h": f"#define PSA_IMPORTED_NAME fmu_f\n{sizes}"}
    write(sources / "imported", config, ("imported.c", "imported.h"))
    nested = filled(  # of two parts with one wire
        "nested_config.h", parts=[("a", "a", "a", True), ("b", "b", "b", False)],
        wires=[(1, 2, 0, 1)], shown=[(1, 1)], starts=[(1, 1, "R", 1.0)], token="{token}",
        target=PLATFORMS["x86_64-linux"],
    )  # fmt: skip
    write(sources / "nested", {"nested_config.h": nested}, ("nested.c",))
    work = [
        Work(tuple(sorted(folder.glob("*.c"))), (folder, headers))
        for folder in sorted(sources.iterdir())
    ]
    for k, model in enumerate((compose(BASE), compose((*BASE, EFFECTS["load_stiffness"])))):
        split = split_of(model.structure)
        if isinstance(split, str):
            raise PsaError(f"The model does not split: {split}.")
        text = {"exact_model.h": generate(split, ("measured_displacement",))}
        exact = write(sources / f"exact{k}", text, (p.name for p in SOURCE.glob("exact*")))
        for lanes in LANES:
            flags = (*EXACT_FLAGS, f"-DPSA_LANES={lanes}")
            work.append(Work((exact / "exact.c",), (exact,), flags))
    page = write(sources / "web", module_texts(every_effect.structure))
    folders = (page, SOURCE / "page", SOURCE)
    strict = (*WEB_FLAGS, *STRICT, "-Wno-pedantic")
    return [*work, Work(tuple(sorted(SOURCE.glob("page/*.c"))), folders, strict)]


def main() -> int:
    """Compile all sources of a model; return 1 if the compiler complains or a file is missing."""
    with tempfile.TemporaryDirectory() as scratch:
        os.environ.setdefault("ZIG_GLOBAL_CACHE_DIR", str(Path(tempfile.gettempdir()) / "zig"))
        work = write_all(Path(scratch))
        files = [path for item in work for path in item.sources]
        missing = {path.name for path in SOURCE.glob("*.c")} - {f.name for f in files}
        complaints = [f"{name}: not among the written sources." for name in sorted(missing)]
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            complaints += [c for result in pool.map(compile_strictly, work) for c in result]
    for item in work:
        print(item.name, "-", " ".join(path.name for path in item.sources))
    print("\n".join(complaints) or f"{len(files)} C files compile without a warning.")
    return 1 if complaints or not files else 0


if __name__ == "__main__":
    sys.exit(main())
