"""What is inside an FMU: description, sources that compile alone, binaries that load anywhere."""

import shutil
from dataclasses import replace
from pathlib import Path

import fmpy
import pytest

from psa_casadi.component import Component, Equations
from psa_casadi.components import BASE, COMPONENTS
from psa_casadi.effects import EFFECTS
from psa_casadi.errors import InputError, PsaError
from psa_casadi.export.common.variable_table import variable_table
from psa_casadi.export.fmu.archive import export_fmu
from psa_casadi.export.fmu.platforms import PLATFORMS, compile_library
from psa_casadi.export.fmu.sources import STRICT, write_sources
from psa_casadi.model.compose import compose
from psa_casadi.simulation.compiler import run_compiler
from psa_casadi.variables import Output
from tests.fmu_models import model_named
from tests.tiers import slow_but

STACK = "P-885.51"


@pytest.mark.skipif(not shutil.which("gcc"), reason="gcc is not installed")
@pytest.mark.parametrize("name", slow_but(["flexure"], ["slow_creep", "flexure"]))
def test_sources_compile_alone_without_warnings(name: str, tmp_path: Path) -> None:
    """By gcc; zig's compiler is tried by `build_scripts.compile_c`."""
    written = write_sources(model_named(name).plant(), tmp_path / "sources")
    line = next(
        t for t in (tmp_path / "sources" / "README.txt").read_text().splitlines() if " cc " in t
    )
    command = ["gcc", *line.split()[1:], *STRICT]
    output = command[command.index("-o") + 1]
    run_compiler(command, tmp_path / "sources")
    assert (tmp_path / "sources" / output).stat().st_size > 10_000
    assert {p.name for p in written} >= {"model.c", "model_config.h", "fmi_data.c", "fmi2.c"}


@pytest.mark.usefixtures("without_binary")
def test_sensor_stays_out_unless_wanted(tmp_path: Path) -> None:
    model = compose((*BASE, EFFECTS["sensor_delay"], EFFECTS["offset_drift"]))
    plain = fmpy.read_model_description(str(export_fmu(model, tmp_path / "plant.fmu")))
    whole_path = export_fmu(model, tmp_path / "whole.fmu", include_sensor=True)
    names = {v.name for v in plain.modelVariables}
    assert "displacement" in names
    assert "measured_displacement" not in names
    whole = {v.name for v in fmpy.read_model_description(str(whole_path)).modelVariables}
    assert names < whole
    assert "measured_displacement" in whole


def test_impossible_exports_are_refused(tmp_path: Path) -> None:
    model = model_named(STACK)
    with pytest.raises(InputError, match="cannot name an FMU"):
        export_fmu(model, tmp_path / "a.fmu", name="P-885.51")
    with pytest.raises(InputError, match="'amiga' is not known"):
        export_fmu(model, tmp_path / "a.fmu", platforms=["host", "amiga"])
    flexure = COMPONENTS["flexure"]
    twice = replace(
        flexure,
        outputs=(Output("x_f", "m", "position"),),
        equations=lambda s: replace(flexure.equations(s), out={"x_f": s.x_f}),
    )
    with pytest.raises(InputError, match="Two variables of 'psa' are named 'x_f'"):
        variable_table(compose([twice]))
    gain = Component("gain", "none", "none", lambda s: Equations())
    with pytest.raises(InputError, match="has no state"):
        variable_table(compose([gain]))
    assert not list(tmp_path.iterdir())


def test_a_binary_is_compiled_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """For each source, name, platform and version of the compiler, and never half of one."""
    calls = []

    def compiled(command: list[str], directory: Path) -> None:
        calls.append(command)
        (directory / command[-1]).write_bytes(b"binary %d" % len(calls))

    monkeypatch.setenv("PSA_CASADI_CACHE", str(tmp_path))
    monkeypatch.setattr("psa_casadi.export.fmu.platforms.run_compiler", compiled)
    texts, linux = {"model.c": "int a;"}, PLATFORMS["x86_64-linux"]
    first = compile_library(texts, "psa", linux)
    assert compile_library(dict(texts), "psa", linux) == first == b"binary 1"
    others = [
        compile_library({"model.c": "int b;"}, "psa", linux),
        compile_library(texts, "other", linux),
        compile_library(texts, "psa", PLATFORMS["aarch64-linux"]),
    ]
    monkeypatch.setattr("psa_casadi.export.fmu.platforms.version", lambda _: "99")
    others.append(compile_library(texts, "psa", linux))
    assert len({first, *others}) == len(calls) == 5
    own = replace(linux, target=None)  # a machine's own compiler may change without a new name
    assert compile_library(texts, "psa", own) != compile_library(texts, "psa", own)

    def fails(command: list[str], directory: Path) -> None:
        raise PsaError("no compiler")

    monkeypatch.setattr("psa_casadi.export.fmu.platforms.run_compiler", fails)
    for _ in range(2):
        with pytest.raises(PsaError, match="no compiler"):
            compile_library({"model.c": "int c;"}, "psa", linux)
    assert compile_library(texts, "psa", linux) == others[-1]
