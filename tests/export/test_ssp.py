"""SSP archives: what is inside, whether it follows the standard, and a master that steps it."""

import re
import zipfile
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import pytest
from fmpy.ssp.ssd import read_ssd
from lxml import etree  # type: ignore[import-untyped]

import psa_casadi as psa
from psa_casadi.export import ssp
from psa_casadi.export.common.variable_table import OPTIONS
from psa_casadi.export.importer.masters import Signals
from tests.export.fmu_models import assert_valid, model_named
from tests.export.ssp_master import (
    END,
    RATE,
    STACK,
    SspArchive,
    archive_of,
    closed_loop,
    couple,
    monolithic,
    points,
    pushed_stage,
    settles,
)
from tests.tiers import slow, slow_but

#: Each archive is exported once: with pytest-xdist by one process.
pytestmark = pytest.mark.xdist_group("ssp")

_SCHEMAS = {
    ".ssd": "SystemStructureDescription.xsd",
    ".ssv": "SystemStructureParameterValues.xsd",
    ".ssm": "SystemStructureParameterMapping.xsd",
}


def texts(path: Path) -> dict[str, str]:
    """Return the XML files of an archive."""
    with zipfile.ZipFile(path) as archive:
        names = [n for n in archive.namelist() if Path(n).suffix in _SCHEMAS]
        return {n: archive.read(n).decode() for n in names}


@pytest.mark.parametrize("name", slow_but(["pushed_stage"], ["pushed_stage", "closed_loop"]))
def test_every_file_follows_its_schema_and_names_what_the_fmus_have(name: str) -> None:
    path = archive_of(name)
    for place, text in texts(path).items():
        assert_valid(text, "ssp", "schema", _SCHEMAS[Path(place).suffix])
    system = read_ssd(str(path)).system
    with SspArchive(path) as archive:
        for component in system.elements:
            known = {v.name: v for v in archive.fmus[component.name].description.modelVariables}
            for connector in component.connectors:
                assert known[connector.name].causality == connector.kind
        for part, values in archive.parameters.items():
            starts = {v.name: v.start for v in archive.fmus[part].description.modelVariables}
            assert {n: float(starts[n]) for n in values} == values
            assert {*values} == {*archive.fmus[part].names("parameter")} - {*OPTIONS}


@slow
def test_units_of_connectors_are_defined_and_equal_across_every_wire() -> None:
    root = etree.fromstring(texts(archive_of("closed_loop"))["SystemStructure.ssd"].encode())
    defined = {u.get("name"): dict(u[0].attrib) for u in root.iter("{*}Unit")}
    assert defined["V"] == {"kg": "1", "m": "2", "s": "-3", "A": "-1"}
    units = {}
    for connector in root.iter("{*}Connector"):
        owner = connector.getparent().getparent()
        part = ssp.OUTSIDE if etree.QName(owner).localname == "System" else owner.get("name")
        units[ssp.Port(part, connector.get("name"))] = connector.find("{*}Real").get("unit")
    assert set(units.values()) <= set(defined)
    wires = ssp.wiring_of(closed_loop()).wires
    assert len(units) > len(wires)
    assert all(units[w.start] == units[w.end] for w in wires)


def test_the_same_system_gives_the_same_bytes(tmp_path: Path) -> None:
    again = psa.export_ssp(pushed_stage(), tmp_path / "again.ssp")
    assert again.read_bytes() == archive_of("pushed_stage").read_bytes()


@slow
def test_the_compensator_keeps_the_parameters_of_its_stack() -> None:
    shared = ssp.shared_parameters(closed_loop().parts)
    assert set(shared["k_L"]) == {"compensator", "stack"}
    assert {"A", "beta", "gamma", "delta", "n"} <= set(shared)
    other = model_named(STACK).with_values({"beta": 0.9 * model_named(STACK).values["beta"]})
    mistuned = psa.nanopositioner(STACK, compensator_stack=other.plant())
    assert "beta" not in ssp.shared_parameters(mistuned.parts)
    mapping = texts(archive_of("closed_loop"))["resources/shared.ssm"]
    assert re.findall(r'source="k_L" target="(.*?)"', mapping) == ["compensator.k_L", "stack.k_L"]


def test_no_wire_runs_through_a_part_or_on_another_wire() -> None:
    wiring = ssp.wiring_of(closed_loop())
    layout = ssp.layout_of(wiring)
    pieces = [
        (wire, *np.sort(ends, axis=0))
        for wire, path in zip(wiring.wires, layout.paths, strict=True)
        for ends in pairwise(path)
    ]
    for wire, low, high in pieces:
        assert np.any(low == high), "wires have right angles"
        for box in layout.boxes:
            apart = (high <= (box.x1, box.y1)) | (low >= (box.x2, box.y2))
            assert apart.any(), (wire, box.name)
    for (one, *a), (other, *b) in combinations(pieces, 2):
        common = np.minimum(a[1], b[1]) - np.maximum(a[0], b[0])
        crossing = np.any(common < 0.0) or not np.any(common > 0.0)  # at a point, or nowhere
        assert crossing or one.start == other.start, (one, other)


@slow
def test_the_picture_shows_every_part_and_port(tmp_path: Path) -> None:
    wiring = ssp.wiring_of(closed_loop())
    layout = ssp.layout_of(wiring)
    svg = ssp.save_wiring(wiring, layout, tmp_path / "wiring.svg").read_bytes()
    with zipfile.ZipFile(archive_of("closed_loop")) as archive:
        assert archive.read("documentation/wiring.svg") == svg
    root = etree.fromstring(svg)
    items = [e.text for e in root.iter("{*}text")]
    assert set(wiring.parts) <= set(items)
    assert {p.name for p in layout.places if p.part} <= set(items)
    png = ssp.save_wiring(wiring, layout, tmp_path / "wiring.png").read_bytes()
    assert png.startswith(b"\x89PNG")
    with pytest.raises(psa.InputError, match=r"\.svg or \.png"):
        ssp.save_wiring(wiring, layout, tmp_path / "wiring.gif")


def test_a_system_that_cannot_be_wired_is_refused_before_anything_is_compiled(
    tmp_path: Path,
) -> None:
    wires = (*pushed_stage().wires, ("flexure.stage_position", "stack.load_force"))
    wrong = psa.System(**{**vars(pushed_stage()), "wires": wires})
    with pytest.raises(psa.InputError, match="load_force"):
        psa.export_ssp(wrong, tmp_path / "wrong.ssp")
    assert not (tmp_path / "wrong.ssp").exists()


@pytest.mark.parametrize("name", slow_but(["pushed_stage"], ["pushed_stage", "closed_loop"]))
def test_the_archive_has_what_omsimulator_requires(name: str) -> None:
    """As its importer reads it: this annotation, by these prefixes, and no canvas.

    OMSimulator 3.0.0.post114 ended with "Unable to add System" without the one, and with "wrong
    xml schema detected" at the other.
    """
    text = texts(archive_of(name))["SystemStructure.ssd"]
    assert "SystemGeometry" not in text
    result = re.search(
        r'<ssd:Annotations>\s*<ssc:Annotation type="org.openmodelica">\s*<oms:Annotations>\s*'
        r'<oms:SimulationInformation>\s*<oms:FixedStepMaster description="oms-ma"'
        r' stepSize="(0\.\d+)" relativeTolerance="(0\.\d+)" />',
        text,
    )
    assert result is not None
    root = etree.fromstring(text.encode())
    assert root.nsmap["oms"].endswith("/OMSimulator/master/schema/oms.xsd")
    assert [c.tag.partition("}")[2] for c in root[0]][-2:] == ["Connections", "Annotations"]
    wiring = ssp.wiring_of(pushed_stage() if name == "pushed_stage" else closed_loop())
    step = float(result[1])
    assert 0.0 < step <= 0.05 * ssp.stable_step(wiring, rates=False)
    assert step <= 1e-3 * float(root.find("{*}DefaultExperiment").get("stopTime"))
    assert f"{step:.0e}"[0] in "125"
    results = re.search(
        r'<oms:SimulationInformation resultFile="(\w+)\.csv" loggingInterval="', text
    )
    assert results is not None
    assert results[1] == wiring.name


def ramp() -> Signals:
    return Signals(("command",), np.array([0.0, 1.0]), np.array([[0.0], [RATE]]))


@pytest.mark.parametrize(("rates", "order"), [(False, 1), (True, 2)])
def test_two_parts_approach_an_independent_solution(rates: bool, order: int) -> None:
    """LSODA on hand-wired equations; to first order, with input derivatives to second."""
    exact = np.array(monolithic())
    errors = []
    with SspArchive(archive_of("pushed_stage")) as archive:
        for step in (1e-6, 5e-7):
            values = couple(
                archive, points(step, END), ramp(), ["stack.x", "stage_position"], rates=rates,
                tolerance=1e-9,
            )  # fmt: skip
            errors.append(float(np.abs(values[-1] - exact).max()) / exact[0])
    assert errors[0] / errors[1] > 0.8 * 2**order
    assert errors[1] < (5e-3 if order == 1 else 2e-6)


@pytest.mark.parametrize("rates", [False, True])
def test_the_predicted_step_is_where_the_coupling_turns_unstable(rates: bool) -> None:
    limit = ssp.stable_step(ssp.wiring_of(pushed_stage()), rates=rates)
    with SspArchive(archive_of("pushed_stage")) as archive:
        assert settles(archive, 0.95 * limit, {}, slopes=rates)
        assert not settles(archive, 1.05 * limit, {}, slopes=rates)
