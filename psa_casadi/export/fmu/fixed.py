"""An FMU whose co-simulation takes steps of fixed length and constant cost, without a solver.

Sources and description are those of the ordinary FMU, changed where the step is: parameters are
constants, as the step is made for their values, and there is no model exchange.
"""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree as ET

from psa_casadi.export.common.markup import number, xml_text
from psa_casadi.export.common.variable_table import OPTIONS
from psa_casadi.export.fixed_step.function import function_code
from psa_casadi.export.fixed_step.plan import bounded, limit_words
from psa_casadi.export.fixed_step.planning import FixedStep
from psa_casadi.export.fixed_step.probe import STEPS, shown_output

#: Where an FMU carries the step [s], its substeps and the measured errors by voltage.
FIXED_ENTRY = "resources/fixed_step.json"
_HEADER, _SOURCE = "fmi_config.h", "fmi_data.c"


def fixed_sources(texts: Mapping[str, str], fixed: FixedStep) -> dict[str, str]:
    """Return the sources of an FMU with the fixed step in them."""
    define = f"#define PSA_FIXED_STEP {fixed.plan.step!r}\n"
    if bounded(fixed.plan):
        define += f"#define PSA_FIXED_LIMIT {fixed.plan.limit!r}\n"
    define += "#endif\n"
    head, end, rest = texts[_HEADER].rpartition("#endif\n")
    code = function_code(fixed.plan, "psa_fixed_step")
    return {**texts, _HEADER: head + define + rest if end else "", _SOURCE: texts[_SOURCE] + code}


def fixed_description(xml: str, fixed: FixedStep) -> str:
    """Return the description of an ordinary FMU as that of one with a fixed step."""
    root = ET.fromstring(xml)
    step = fixed.plan.step
    root.set(
        "description",
        f"{root.get('description')} Co-simulation by a fixed step of {step:g} s, of which a"
        f" communication step is a multiple; largest error {fixed.worst.error:.1e} of the range"
        f" ({fixed.worst.voltage}).",
    )
    third = root.get("fmiVersion") == "3.0"
    exchange, stepping = root.find("ModelExchange"), root.find("CoSimulation")
    experiment = root.find("DefaultExperiment")
    if exchange is not None:
        root.remove(exchange)
    if stepping is not None and third:
        for name in ("providesIntermediateUpdate", "canReturnEarlyAfterIntermediateUpdate"):
            stepping.attrib.pop(name, None)
        stepping.set("fixedInternalStepSize", number(step))
    elif stepping is not None:  # FMI 2 has no word for multiples of a step
        stepping.attrib.pop("canHandleVariableCommunicationStepSize", None)
    if experiment is not None:
        steps = max(1, round(float(experiment.get("stepSize", "0")) / step))
        experiment.set("stepSize", number(steps * step))
    _constants(root, third=third)
    return xml_text(root)


def fixed_entry(fixed: FixedStep) -> bytes:
    """Return the text of `FIXED_ENTRY`; errors have two digits, as they have elsewhere."""
    errors = {e.voltage: float(f"{e.error:.1e}") for e in fixed.errors}
    content = {"step": fixed.plan.step, "substeps": fixed.plan.substeps, "errors": errors}
    if bounded(fixed.plan):
        content["voltage_limit"] = fixed.plan.limit
    return (json.dumps(content, indent=2) + "\n").encode("utf-8")


def use_of(fixed: FixedStep) -> str:
    """Return what the page of the FMU says of its steps."""
    found = ", ".join(f"{e.voltage} {e.error:.1e}" for e in fixed.errors)
    output = shown_output(fixed.plan.model)
    limited = f" {limit_words(fixed.plan.limit)}".rstrip()
    line = "held" if fixed.plan.held else "linear"
    return (
        f"Co-simulation takes steps of {fixed.plan.step:g} s: the same operations each time,"
        " without iteration or allocation. A communication step is a multiple of it; another one is"
        " an error. Parameters are constants, for whose values the step was made. Largest errors of"
        f" {output} over its range, measured at export on voltages of {STEPS} steps, {line} over"
        f" each: {found}.{limited}"
    )


def fixed_step_of(directory: Path) -> float | None:
    """Return the fixed step [s] of an unpacked FMU, None if it has none."""
    header = directory / "sources" / _HEADER
    try:
        text = header.read_text("utf-8")
        found = re.search(r"^#define PSA_FIXED_STEP (\S+)$", text, re.MULTILINE)
        return float(found[1]) if found else None
    except (OSError, ValueError):  # no text, or no number: it is no file of ours
        return None


def _constants(root: ET.Element, *, third: bool) -> None:
    """Make constants of the parameters, on which nothing depends then."""
    variables = root.find("ModelVariables")
    structure = root.find("ModelStructure")
    if variables is None or structure is None:
        return
    gone = set()
    for place, variable in enumerate(variables, start=1):
        if third:
            variable.attrib.pop("intermediateUpdate", None)
        if variable.get("causality") == "parameter" and variable.get("name") not in OPTIONS:
            variable.set("causality", "local")
            variable.set("variability", "constant")
            variable.set("initial", "exact")
            gone.add(str(variable.get("valueReference")) if third else str(place))
    for indicator in structure.findall("EventIndicator"):
        structure.remove(indicator)
    for unknown in structure.iter():
        if "dependencies" not in unknown.attrib:
            continue
        known = unknown.attrib["dependencies"].split()
        kinds = unknown.attrib.get("dependenciesKind", "").split()
        kept = [k for k, name in enumerate(known) if name not in gone]
        unknown.set("dependencies", " ".join(known[k] for k in kept))
        if kinds:
            unknown.set("dependenciesKind", " ".join(kinds[k] for k in kept))
