"""Models and their FMUs for the tests of the export; each is exported once per process."""

import tempfile
import zipfile
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path

from lxml import etree  # type: ignore[import-untyped]

import psa_casadi as psa
from psa_casadi.export.fmu.archive import write_archive
from psa_casadi.export.fmu.platforms import compile_library, host_platform
from tests.model.sampled_models import controller, loop

_FOLDER = tempfile.TemporaryDirectory()

#: A micromanipulator: a soft, heavy mechanism with a lag of 5 ms.
_MANIPULATOR = {
    "R_s": 5.0, "C_p": 2e-6, "u_rated": 100.0, "k_L": 1.0, "A": -0.2, "beta": 0.2, "gamma": 0.05,
    "h_ref": 10.0, "n": 1.0, "tau": 5e-3, "m_P": 0.02, "m_B": 0.1, "k_P": 1e6, "k_B": 5e6,
    "c_P": 10.0, "c_B": 30.0,
}  # fmt: skip


@cache
def model_named(name: str) -> psa.Model:
    """Return a stack by its name, or one of: manipulator, single_mass, flexure, slow_creep.

    Or "every_effect": the base with all effects, each with a small gain; or "loop", "controller":
    sampled ones.
    """
    if name in psa.STACKS:
        figures = psa.STACKS[name].values
        return psa.compose(psa.BASE, {k: figure.value for k, figure in figures.items()})
    gains = {c.gain: 1e-3 for c in psa.EFFECTS.values() if c.gain}
    creep = psa.EFFECTS["slow_creep"]
    made: dict[str, Callable[[], psa.Model]] = {
        "manipulator": lambda: psa.compose(psa.BASE, _MANIPULATOR),
        "single_mass": lambda: psa.compose(psa.SIMPLIFIED),
        "flexure": lambda: psa.compose([psa.COMPONENTS["flexure"]], name="flexure"),
        "every_effect": lambda: psa.compose((*psa.BASE, *psa.EFFECTS.values()), gains, name=name),
        "slow_creep": lambda: psa.compose((*psa.BASE, creep), {"creep_gain": 0.05}),
        "loop": loop,
        "controller": controller,
    }
    return made[name]()


@cache
def exported(name: str, fmi: int = 2) -> Path:
    """Return the FMU of a named model, FMI 2.0 or 3.0."""
    return psa.export_fmu(model_named(name), Path(_FOLDER.name) / f"{name}_{fmi}.fmu", fmi=fmi)


def files_inside(path: Path) -> dict[str, bytes]:
    """Return the files of an archive by their place."""
    with zipfile.ZipFile(path) as archive:
        return {n: archive.read(n) for n in archive.namelist()}


@cache
def entries(name: str, fmi: int) -> dict[str, bytes]:
    """Return the files inside the FMU of a named model."""
    return files_inside(exported(name, fmi))


def assert_valid(text: str, *schema: str) -> None:
    """Validate an XML text with a schema that comes with fmpy, named by its place in there."""
    rules = etree.XMLSchema(file=str(files("fmpy").joinpath(*schema)))
    assert rules.validate(etree.fromstring(text.encode("utf-8"))), rules.error_log


def rewritten(source: Path, target: Path, changes: dict[str, Callable[[bytes], bytes]]) -> Path:
    """Copy an FMU with some entries changed; a change that changes nothing is an error."""
    entries = files_inside(source)
    for name, change in changes.items():
        before = entries[name]
        entries[name] = change(before)
        if entries[name] == before:
            raise ValueError(f"the change of {name} has no effect")
    write_archive(target, entries)
    return target


def recompiled(target: Path, fmi: int, edits: Mapping[str, Sequence[tuple[str, str]]]) -> Path:
    """Change source files of the FMU of P-885.51, compile all, and put the binary in place."""
    inside = entries("P-885.51", fmi)
    texts = {n[8:]: c.decode() for n, c in inside.items() if n.startswith("sources/")}
    for file, changes in edits.items():
        for old, new in changes:
            if old not in texts[file]:
                raise ValueError(f"{file} has no '{old}'")
            texts[file] = texts[file].replace(old, new, 1)
    library = compile_library(texts, "psa", host_platform())
    binary = next(n for n in inside if n.startswith("binaries/"))
    return rewritten(exported("P-885.51", fmi), target, {binary: lambda _: library})
