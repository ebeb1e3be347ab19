"""What is inside an FMU: sources that compile alone, binaries that load, terminals, icons, pages.

And the check of FMUs that another version of CasADi made.
"""

import html
import io
import re
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import casadi as ca
import matplotlib.image
import numpy as np
import pytest
from lxml import etree  # type: ignore[import-untyped]

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.export.check.agreement import expected_outputs
from psa_casadi.export.check.check import CheckRow
from psa_casadi.export.check.description import missing_notices, published_as, unreproducible_parts
from psa_casadi.export.common.icon import ICONS, SIDE, png, svg
from psa_casadi.export.common.publication import LICENSE_ENTRY
from psa_casadi.export.common.variable_table import variable_table
from psa_casadi.export.fmu import reference_run as run_files
from psa_casadi.export.fmu import sources
from psa_casadi.export.fmu.description import dependencies
from psa_casadi.export.fmu.documentation import documentation
from psa_casadi.export.fmu.platforms import PLATFORMS, compile_library
from psa_casadi.export.fmu.reference_run import FOLDER, NOTES, reference_entries
from psa_casadi.export.fmu.sources import STRICT
from psa_casadi.export.fmu.terminals import terminals_and_icons, terminals_of
from psa_casadi.export.importer.archive import Archive
from psa_casadi.export.importer.masters import Signals
from psa_casadi.simulation.compiler import c_code, generate_c, run_compiler
from psa_casadi.simulation.stepper import SimulationError
from tests.contract.helpers import done, refused
from tests.export.fmu_models import (
    assert_valid,
    entries,
    exported,
    files_inside,
    model_named,
    rewritten,
)
from tests.tiers import slow_but

STACK = "P-885.51"


@pytest.mark.skipif(not shutil.which("gcc"), reason="gcc is not installed")
@pytest.mark.parametrize("name", slow_but(["flexure"], ["slow_creep", "flexure"]))
def test_sources_compile_alone_without_warnings(name: str, tmp_path: Path) -> None:
    """By gcc; zig's compiler is tried by `build_scripts.compile_c`."""
    for place, content in entries(name, 2).items():
        if place.startswith("sources/"):
            (tmp_path / Path(place).name).write_bytes(content)
    line = next(t for t in (tmp_path / "README.txt").read_text().splitlines() if " cc " in t)
    command = ["gcc", *line.split()[1:], *STRICT]
    run_compiler(command, tmp_path)
    assert (tmp_path / command[command.index("-o") + 1]).stat().st_size > 10_000


def test_models_that_no_fmu_can_hold_are_refused(tmp_path: Path) -> None:
    flexure = psa.COMPONENTS["flexure"]
    twice = replace(
        flexure, outputs=(psa.Output("x_f", "m", "position"),),
        equations=lambda s: replace(flexure.equations(s), out={"x_f": s.x_f}),
    )  # fmt: skip
    gain = psa.Component("gain", "none", "none", lambda s: psa.Equations())
    for wrong, match in ((twice, "Two variables of 'psa' are named 'x_f'"), (gain, "has no state")):
        with pytest.raises(psa.InputError, match=match):
            psa.export_fmu(psa.compose([wrong]), tmp_path / "a.fmu")
    assert not list(tmp_path.iterdir())


def test_a_binary_is_compiled_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """For each source, name, platform and version of the compiler."""
    calls = []

    def compiled(command: list[str], directory: Path) -> None:
        calls.append(command)
        (directory / command[-1]).write_bytes(b"binary %d" % len(calls))

    monkeypatch.setenv("PSA_CASADI_CACHE", str(tmp_path))
    monkeypatch.setattr("psa_casadi.export.fmu.platforms.run_compiler", compiled)
    texts, linux = {"model.c": "int a;"}, PLATFORMS["x86_64-linux"]
    result = {compile_library(dict(texts), "psa", linux) for _ in range(2)}
    result.add(compile_library({"model.c": "int b;"}, "psa", linux))
    result.add(compile_library(texts, "other", linux))
    result.add(compile_library(texts, "psa", PLATFORMS["aarch64-linux"]))
    monkeypatch.setattr("psa_casadi.export.fmu.platforms.version", lambda _: "99")
    result.add(compile_library(texts, "psa", linux))
    native = replace(linux, target=None)  # a machine's compiler may change without a new name
    result |= {compile_library(texts, "psa", native) for _ in range(2)}
    assert len(result) == len(calls) == 7


@pytest.mark.usefixtures("without_binary")
@pytest.mark.parametrize("fmi", [2, 3])
def test_entries_are_sorted_and_have_no_date_and_a_binary_for_every_platform(
    fmi: int, tmp_path: Path
) -> None:
    path = psa.export_fmu(model_named("flexure"), tmp_path / "a.fmu", platforms=["all"], fmi=fmi)
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
        assert names == sorted(names)
        assert {i.date_time for i in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
    binaries = {f"binaries/{p.binaries(fmi)}/flexure{p.suffix}" for p in PLATFORMS.values()}
    assert {n for n in names if n.startswith("binaries/")} == binaries
    known = {"linux64", "linux32", "win64", "win32", "darwin64"}  # all the names that FMI 2 has
    assert (known if fmi == 2 else set(PLATFORMS)) <= {n.split("/")[1] for n in binaries}
    with pytest.raises(psa.InputError, match="FMI 4 is not known"):
        psa.export_fmu(model_named("demo"), tmp_path / "c.fmu", fmi=4)


XML = "modelDescription.xml"
NOW = ca.CasadiMeta.version()


def _as_another_writes(text: str) -> str:
    """What differs from CasADi 3.8.0 to 3.8.2, and names of variables, which may come to differ."""
    return text.replace(f"CasADi {NOW}", "CasADi 3.7.9").replace("a0", "b0") + "/* no version */\n"


@pytest.fixture(scope="module")
def older(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An FMU whose C another CasADi generated; what is tried here needs no binary."""
    generate, derivatives = generate_c, c_code

    def generated(*args: Any, **options: Any) -> dict[str, str]:
        return {n: _as_another_writes(t) for n, t in generate(*args, **options).items()}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sources, "generate_c", generated)
        patch.setattr(sources, "c_code", lambda *args: _as_another_writes(derivatives(*args)))
        patch.setattr("psa_casadi.export.fmu.archive.compile_library", lambda *_: b"no binary")
        return psa.export_fmu(model_named(STACK), tmp_path_factory.mktemp("fmu") / "older.fmu")


def _reproducible(path: Path) -> CheckRow:
    return next(row for row in psa.check_fmu(path).rows if row.name == "reproducible")


@pytest.mark.usefixtures("code_runs_here")
def test_an_export_of_another_casadi_is_reproducible(older: Path) -> None:
    row = _reproducible(older)
    assert row.passed, row.remark
    assert "CasADi 3.7.9" in row.remark
    assert f"CasADi {NOW}" in row.remark


#: What is changed in it, and the remark of the row then.
CHANGES: dict[str, tuple[str, Callable[[bytes], bytes], str]] = {
    "equation": ("sources/model.c", lambda t: t.replace(b"b0", b"c0", 1), "the token is"),
    "version": ("sources/model.c", lambda t: t.replace(b"3.7.9", NOW.encode()), "model.c differs"),
    "start value": ("sources/fmi_data.c", lambda t: t + b"\n", "fmi_data.c differs"),
    "solver": ("sources/solver.c", lambda t: t + b"\n", "solver.c differs"),
    "bound": (XML, lambda t: t.replace(b'min="', b'min="-', 1), f"{XML} differs"),
}


@pytest.mark.usefixtures("code_runs_here")
@pytest.mark.parametrize("change", slow_but(["equation", "start value"], CHANGES))
def test_a_change_of_it_is_detected(change: str, older: Path, tmp_path: Path) -> None:
    place, edit, remark = CHANGES[change]
    row = _reproducible(rewritten(older, tmp_path / "changed.fmu", {place: edit}))
    assert not row.passed
    assert remark in row.remark


# Terminals


@pytest.mark.parametrize("name", [STACK, "single_mass", "flexure", "every_effect"])
def test_terminals_are_valid_and_their_variables_exist(name: str) -> None:
    model = model_named(name)
    text = terminals_and_icons(model)
    assert_valid(text, "schema", "fmi3", "fmi3TerminalsAndIcons.xsd")
    known = {*model.input_names, *model.output_names}
    root = ET.fromstring(text)
    members = [m.attrib["variableName"] for m in root.iter("TerminalMemberVariable")]
    assert len(members) >= 3
    assert len(set(members)) == len(members)
    assert set(members) <= known
    icons = {g.attrib["iconBaseName"] for g in root.iter("TerminalGraphicalRepresentation")}
    assert icons <= set(ICONS)


def test_a_stack_and_a_flexure_connect() -> None:
    """Equal names of members, an input on one side for each output on the other; forces opposed."""
    stack = psa.stack_model(STACK)
    near = next(t for t in terminals_of(stack) if t.name == "mechanical")
    flexure = model_named("flexure")
    (far,) = terminals_of(flexure)
    ours, theirs = ({m: (v, k) for v, m, k in t.members} for t in (near, far))
    assert set(ours) == set(theirs)
    for member, (variable, kind) in ours.items():
        other, other_kind = theirs[member]
        assert (variable in stack.output_names) == (other in flexure.input_names)
        assert {kind, other_kind} in ({"signal"}, {"inflow", "outflow"})


# Icons


@pytest.mark.parametrize("name", ICONS)
def test_icons_are_the_same_as_png_and_as_svg(name: str) -> None:
    """Every pixel of the PNG has the colour of the last rectangle of the SVG that covers it."""
    picture = matplotlib.image.imread(io.BytesIO(png(ICONS[name])), format="png")
    assert picture.shape == (SIDE, SIDE, 4)
    expected = np.zeros_like(picture)
    for r in ET.fromstring(svg(ICONS[name])):
        left, top, width, height = (int(r.attrib[a]) for a in ("x", "y", "width", "height"))
        assert 0 <= left < left + width <= SIDE
        assert 0 <= top < top + height <= SIDE
        colour = [int(r.attrib["fill"][k : k + 2], 16) / 255.0 for k in (1, 3, 5)]
        expected[top : top + height, left : left + width] = [*colour, 1.0]
    covered = expected[..., 3] > 0.0
    assert np.array_equal(picture[..., 3] > 0.0, covered)
    assert picture[covered] == pytest.approx(expected[covered], abs=1e-6)


# Documentation


@pytest.mark.parametrize("name", [STACK, "flexure", "every_effect"])
def test_documentation_is_complete(name: str) -> None:
    model = model_named(name)
    page = documentation(model)
    words = html.unescape(re.sub(r"<[^>]*>", "\n", page))
    for component in model.components:
        for text in (component.name, component.description, component.equation_text):
            assert text in words, component.name
        assert component.source in words
    for declared in variable_table(model):
        if declared.kind in ("parameter", "input", "output", "state"):
            assert f"<td>{declared.name}</td>" in page
            assert declared.description in words
    for switch in model.structure.switches:
        assert f"switch.{switch}" in words


def test_documentation_loads_nothing() -> None:
    """Well-formed, nothing loaded from elsewhere, every link leads to a file of the archive."""
    page = entries(STACK, 3)["documentation/index.html"].decode()
    etree.fromstring(page.partition("\n")[2].replace('<meta charset="utf-8">', ""))
    assert not re.search(r"<(script|link|img|iframe)|@import|url\(|https?://(?!www\.w3\.org)", page)
    links = re.findall(r'href="([^"]*)"', page)
    assert len(links) == 4
    assert all(link.removeprefix("../") in entries(STACK, 3) for link in links)


def test_documentation_escapes_what_users_write() -> None:
    text = "x < y & <script>alert(1)</script>"
    page = documentation(replace(model_named("flexure"), name="a<b>", description=text))
    assert "<script" not in page
    assert "x &lt; y &amp; &lt;script&gt;" in page
    assert "<title>a&lt;b&gt;</title>" in page


def test_kinds_of_dependence() -> None:
    """q' = -a q + 2 v + q w: 2 is constant, -a + w depends on w, d/da = -q depends on q."""
    q, v, w, a = (ca.SX.sym(name) for name in "qvwa")
    ode = {"x": q, "u": ca.vertcat(v, w), "p": a, "ode": -a * q + 2.0 * v + q * w}
    part = psa.ode_model({**ode, "y": ca.vertcat(a * v, 3.0 * q)}, name="part", values={"a": 1.0})
    result = dependencies(part.structure)
    state, one, two, rate = ("state", 0), ("input", 0), ("input", 1), ("parameter", 0)
    kinds = {state: "dependent", one: "constant", two: "dependent", rate: "dependent"}
    assert result["derivative", 0] == kinds
    assert result["output", 0] == {one: "tunable", rate: "dependent"}
    assert result["output", 1] == {state: "constant"}


def table(content: bytes) -> dict[str, FloatArray]:
    data = np.genfromtxt(io.BytesIO(content), delimiter=",", names=True, deletechars="")
    return {name: data[name] for name in data.dtype.names or ()}


# The reference run


@pytest.mark.parametrize("fmi", [2, 3])
def test_manifest_lists_every_file_as_the_schema_of_the_standard_has_it(fmi: int) -> None:
    """Names, attributes and roles as FMI-LS-REF 1.0.0-beta.1 and the Experiments Format have them.

    Its schema knows no other attribute of a file than these four.
    """
    inside = entries(STACK, fmi)
    root = ET.fromstring(inside[f"{FOLDER}/fmi-ls-manifest.xml"])
    space = "{http://fmi-standard.org/fmi-ls-manifest}fmi-ls-"
    stated = {f"{space}name": "org.fmi-standard.fmi-ls-ref", f"{space}version": "1.0.0-beta.1"}
    assert root.tag == "fmiReferences"
    assert stated.items() < root.attrib.items()
    assert len(root.attrib) == 3
    roles = {}
    for related in root:
        path = f"{FOLDER}/{related.attrib['source']}".replace(f"{FOLDER}/../../", "")
        assert related.tag == "Related"
        assert set(related.attrib) == {"type", "source", "role", "description"}
        assert path in inside
        roles[path] = related.attrib["role"]
    inner = {n for n in inside if n.startswith(FOLDER)} - {f"{FOLDER}/fmi-ls-manifest.xml"}
    assert set(roles) == {*inner, NOTES}
    kinds = {run_files.EXPERIMENTS: "experiment/smoke-test", run_files.PARAMETERS: "parameter"}
    kinds[run_files.OUTPUTS] = "result"
    assert {name: roles[f"{FOLDER}/{name}"] for name in kinds} == kinds
    (experiment,) = ET.fromstring(inside[f"{FOLDER}/{run_files.EXPERIMENTS}"])
    files = (run_files.PARAMETERS, run_files.INPUTS, run_files.OUTPUTS)
    uses = dict(zip(("Parameters", "Stimuli", "References"), files, strict=True))
    assert {e.tag: e.attrib["source"] for e in experiment} == uses
    times = table(inside[f"{FOLDER}/{run_files.OUTPUTS}"])["time"]
    assert float(experiment.attrib["startTime"]) == times[0] == 0.0
    assert float(experiment.attrib["stopTime"]) == times[-1]
    assert float(experiment.attrib["stepSize"]) == pytest.approx(np.diff(times), rel=1e-6)
    assert set(table(inside[f"{FOLDER}/{run_files.INPUTS}"])["time"]) == set(times)


@pytest.mark.parametrize(
    "name", slow_but([STACK, "single_mass"], ["PTBS200", STACK, "manipulator", "single_mass"])
)
def test_reference_outputs_agree_with_the_independent_reference(name: str) -> None:
    model = model_named(name).plant()
    inside = reference_entries(model, {})
    inputs, outputs = (
        table(inside[f"{FOLDER}/{n}"]) for n in (run_files.INPUTS, run_files.OUTPUTS)
    )
    kinks = {name: column[::100] for name, column in inputs.items()}
    times = kinks.pop("time")
    signals = Signals(tuple(kinks), times, np.column_stack(list(kinks.values())))
    truth = expected_outputs(model, outputs["time"], signals)
    for column, (output, result) in zip(truth.T, list(outputs.items())[1:], strict=True):
        assert np.max(np.abs(column - result)) < 1e-6 * np.ptp(result), output


@pytest.mark.usefixtures("without_binary")
def test_a_model_that_cannot_be_simulated_is_exported_without_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise SimulationError("no")

    monkeypatch.setattr("psa_casadi.export.fmu.reference_run.run", fails)
    inside = files_inside(psa.export_fmu(model_named("flexure"), tmp_path / "m.fmu", fmi=3))
    names, page = set(inside), inside["documentation/index.html"].decode()
    assert not any(n.startswith("extra/") for n in names)
    assert NOTES not in names
    assert all(link.removeprefix("../") in names for link in re.findall(r'href="([^"]*)"', page))


TERMS = psa.Publication("A. Author", "1.2", "(c) 2026 A. Author & sons", "CC-BY-4.0")
LICENSE = (Path(__file__).parents[2] / "LICENSE").read_text(encoding="utf-8")


@pytest.mark.parametrize("fmi", [2, 3])
def test_every_fmu_holds_the_notices_that_its_licences_ask_for(fmi: int) -> None:
    """BSD 3-Clause for the code, BSD 2-Clause for the headers, in the binaries' documentation."""
    inside = entries(STACK, fmi)
    assert LICENSE_ENTRY == "documentation/licenses/license.txt"
    text = inside[LICENSE_ENTRY].decode()
    assert LICENSE in text
    assert 'Modelica Association Project "FMI"' in text
    assert "Redistributions in binary form" in text.partition("B. Headers")[2]
    assert inside["sources/LICENSE.txt"].decode() == LICENSE
    root = ET.fromstring(inside["modelDescription.xml"])
    assert LICENSE_ENTRY in root.attrib["license"]
    assert LICENSE.splitlines()[2] in root.attrib["copyright"]
    assert not {"author", "version"} & set(root.attrib)


@pytest.mark.parametrize("fmi", slow_but([3], [2, 3]))
def test_the_command_states_them_over_the_file_s_and_the_check_agrees(
    fmi: int, tmp_path: Path
) -> None:
    plain, path = tmp_path / "model.json", tmp_path / "m.fmu"
    publication = psa.Publication(author="file", version="0.9")
    model = replace(model_named("flexure"), publication=publication)
    psa.save_model(model, plain)
    options = ["--author", TERMS.author, "--copyright", TERMS.copyright, "--license", TERMS.license]
    command = ("export", "fmu", "--model", plain, "--fmi", str(fmi), "-o", path)
    done(*command, *options)
    places = ("modelDescription.xml", LICENSE_ENTRY, "documentation/index.html")
    xml, terms, page = (files_inside(path)[place].decode() for place in places)
    assert_valid(xml, "schema", f"fmi{fmi}", f"fmi{fmi}ModelDescription.xsd")
    stated = replace(TERMS, version="0.9").stated
    assert {n: ET.fromstring(xml).attrib[n] for n in stated} == stated
    assert all(f"{name}: {text}" in terms for name, text in stated.items())
    assert "(c) 2026 A. Author &amp; sons" in page
    with Archive(path) as archived:
        assert list(missing_notices(archived)) == []
        as_exported = published_as(archived, model.plant())
        assert as_exported.publication.stated == stated
        assert list(unreproducible_parts(archived, as_exported)) == []
    assert "--author is ' '" in refused(*command, "--author", " ")


def test_a_licence_that_was_lost_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "m.fmu"
    gone = {LICENSE_ENTRY: lambda _: b"all rights reserved\n"}
    with Archive(rewritten(exported("flexure", 2), path, gone)) as archive:
        (result,) = missing_notices(archive)
    assert "lacks the notice 'Copyright (c)" in result
    unsaid = {"modelDescription.xml": lambda xml: re.sub(rb' license="[^"]*"', b"", xml)}
    with Archive(rewritten(exported("flexure", 2), path, unsaid)) as archive:
        assert list(missing_notices(archive)) == ["the description states no license"]
