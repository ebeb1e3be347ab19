"""modelDescription.xml of FMI 3.0: valid, complete, and the same model as that of FMI 2.0."""

from functools import cache
from xml.etree import ElementTree as ET

import pytest

from psa_casadi.component import Component, Equations
from psa_casadi.export.fmu.description import dependencies, model_description
from psa_casadi.model.compose import compose
from psa_casadi.model.stacks import STACKS
from psa_casadi.variables import Input, Output, Parameter, State
from tests.export.fmu_models import model_named

NAMES = (*STACKS, "every_effect", "single_mass", "flexure")


@cache
def xml_of(name: str) -> ET.Element:
    return ET.fromstring(model_description(model_named(name), "m", "{t}", fmi=3))


@pytest.mark.parametrize("name", ["P-885.51", "every_effect", "flexure"])
def test_both_versions_describe_one_model(name: str) -> None:
    """Every attribute that both versions know is the same, units and types included."""
    other = ET.fromstring(model_description(model_named(name), "m", "{t}", ()))
    shared = ("name", "valueReference", "description", "causality", "variability", "initial")
    values = ("unit", "displayUnit", "declaredType", "min", "max", "nominal", "start")
    expected = []
    for scalar in other.iter("ScalarVariable"):
        real = scalar.find("Real")
        assert real is not None
        expected.append([*map(scalar.get, shared), *map(real.get, values)])
    found = [[v.get(a) for a in (*shared, *values)] for v in xml_of(name).iter("Float64")]
    assert found == expected
    for part in ("UnitDefinitions", "LogCategories", "DefaultExperiment"):
        texts = [ET.tostring(r.find(part)) for r in (xml_of(name), other)]  # type: ignore[arg-type]
        assert texts[0] == texts[1]


@cache
def entries_of(name: str) -> dict[str, dict[str, dict[str, str]]]:
    """Return tag -> name of the unknown -> name of the known -> kind, as the XML lists them."""
    root = xml_of(name)
    names = {v.attrib["valueReference"]: v.attrib["name"] for v in root.iter("Float64")}
    found: dict[str, dict[str, dict[str, str]]] = {}
    for entry in root.iterfind("ModelStructure/*"):
        knowns = (names[k] for k in entry.attrib["dependencies"].split())
        kinds = entry.attrib["dependenciesKind"].split()
        unknown = names[entry.attrib["valueReference"]]
        found.setdefault(entry.tag, {})[unknown] = dict(zip(knowns, kinds, strict=True))
    return found


@pytest.mark.parametrize("name", NAMES)
def test_structure_lists_every_unknown_in_order(name: str) -> None:
    s, found = model_named(name).structure, entries_of(name)
    outputs, rates = [o.name for o in s.outputs], [f"der({x.name})" for x in s.states]
    tags = ["Output", "ContinuousStateDerivative", "InitialUnknown"]
    assert list(found) == tags + (["EventIndicator"] if s.switches else [])
    assert list(found["Output"]) == outputs
    assert list(found["ContinuousStateDerivative"]) == rates
    assert list(found["InitialUnknown"]) == rates + outputs
    assert list(found.get("EventIndicator", {})) == [f"switch.{n}" for n in s.switches]
    kinds = {k for knowns in found["InitialUnknown"].values() for k in knowns.values()}
    assert kinds <= {"dependent", "constant"}


def test_kinds_of_dependence() -> None:
    """q' = -a q + 2 v + q w: 2 is constant, -a + w depends on w, d/da = -q depends on q."""
    part = Component(
        "part", "part", "part",
        lambda s: Equations(
            der={"q": -s.a * s.q + 2.0 * s.v + s.q * s.w}, out={"y": s.a * s.v, "z": 3.0 * s.q}
        ),
        parameters=(Parameter("a", 1.0, "1", (0.0, 2.0), "rate"),),
        states=(State("q", "m", "position", 1.0),),
        inputs=(Input("v", "V", "voltage"), Input("w", "1", "share")),
        outputs=(Output("y", "V", "scaled"), Output("z", "m", "shown")),
    )  # fmt: skip
    found = dependencies(compose([part]).structure)
    state, v, w, a = ("state", 0), ("input", 0), ("input", 1), ("parameter", 0)
    rate = {state: "dependent", v: "constant", w: "dependent", a: "dependent"}
    assert found["derivative", 0] == rate
    assert found["output", 0] == {v: "tunable", a: "dependent"}
    assert found["output", 1] == {state: "constant"}
