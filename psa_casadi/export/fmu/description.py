"""The file modelDescription.xml of FMI 2.0 and of FMI 3.0, written from the variable table.

What each unknown depends on is read off the symbolic Jacobian.

Sources: FMI 2.0.5, sections 2.2 (schema), 3.3.1 (model exchange) and 4.3.1 (co-simulation);
FMI 3.0.2, sections 2.4, 3.3 and 4.3.
"""

import math
from collections.abc import Iterable, Sequence
from functools import cache

import casadi as ca

from psa_casadi.export.common.markup import (
    base_unit,
    default_span,
    describe,
    generation_tool,
    number,
    xml_text,
)
from psa_casadi.export.common.publication import published
from psa_casadi.export.common.variable_table import (
    START_INDEX,
    Variable,
    starts_at_voltage,
    variable_table,
)
from psa_casadi.export.fixed_step.export import FixedStep
from psa_casadi.model.compose import Model, Structure
from psa_casadi.units import Unit, parse_unit

Key = tuple[str, int]


@cache
def dependencies(structure: Structure) -> dict[Key, dict[Key, str]]:
    """Return for each output, derivative and event indicator what it depends on, and how.

    Keys are (kind, index). The dependence is "constant" where the partial derivative is a number,
    "tunable" where it holds parameters only, else "dependent". Taken from the sparsity of the
    Jacobian with respect to time, states, inputs and parameters.

    At a sample instant a sampled state follows from these and from the sampled states before it,
    so that what depends on it depends on all of them; keys of kind "sampled" stand for the latter.
    """
    s = structure
    variables = {"time": s.time, "state": s.x, "input": s.u, "parameter": s.p, "sampled": s.z}
    switches = ca.vertcat(ca.SX(0, 1), *s.switches.values())
    values = {"derivative": s.xdot, "output": s.y, "indicator": switches, "next": s.znext}
    knowns, unknowns = (
        [(kind, i) for kind, column in columns.items() for i in range(column.numel())]
        for columns in (variables, values)
    )
    jacobian = ca.jacobian(ca.vertcat(*values.values()), ca.vertcat(*variables.values()))
    tunable = {p.name for p in s.parameters}
    direct: dict[Key, dict[Key, str]] = {u: {} for u in unknowns}
    for row, column, entry in zip(
        *jacobian.sparsity().get_triplet(), jacobian.nonzeros(), strict=True
    ):
        names = {str(symbol) for symbol in ca.symvar(entry)}
        varied = "tunable" if names <= tunable else "dependent"
        direct[unknowns[row]][knowns[column]] = varied if names else "constant"
    result = {}
    for unknown, found in direct.items():
        if unknown[0] != "next":
            sources = [direct["next", index] for kind, index in found if kind == "sampled"]
            through = {known: "dependent" for source in sources for known in source}
            result[unknown] = {**found, **through}
    return result


def at_the_start(model: Model) -> dict[Key, dict[Key, str]]:
    """Return the same while a model is initialised.

    Where it has the parameter `start_voltage`, states and voltage start as that has it.
    """
    found = dependencies(model.structure)
    if not starts_at_voltage(model):
        return found
    voltage = model.input_names.index("voltage")
    moved = {("input", voltage), *(("state", i) for i in range(len(model.state_names)))}
    through: dict[Key, str] = {("option", START_INDEX): "dependent"}
    return {u: {**how, **through} if moved & how.keys() else how for u, how in found.items()}


def without_sampled(found: dict[Key, str]) -> dict[Key, str]:
    """Return what a variable depends on after the initialisation, when no sampled state is set."""
    return {key: how for key, how in found.items() if key[0] != "sampled"}


#: Log categories; the last one is shown only when debug logging is on.
LOG_CATEGORIES = {
    "logStatusWarning": "calls that succeeded, but look wrong",
    "logStatusDiscard": "steps and evaluations that failed and may be retried",
    "logStatusError": "calls that are not allowed or impossible",
    "logSolver": "cost of each communication step",
}
#: What each version's interfaces are capable of: of both, of co-simulation, and of that without a
#: fixed step. FMI 2 has no word for multiples of a step.
_ABLE = {
    2: (
        ("canNotUseMemoryManagementFunctions", "canGetAndSetFMUstate", "canSerializeFMUstate",
         "providesDirectionalDerivative"),
        ("canHandleVariableCommunicationStepSize", "canInterpolateInputs"),
        ("canHandleVariableCommunicationStepSize",),
    ),
    3: (
        ("canGetAndSetFMUState", "canSerializeFMUState", "providesDirectionalDerivatives",
         "providesAdjointDerivatives", "providesEvaluateDiscreteStates"),
        ("canHandleVariableCommunicationStepSize", "providesIntermediateUpdate",
         "canReturnEarlyAfterIntermediateUpdate", "hasEventMode"),
        ("providesIntermediateUpdate", "canReturnEarlyAfterIntermediateUpdate"),
    ),
}  # fmt: skip
_CONTINUOUS = {"variability": "continuous"}
#: Causality, variability and initial of each kind of variable; the same words in both versions.
_CAUSALITY = {
    "time": {"causality": "independent", **_CONTINUOUS},
    "state": {"causality": "local", **_CONTINUOUS, "initial": "exact"},
    "derivative": {"causality": "local", **_CONTINUOUS, "initial": "calculated"},
    "input": {"causality": "input", **_CONTINUOUS},
    "output": {"causality": "output", **_CONTINUOUS, "initial": "calculated"},
    "parameter": {"causality": "parameter", "variability": "tunable", "initial": "exact"},
    "option": {"causality": "parameter", "variability": "fixed", "initial": "exact"},
    "indicator": {"causality": "local", **_CONTINUOUS, "initial": "calculated"},
    "sampled": {"causality": "local", "variability": "discrete", "initial": "exact"},
    "constant": {"causality": "local", "variability": "constant", "initial": "exact"},
}


def model_description(
    model: Model,
    identifier: str,
    token: str,
    sources: Sequence[str] = (),
    fmi: int = 2,
    fixed: FixedStep | None = None,
) -> str:
    """Return the XML text of a version of FMI; `token` is the GUID or instantiation token.

    `sources` are the C files in the folder sources. FMI 3.0 lists them in another file. With a
    `fixed` step there is no model exchange, and parameters are constants.
    """
    second, table = fmi == 2, variable_table(model)
    said, span = describe(model), default_span(model)
    size = span / 1000.0
    if fixed:
        said += (
            f" Co-simulation by a fixed step of {fixed.plan.step:g} s, of which a communication"
            f" step is a multiple; largest error {fixed.worst.error:.1e} of the range"
            f" ({fixed.worst.voltage})."
        )
        size = max(1, round(size / fixed.plan.step)) * fixed.plan.step
    units = sorted({v.unit for v in table})
    return xml_text(
        "modelDescription.xml",
        fmi=fmi,
        head={
            "modelName": model.name,
            "guid" if second else "instantiationToken": token,
            "description": said,
            **published(model),
            "generationTool": generation_tool(),
            "variableNamingConvention": "structured",
        },
        events=len(model.structure.switches),
        interfaces=_interfaces(identifier, fmi, fixed),
        sources=sorted(sources),
        units=_units(table),
        types=sorted((name, unit) for unit in units if (name := _type_name(unit))),
        categories=LOG_CATEGORIES,
        span=number(span),
        size=number(size),
        variables=[
            _variable(k, v, second=second, fixed=fixed is not None) for k, v in enumerate(table, 1)
        ],
        structure=_structure(model, table, second=second, fixed=fixed is not None),
    )


def _interfaces(identifier: str, fmi: int, fixed: FixedStep | None) -> dict[str, dict[str, str]]:
    """Return ModelExchange and CoSimulation: what they are capable of."""
    always, stepping, not_fixed = _ABLE[fmi]
    found = {}
    for tag in ("CoSimulation",) if fixed else ("ModelExchange", "CoSimulation"):
        able = (*always, *stepping) if tag == "CoSimulation" else always
        left_out = not_fixed if fixed else ()
        flags = {"modelIdentifier": identifier}
        flags |= {name: "true" for name in able if name not in left_out}
        if tag == "CoSimulation":
            flags["maxOutputDerivativeOrder"] = "1"
        elif fmi == 3:
            flags["needsCompletedIntegratorStep"] = "false"
        if fixed and fmi == 3:
            flags["fixedInternalStepSize"] = number(fixed.plan.step)
        found[tag] = flags
    return found


Attributes = dict[str, str | None]


def _units(table: Iterable[Variable]) -> list[tuple[str, dict[str, str] | None, list[Attributes]]]:
    """Return each unit in use, what it is in base units, and its display units, sorted."""
    displays: dict[str, set[str]] = {}
    for variable in table:
        if variable.unit:
            shown = displays.setdefault(variable.unit, set())
            shown |= {variable.display_unit} if variable.display_unit else set()

    def display(name: str, unit: Unit) -> Attributes:
        other = parse_unit(name)  # value shown = factor * value + offset
        offset = number((unit.offset - other.offset) / other.factor)
        factor = number(float(unit.ratio / other.ratio))
        moved = unit.offset != other.offset
        return {"name": name, "factor": factor, "offset": offset if moved else None}

    found = []
    for name in sorted(displays):
        unit = parse_unit(name)
        whole = all(isinstance(power, int) for power in unit.exponents)  # FMI has no m2.5
        ways = [display(other, unit) for other in sorted(displays[name])]
        found.append((name, base_unit(unit) if whole else None, ways))
    return found


def _type_name(unit: str) -> str | None:
    """Return the name of the type that variables of a unit have; None for a compound unit."""
    quantity = parse_unit(unit).quantity if unit else ""
    return quantity.title().replace(" ", "") if quantity else None


def _variable(
    reference: int, it: Variable, *, second: bool, fixed: bool
) -> tuple[Attributes, Attributes]:
    """Return what a variable is, and what its value is."""
    constant = fixed and it.kind == "parameter"
    head: Attributes = {
        "name": it.name,
        "valueReference": str(reference),
        "description": it.description,
        **_CAUSALITY["constant" if constant else it.kind],
    }
    low, high = it.bounds or (-math.inf, math.inf)
    within = not (second or fixed) and it.kind in ("state", "derivative", "input", "output")
    return head, {
        "unit": it.unit or None,
        "declaredType": _type_name(it.unit),
        "displayUnit": it.display_unit or None,
        "min": number(low) if math.isfinite(low) else None,
        "max": number(high) if math.isfinite(high) else None,
        "nominal": None if it.nominal is None else number(abs(it.nominal)),
        "start": None if it.start is None else number(it.start),
        "intermediateUpdate": "true" if within else None,
        "derivative": str(it.index + 2) if it.kind == "derivative" else None,
    }


def _structure(
    model: Model, table: Sequence[Variable], *, second: bool, fixed: bool
) -> list[tuple[str, list[Attributes]]]:
    """Return the unknowns by what they are, in the order of the standard.

    An InitialUnknown knows no "tunable": there it is "dependent".
    """
    found, at_start = dependencies(model.structure), at_the_start(model)
    places = {(v.kind, v.index): place for place, v in enumerate(table, start=1)}
    outputs, rates, indicators = (
        [key for key in places if key[0] == kind] for kind in ("output", "derivative", "indicator")
    )
    initial = sorted([*outputs, *rates], key=places.__getitem__)

    def stated(unknown: Key, *, initially: bool) -> Attributes:
        listed = at_start[unknown] if initially else without_sampled(found[unknown])
        known = sorted(
            (places[key], "dependent" if initially and kind != "constant" else kind)
            for key, kind in listed.items()
            if not (fixed and key[0] == "parameter")
        )
        kinds = " ".join(kind for _, kind in known)
        return {
            "index" if second else "valueReference": str(places[unknown]),
            "dependencies": " ".join(str(place) for place, _ in known),
            "dependenciesKind": None if second and initially else kinds,
        }

    groups = (
        ("Outputs", "Output", outputs),
        ("Derivatives", "ContinuousStateDerivative", rates),
        ("InitialUnknowns", "InitialUnknown", initial),
        ("", "EventIndicator", [] if second or fixed else indicators),
    )
    return [
        (old if second else new, [stated(u, initially=unknowns is initial) for u in unknowns])
        for old, new, unknowns in groups
        if unknowns
    ]
