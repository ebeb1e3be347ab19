"""The file modelDescription.xml of FMI 3.0, written from the variable table.

Source: FMI 3.0.2, sections 2.4 (schema), 3.3 (model exchange) and 4.3 (co-simulation).
"""

from collections.abc import Sequence
from xml.etree import ElementTree as ET

from psa_casadi.export.common.markup import (
    CAUSALITY,
    default_experiment,
    describe,
    generation_tool,
    log_categories,
    types_in_use,
    unit_definitions,
    value_attributes,
    xml_text,
)
from psa_casadi.export.common.publication import published
from psa_casadi.export.common.variable_table import Variable, variable_table
from psa_casadi.export.fmu.dependencies import Key, at_the_start, dependencies, without_sampled
from psa_casadi.model.compose import Model

_COMMON = (
    "canGetAndSetFMUState",
    "canSerializeFMUState",
    "providesDirectionalDerivatives",
    "providesAdjointDerivatives",
    "providesEvaluateDiscreteStates",
)
_STEPPING = (
    "canHandleVariableCommunicationStepSize",
    "providesIntermediateUpdate",
    "canReturnEarlyAfterIntermediateUpdate",
    "hasEventMode",
)

#: The kinds that an importer may read or set inside its intermediate update.
_IN_BETWEEN = ("state", "derivative", "input", "output")


def model_description3(model: Model, identifier: str, token: str, sources: Sequence[str]) -> str:
    """Return the XML text; `token` is the instantiation token.

    `sources` (the C files) are listed in sources/buildDescription.xml, not here: FMI 3.0 keeps
    them apart. They are an argument so that both versions are called alike.
    """
    del sources
    table = variable_table(model)
    root = ET.Element(
        "fmiModelDescription",
        {
            "fmiVersion": "3.0",
            "modelName": model.name,
            "instantiationToken": token,
            "description": describe(model),
            **published(model),
            "generationTool": generation_tool(),
            "variableNamingConvention": "structured",
        },
    )
    common = {"modelIdentifier": identifier, **dict.fromkeys(_COMMON, "true")}
    stepping = {**dict.fromkeys(_STEPPING, "true"), "maxOutputDerivativeOrder": "1"}
    ET.SubElement(root, "ModelExchange", {**common, "needsCompletedIntegratorStep": "false"})
    ET.SubElement(root, "CoSimulation", {**common, **stepping})
    unit_definitions(root, table)
    definitions = ET.SubElement(root, "TypeDefinitions")
    for name, unit in types_in_use(table).items():
        ET.SubElement(definitions, "Float64Type", {"name": name, "quantity": name, "unit": unit})
    log_categories(root)
    default_experiment(root, model)
    variables = ET.SubElement(root, "ModelVariables")
    for reference, variable in enumerate(table, start=1):
        _variable(variables, reference, variable)
    _structure(ET.SubElement(root, "ModelStructure"), model, table)
    return xml_text(root)


def _variable(parent: ET.Element, reference: int, variable: Variable) -> None:
    attributes = {
        "name": variable.name,
        "valueReference": str(reference),
        "description": variable.description,
        **CAUSALITY[variable.kind],
        **value_attributes(variable),
    }
    if variable.kind in _IN_BETWEEN:
        attributes["intermediateUpdate"] = "true"
    if variable.kind == "derivative":
        attributes["derivative"] = str(variable.index + 2)
    ET.SubElement(parent, "Float64", attributes)


def _structure(parent: ET.Element, model: Model, table: Sequence[Variable]) -> None:
    """Append Output, ContinuousStateDerivative, InitialUnknown and EventIndicator, in this order.

    FMI 3.0 knows no "tunable" in an InitialUnknown; there it is "dependent".
    """
    structure = model.structure
    found, at_start = dependencies(structure), at_the_start(model)
    references = {(v.kind, v.index): place for place, v in enumerate(table, start=1)}
    outputs: list[Key] = [("output", i) for i in range(len(structure.outputs))]
    rates: list[Key] = [("derivative", i) for i in range(len(structure.states))]
    indicators: list[Key] = [("indicator", i) for i in range(len(structure.switches))]
    initial = sorted([*outputs, *rates], key=references.__getitem__)
    for tag, unknowns in (
        ("Output", outputs),
        ("ContinuousStateDerivative", rates),
        ("InitialUnknown", initial),
        ("EventIndicator", indicators),
    ):
        for unknown in unknowns:
            initially = tag == "InitialUnknown"
            listed = at_start[unknown] if initially else without_sampled(found[unknown])
            known = {references[k]: kind for k, kind in listed.items()}
            if initially:
                known = {
                    k: "constant" if v == "constant" else "dependent" for k, v in known.items()
                }
            attributes = {
                "valueReference": str(references[unknown]),
                "dependencies": " ".join(str(k) for k in sorted(known)),
                "dependenciesKind": " ".join(known[k] for k in sorted(known)),
            }
            ET.SubElement(parent, tag, attributes)
