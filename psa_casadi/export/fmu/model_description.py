"""The file modelDescription.xml of FMI 2.0, written from the variable table.

Source: FMI 2.0.5, sections 2.2 (schema), 3.3.1 (model exchange) and 4.3.1 (co-simulation).
"""

from collections.abc import Iterable, Sequence
from xml.etree import ElementTree as ET

from psa_casadi.export.common.markup import (
    CAUSALITY,
    LOG_CATEGORIES,
    default_experiment,
    describe,
    generation_tool,
    log_categories,
    time_scale,
    types_in_use,
    unit_definitions,
    value_attributes,
    xml_text,
)
from psa_casadi.export.common.publication import published
from psa_casadi.export.common.variable_table import Variable, variable_table
from psa_casadi.export.fmu.dependencies import at_the_start, dependencies, without_sampled
from psa_casadi.model.compose import Model

__all__ = ["LOG_CATEGORIES", "describe", "generation_tool", "model_description", "time_scale"]


def model_description(model: Model, identifier: str, token: str, sources: Sequence[str]) -> str:
    """Return the XML text; `token` is the GUID, `sources` the C files in the folder sources."""
    table = variable_table(model)
    root = ET.Element(
        "fmiModelDescription",
        {
            "fmiVersion": "2.0",
            "modelName": model.name,
            "guid": token,
            "description": describe(model),
            **published(model),
            "generationTool": generation_tool(),
            "variableNamingConvention": "structured",
            "numberOfEventIndicators": str(len(model.structure.switches)),
        },
    )
    _interfaces(root, identifier, sources)
    unit_definitions(root, table)
    _types(root, table)
    log_categories(root)
    default_experiment(root, model)
    variables = ET.SubElement(root, "ModelVariables")
    for reference, variable in enumerate(table, start=1):
        _variable(variables, reference, variable)
    _structure(ET.SubElement(root, "ModelStructure"), model, table)
    return xml_text(root)


def _interfaces(root: ET.Element, identifier: str, sources: Iterable[str]) -> None:
    common = {
        "modelIdentifier": identifier,
        "canNotUseMemoryManagementFunctions": "true",
        "canGetAndSetFMUstate": "true",
        "canSerializeFMUstate": "true",
        "providesDirectionalDerivative": "true",
    }
    stepping = {
        "canHandleVariableCommunicationStepSize": "true",
        "canInterpolateInputs": "true",
        "maxOutputDerivativeOrder": "1",
    }
    files = sorted(sources)
    for tag, more in (("ModelExchange", {}), ("CoSimulation", stepping)):
        element = ET.SubElement(root, tag, {**common, **more})
        listed = ET.SubElement(element, "SourceFiles")
        for name in files:
            ET.SubElement(listed, "File", {"name": name})


def _types(root: ET.Element, table: Iterable[Variable]) -> None:
    definitions = ET.SubElement(root, "TypeDefinitions")
    for name, unit in types_in_use(table).items():
        simple = ET.SubElement(definitions, "SimpleType", {"name": name})
        ET.SubElement(simple, "Real", {"quantity": name, "unit": unit})


def _variable(parent: ET.Element, reference: int, variable: Variable) -> None:
    scalar = ET.SubElement(
        parent,
        "ScalarVariable",
        {
            "name": variable.name,
            "valueReference": str(reference),
            "description": variable.description,
            **CAUSALITY[variable.kind],
        },
    )
    attributes = value_attributes(variable)
    if variable.kind == "derivative":
        attributes["derivative"] = str(variable.index + 2)
    ET.SubElement(scalar, "Real", attributes)


def _structure(parent: ET.Element, model: Model, table: Sequence[Variable]) -> None:
    structure = model.structure
    found, initially = dependencies(structure), at_the_start(model)
    places = {(v.kind, v.index): place for place, v in enumerate(table, start=1)}
    outputs = [("output", i) for i in range(len(structure.outputs))]
    rates = [("derivative", i) for i in range(len(structure.states))]
    for tag, unknowns in (("Outputs", outputs), ("Derivatives", rates), ("InitialUnknowns", None)):
        chosen = (
            sorted([*outputs, *rates], key=places.__getitem__) if unknowns is None else unknowns
        )
        element = ET.SubElement(parent, tag) if chosen else parent
        for unknown in chosen:
            listed = initially[unknown] if unknowns is None else without_sampled(found[unknown])
            known = {places[k]: kind for k, kind in listed.items()}
            attributes = {
                "index": str(places[unknown]),
                "dependencies": " ".join(str(k) for k in sorted(known)),
            }
            if unknowns is not None:
                attributes["dependenciesKind"] = " ".join(known[k] for k in sorted(known))
            ET.SubElement(element, "Unknown", attributes)
