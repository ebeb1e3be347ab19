"""What is inside an FMU: description, sources that compile alone, binaries that load anywhere."""

import re
import shutil
import zipfile
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import fmpy
import pytest

from psa_casadi.component import Component, Equations
from psa_casadi.components import BASE, COMPONENTS
from psa_casadi.effects import EFFECTS
from psa_casadi.errors import InputError, PsaError
from psa_casadi.export.common.markup import time_scale
from psa_casadi.export.common.variable_table import variable_table
from psa_casadi.export.fmu.archive import MODEL_ENTRY, export_fmu
from psa_casadi.export.fmu.description import model_description
from psa_casadi.export.fmu.platforms import PLATFORMS, chosen_platforms, compile_library
from psa_casadi.export.fmu.sources import STRICT, write_sources
from psa_casadi.model.compose import compose
from psa_casadi.model.model_file import loads
from psa_casadi.simulation.compiler import run_compiler
from psa_casadi.units import rate_unit
from psa_casadi.variables import Output
from tests.fmu_models import exported, model_named
from tests.tiers import slow_but

STACK = "P-885.51"


def _binary(path: Path) -> bytes:
    with zipfile.ZipFile(path) as archive:
        name = next(n for n in archive.namelist() if n.startswith("binaries/"))
        return archive.read(name)


def _xml(path: Path) -> ET.Element:
    with zipfile.ZipFile(path) as archive:
        return ET.fromstring(archive.read("modelDescription.xml"))


def test_token_follows_the_model() -> None:
    tokens = {_xml(exported(n)).attrib["guid"] for n in (STACK, "PTBS200", "flexure")}
    assert len(tokens) == 3
    assert all(re.fullmatch(r"\{[0-9a-f-]{36}\}", t) for t in tokens)


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


def test_source_list_is_complete() -> None:
    root = _xml(exported(STACK))
    with zipfile.ZipFile(exported(STACK)) as archive:
        sources = {
            n.removeprefix("sources/") for n in archive.namelist() if n.startswith("sources/")
        }
        listed = ET.fromstring(archive.read("sources/buildDescription.xml"))
    compiled = {n for n in sources if n.endswith(".c")}
    for interface in ("ModelExchange", "CoSimulation"):
        assert {f.attrib["name"] for f in root.findall(f"{interface}/SourceFiles/File")} == compiled
    assert {f.attrib["name"] for f in listed.iter("SourceFile")} == compiled


def test_model_is_inside() -> None:
    with zipfile.ZipFile(exported(STACK)) as archive:
        inside = loads(archive.read(MODEL_ENTRY).decode())
    plant = model_named(STACK).plant()
    assert dict(inside.values) == dict(plant.values)
    assert inside.output_names == plant.output_names


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


@pytest.mark.parametrize("scale", ["assumed", "given"])
def test_description_states_the_force_scale(scale: str) -> None:
    model = model_named(STACK)
    model = replace(model, provenance=replace(model.provenance, force_scale=scale))
    said = ET.fromstring(model_description(model, "m", "t", ())).attrib["description"]
    phrase = {
        "assumed": "only quantities scaled to displacement",
        "given": "stiffness from outside",
    }
    assert phrase[scale] in said
    assert ("assumed" in said) == (scale == "assumed")


def test_variables_of_a_stack() -> None:
    variables = {v.attrib["name"]: v for v in _xml(exported(STACK)).iter("ScalarVariable")}
    tau, x, voltage = (variables[n] for n in ("tau", "x", "voltage"))
    assert (tau.attrib["causality"], tau.attrib["variability"]) == ("parameter", "tunable")
    real = tau.find("Real")
    assert real is not None
    assert {k: real.attrib[k] for k in ("unit", "displayUnit", "start", "min", "max")} == {
        "unit": "s", "displayUnit": "ms", "start": "0.0001", "min": "1e-07", "max": "1.0",
    }  # fmt: skip
    assert x.attrib["initial"] == "exact"
    assert "initial" not in voltage.attrib
    rates = [v for n, v in variables.items() if n.startswith("der(")]
    assert len(rates) == 7
    assert all(r.find("Real[@derivative]") is not None for r in rates)


def test_display_units_convert() -> None:
    units = {u.attrib["name"]: u for u in _xml(exported(STACK)).iter("Unit")}
    shown = units["m"].find("DisplayUnit[@name='um']")
    assert shown is not None
    assert float(shown.attrib["factor"]) == 1e6
    base = units["N/(V.s)"].find("BaseUnit")
    assert base is not None
    assert base.attrib == {"m": "-1", "A": "1"}


def test_dependencies_of_a_flexure() -> None:
    """x_f' = v_f; v_f' = (k_c (x - x_f) + c_c (x' - v_f) - c_f v_f - k_f x_f) / m_f."""
    description = fmpy.read_model_description(str(exported("flexure")))
    found = {
        u.variable.name: dict(
            zip((d.name for d in u.dependencies), u.dependenciesKind, strict=True)
        )
        for u in (*description.derivatives, *description.outputs)
    }
    assert found["der(x_f)"] == {"v_f": "constant"}
    states, inputs = ("x_f", "v_f"), ("tip_position", "tip_velocity")
    parameters = dict.fromkeys(("m_f", "c_f", "k_f", "k_c", "c_c"), "dependent")
    assert found["der(v_f)"] == dict.fromkeys((*states, *inputs), "tunable") | parameters
    contact = dict.fromkeys((*states, *inputs), "tunable")
    assert found["reaction_force"] == contact | dict.fromkeys(("k_c", "c_c"), "dependent")
    assert found["stage_position"] == {"x_f": "constant"}


@pytest.mark.parametrize(
    ("unit", "rate"),
    [("m", "m/s"), ("m/s", "m/s2"), ("m/s2", "m/s3"), ("N/V", "N/(V.s)"), ("N/(V.s)", "N/(V.s2)")],
)
def test_rate_units(unit: str, rate: str) -> None:
    assert rate_unit(unit) == rate


def test_time_scale_follows_the_model() -> None:
    assert time_scale(model_named("manipulator")) == pytest.approx(4 * 5e-3, rel=1e-6)
    assert time_scale(model_named(STACK)) == pytest.approx(4 * 1e-4, rel=1e-6)
    assert time_scale(model_named("slow_creep")) == pytest.approx(4 * 1e-4, rel=1e-6)


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


def test_platforms() -> None:
    assert [p.name for p in chosen_platforms(["all"])] == list(PLATFORMS)
    assert len(chosen_platforms(["host", "all", "host"])) == 9
    assert len({p.folder for p in PLATFORMS.values()}) == 9


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
