"""The file modelDescription.xml of FMI 2.0 and of FMI 3.0, written from the variable table.

What each unknown depends on is read off the symbolic Jacobian.

Sources: FMI 2.0.5, sections 2.2 (schema), 3.3.1 (model exchange) and 4.3.1 (co-simulation);
FMI 3.0.2, sections 2.4, 3.3 and 4.3.
"""

import math
from collections.abc import Iterable, Sequence
from functools import cache

import casadi as ca

from psa_casadi.common.units import Unit, parse_unit
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
    for unknown, matches in direct.items():
        if unknown[0] != "next":
            sources = [direct["next", index] for kind, index in matches if kind == "sampled"]
            through = {known: "dependent" for source in sources for known in source}
            result[unknown] = {**matches, **through}
    return result


def at_the_start(model: Model) -> dict[Key, dict[Key, str]]:
    """Return the same while a model is initialised.

    Where it has the parameter `start_voltage`, states and voltage start as that has it.
    """
    table = dependencies(model.structure)
    if not starts_at_voltage(model):
        return table
    voltage = model.input_names.index("voltage")
    moved = {("input", voltage), *(("state", i) for i in range(len(model.state_names)))}
    through: dict[Key, str] = {("option", START_INDEX): "dependent"}
    return {u: {**how, **through} if moved & how.keys() else how for u, how in table.items()}


def without_sampled(texts: dict[Key, str]) -> dict[Key, str]:
    """Return what a variable depends on after the initialisation, when no sampled state is set."""
    return {key: how for key, how in texts.items() if key[0] != "sampled"}


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
    description, span, places = describe(model), default_span(model), range(1, len(table) + 1)
    size = span / 1000.0
    if fixed:
        description += (
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
            "description": description,
            **published(model),
            "generationTool": generation_tool(),
            "variableNamingConvention": "structured",
        },
        events=len(model.structure.switches),
        identifier=identifier,
        fixed=number(fixed.plan.step) if fixed else None,
        sources=sorted(sources),
        units=_units(table),
        types=sorted((name, unit) for unit in units if (name := _type_name(unit))),
        span=number(span),
        size=number(size),
        variables=list(zip(places, table, map(_value, table), strict=True)),
        structure=_structure(model, table, second=second, fixed=fixed is not None),
    )


Attributes = dict[str, str | None]


def _units(table: Iterable[Variable]) -> list[tuple[str, dict[str, str] | None, list[Attributes]]]:
    """Return each unit in use, what it is in base units, and its display units, sorted."""
    displays: dict[str, set[str]] = {}
    for variable in table:
        if variable.unit:
            units = displays.setdefault(variable.unit, set())
            units |= {variable.display_unit} if variable.display_unit else set()

    def display(name: str, unit: Unit) -> Attributes:
        other = parse_unit(name)  # displayed value = factor * value + offset
        offset = number((unit.offset - other.offset) / other.factor)
        factor = number(float(unit.ratio / other.ratio))
        moved = unit.offset != other.offset
        return {"name": name, "factor": factor, "offset": offset if moved else None}

    items = []
    for name in sorted(displays):
        unit = parse_unit(name)
        whole = all(isinstance(power, int) for power in unit.exponents)  # FMI has no m2.5
        ways = [display(other, unit) for other in sorted(displays[name])]
        items.append((name, base_unit(unit) if whole else None, ways))
    return items


def _type_name(unit: str) -> str | None:
    """Return the name of the type that variables of a unit have; None for a compound unit."""
    quantity = parse_unit(unit).quantity if unit else ""
    return quantity.title().replace(" ", "") if quantity else None


def _value(it: Variable) -> Attributes:
    """Return what is stated of a variable's value."""
    low, high = it.bounds or (-math.inf, math.inf)
    return {
        "unit": it.unit or None,
        "declaredType": _type_name(it.unit),
        "displayUnit": it.display_unit or None,
        "min": number(low) if math.isfinite(low) else None,
        "max": number(high) if math.isfinite(high) else None,
        "nominal": None if it.nominal is None else number(abs(it.nominal)),
        "start": None if it.start is None else number(it.start),
    }


def _structure(
    model: Model, table: Sequence[Variable], *, second: bool, fixed: bool
) -> list[tuple[str, list[Attributes]]]:
    """Return the unknowns by what they are, in the order of the standard.

    An InitialUnknown knows no "tunable": there it is "dependent".
    """
    result, at_start = dependencies(model.structure), at_the_start(model)
    places = {(v.kind, v.index): place for place, v in enumerate(table, start=1)}
    outputs, rates, indicators = (
        [key for key in places if key[0] == kind] for kind in ("output", "derivative", "indicator")
    )
    initial = sorted([*outputs, *rates], key=places.__getitem__)

    def stated(unknown: Key, *, initially: bool) -> Attributes:
        listed = at_start[unknown] if initially else without_sampled(result[unknown])
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
