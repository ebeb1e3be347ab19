"""What an FMU carries beside its description: terminals, icons, documentation."""

import html
import io
import re
from dataclasses import replace
from xml.etree import ElementTree as ET

import matplotlib.image
import numpy as np
import pytest
from lxml import etree  # type: ignore[import-untyped]

from psa_casadi.components import BASE, COMPONENTS, SIMPLIFIED
from psa_casadi.effects import EFFECTS
from psa_casadi.export.common.icon import ICONS, SIDE, png, svg
from psa_casadi.export.common.publication import LICENSE_ENTRY
from psa_casadi.export.common.variable_table import variable_table
from psa_casadi.export.fmu.documentation import documentation
from psa_casadi.export.fmu.reference_run import FOLDER, NOTES
from psa_casadi.export.fmu.terminals import terminal_entries, terminals_and_icons, terminals_of
from psa_casadi.model.compose import Model, compose
from psa_casadi.model.stacks import STACKS, stack_model
from psa_casadi.variables import Interval
from tests.fmu_models import assert_valid, entries

STACK = "P-885.51"

flexure = compose([COMPONENTS["flexure"]], name="flexure")
every_effect = compose((*BASE, *EFFECTS.values()), name="every_effect")


# Terminals


@pytest.mark.parametrize("model", [stack_model(STACK), compose(SIMPLIFIED), flexure, every_effect])
def test_terminals_are_valid_and_their_variables_exist(model: Model) -> None:
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


def test_terminals_of_a_stack() -> None:
    found = {t.name: {v: k for v, _, k in t.members} for t in terminals_of(stack_model(STACK))}
    assert found == {
        "electrical": {"voltage": "signal", "current": "inflow"},
        "mechanical": {"displacement": "signal", "velocity": "signal", "load_force": "inflow"},
    }


def test_a_stack_and_a_flexure_connect() -> None:
    """Equal names of members, an input on one side for each output on the other; forces opposed."""
    stack = stack_model(STACK)
    near = next(t for t in terminals_of(stack) if t.name == "mechanical")
    (far,) = terminals_of(flexure)
    ours, theirs = ({m: (v, k) for v, m, k in t.members} for t in (near, far))
    assert set(ours) == set(theirs)
    for member, (variable, kind) in ours.items():
        other, other_kind = theirs[member]
        assert (variable in stack.output_names) == (other in flexure.input_names)
        assert {kind, other_kind} in ({"signal"}, {"inflow", "outflow"})


def test_a_model_without_known_variables_has_no_terminal() -> None:
    drive = compose([COMPONENTS["drive"]])
    assert [t.name for t in terminals_of(drive)] == ["electrical"]
    renamed = replace(flexure, structure=replace(flexure.structure, inputs=()))
    assert terminals_of(renamed) == ()
    assert_valid(terminals_and_icons(renamed), "schema", "fmi3", "fmi3TerminalsAndIcons.xsd")


# Icons


@pytest.mark.parametrize(("model", "drawing"), [(stack_model(STACK), "stack"), (flexure, "block")])
def test_only_a_stack_is_drawn_as_one(model: Model, drawing: str) -> None:
    assert terminal_entries(model)["terminalsAndIcons/icon.png"] == png(ICONS[drawing])
    shapes = svg(ICONS[drawing]).partition("\n")[2].strip()
    assert shapes in documentation(model)


@pytest.mark.parametrize("name", ICONS)
def test_icons_show_the_same_as_png_and_as_svg(name: str) -> None:
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
    seen = expected[..., 3] > 0.0
    assert np.array_equal(picture[..., 3] > 0.0, seen)
    assert picture[seen] == pytest.approx(expected[seen], abs=1e-6)


def test_places_in_the_archives() -> None:
    three, two = entries(STACK, 3), entries(STACK, 2)
    folder = {n for n in three if n.startswith("terminalsAndIcons/")}
    pictures = {f"{n}.{s}" for n in ("icon", "electrical", "mechanical") for s in ("png", "svg")}
    assert folder == {f"terminalsAndIcons/{n}" for n in (*pictures, "terminalsAndIcons.xml")}
    assert not any(n.startswith("terminalsAndIcons/") for n in two)
    assert two["model.png"] == three["terminalsAndIcons/icon.png"]
    shared = {n for n in three if n.startswith(("documentation/", "extra/", "resources/"))}
    shared -= {LICENSE_ENTRY}  # the notices of the headers differ
    assert {n: three[n] for n in shared} == {n: two[n] for n in shared}
    assert {"documentation/index.html", NOTES, f"{FOLDER}/fmi-ls-manifest.xml"} < shared


# Documentation


@pytest.mark.parametrize("model", [stack_model(STACK), flexure, every_effect])
def test_documentation_is_complete(model: Model) -> None:
    page = documentation(model)
    said = html.unescape(re.sub(r"<[^>]*>", "\n", page))
    for component in model.components:
        for text in (component.name, component.description, component.equation_text):
            assert text in said, component.name
        assert component.source in said
    for declared in variable_table(model):
        if declared.kind in ("parameter", "input", "output", "state"):
            assert f"<td>{declared.name}</td>" in page
            assert declared.description in said
    for switch in model.structure.switches:
        assert f"switch.{switch}" in said


def test_documentation_stands_alone() -> None:
    """Well-formed, nothing loaded from elsewhere, every link leads to a file of the archive."""
    page = entries(STACK, 3)["documentation/index.html"].decode()
    etree.fromstring(page.partition("\n")[2].replace('<meta charset="utf-8">', ""))
    assert not re.search(r"<(script|link|img|iframe)|@import|url\(|https?://(?!www\.w3\.org)", page)
    links = re.findall(r'href="([^"]*)"', page)
    assert len(links) == 4
    assert all(link.removeprefix("../") in entries(STACK, 3) for link in links)


def test_documentation_escapes_what_users_write() -> None:
    model = replace(flexure, name="a<b>", description="x < y & <script>alert(1)</script>")
    page = documentation(model)
    assert "<script" not in page
    assert "x &lt; y &amp; &lt;script&gt;" in page
    assert "<title>a&lt;b&gt;</title>" in page


def test_documentation_tells_the_source_of_a_stack_s_figures() -> None:
    page = html.unescape(documentation(stack_model(STACK)))
    stack = STACKS[STACK]
    assert all(figure.source in page for figure in stack.values.values())
    assert page.count(">assumed: ") == len(stack.assumed)
    changed = stack_model(STACK).with_values({"tau": 3e-4})
    assert stack.values["tau"].source not in html.unescape(documentation(changed))


@pytest.mark.parametrize(
    ("scale", "said"), [("assumed", "share one unknown"), ("given", "outside")]
)
def test_documentation_states_force_scale_and_intervals(scale: str, said: str) -> None:
    model = stack_model(STACK)
    known = {"tau": Interval(9.5e-5, 1.05e-4)}
    origin = replace(model.provenance, force_scale=scale, intervals=known)
    page = documentation(replace(model, provenance=origin))
    note = re.search(r'<p class="note">(.*?)</p>', page)
    assert note is not None
    assert said in note[1]
    assert "0.095 ms to 0.105 ms" in page
    assert "95 % interval" in page
    assert "95 % interval" not in documentation(model)
    assert 'class="note"' not in documentation(flexure)
