"""Components of MODEL.json that no table has: their declarations, and their equations as text."""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal, TypeVar

from psa_casadi.common.errors import InputError, Problems
from psa_casadi.model.component import Balance, Component, FmuUsed, KeptEquations, OnDemand
from psa_casadi.model.equation_text import EquationTexts, equations_of, texts_of
from psa_casadi.model.ode_model import check_variable
from psa_casadi.model.ports import Opened, Port, ported
from psa_casadi.model.structure import check_declarations
from psa_casadi.model.variables import Input, Output, Parameter, State, Values, nominal_value

T = TypeVar("T")

#: What a file may hold in all: variables with sums and ports, expressions, their characters.
_MOST = {"variables": 2_000, "expressions": 20_000, "characters of equations": 500_000}


@dataclass(frozen=True)
class OwnParameter(Parameter):
    """What a component declares of a parameter; `value` is its default, null no bound."""

    bounds: tuple[float | None, float | None]  # type: ignore[assignment]
    scale: float | None = None


@dataclass(frozen=True)
class OwnOutput:
    """What a component declares of an output; `nominal` is its usual size."""

    name: str
    unit: str
    description: str
    nominal: float
    display_unit: str | None = None


@dataclass(frozen=True)
class OwnInput(OwnOutput):
    """What a component declares of an input."""

    start: float = 0.0


@dataclass(frozen=True)
class OwnState(OwnInput):
    """What a component declares of a state, continuous or sampled."""

    memory: bool = False
    settles: bool = True
    whole: float | None = None


@dataclass(frozen=True)
class OwnComponent:
    """A component with its equations as text, or with the FMU that has them.

    Its `ports` are places where the components of effects add to these equations: to `applied_U`,
    which takes the place of an input U, to `rate_X`, the rate of a state X, or to `shown_Y`, what a
    sensor shows of an output Y.
    """

    description: str
    source: str
    equations: EquationTexts = field(default_factory=EquationTexts)
    fmu: FmuUsed | None = None
    parameters: tuple[OwnParameter, ...] = ()
    states: tuple[OwnState, ...] = ()
    sampled: tuple[OwnState, ...] = ()
    inputs: tuple[OwnInput, ...] = ()
    outputs: tuple[OwnOutput, ...] = ()
    balances: tuple[Balance, ...] = ()
    ports: tuple[Port, ...] = ()
    sample_period: str | None = None
    gain: str | None = None
    linear: tuple[str, ...] = ()
    belongs_to: Literal["plant", "drive", "sensor", "environment"] = "plant"
    looks_like: str = ""
    equation_text: str = ""


#: What is the same in a file and in a component.
_SAME = ("description", "source", "balances", "sample_period", "gain", "linear", "belongs_to",
         "looks_like", "equation_text")  # fmt: skip
#: The variables of a component, and how a file declares them.
_KINDS: dict[str, tuple[type, type]] = {
    "parameters": (Parameter, OwnParameter),
    "states": (State, OwnState),
    "sampled": (State, OwnState),
    "inputs": (Input, OwnInput),
    "outputs": (Output, OwnOutput),
}
#: Opens an FMU of a file as a component with parameters.
Opener = Callable[[FmuUsed, str, tuple[Parameter, ...]], Component]


def written(component: Component, values: Values) -> OwnComponent:
    """Return what a file has of a component; usual sizes are those at these values.

    Raises InputError for equations that no text can have.
    """
    ports: tuple[Port, ...] = ()
    if isinstance(opened := component.equations, Opened):
        component, ports = opened.component, opened.ports
    same: dict[str, Any] = {name: getattr(component, name) for name in _SAME}
    if component.foreign is not None:
        return OwnComponent(
            **same, ports=ports, fmu=component.foreign.fmu,
            parameters=tuple(_declared(OwnParameter, p, values) for p in component.parameters),
        )  # fmt: skip
    try:
        equations = texts_of(KeptEquations.of(component))
    except InputError as error:
        raise InputError([f"'{component.name}': {p}" for p in error.problems]) from error
    variables: dict[str, Any] = {
        kind: tuple(_declared(form, v, values) for v in getattr(component, kind))
        for kind, (_, form) in _KINDS.items()
    }
    return OwnComponent(**same, **variables, ports=ports, equations=equations)


def _declared(kind: type[T], variable: Any, values: Values) -> T:
    """Return a variable as a file declares it."""
    table: dict[str, Any] = {f.name: getattr(variable, f.name) for f in fields(kind)}  # type: ignore[arg-type]
    for name in ("nominal", "scale", "whole"):
        if table.get(name) is not None:
            table[name] = nominal_value(table[name], values)
    if "bounds" in table:
        table["bounds"] = tuple(b if math.isfinite(b) else None for b in table["bounds"])
    return kind(**table)


def refuse_large(components: Iterable[OwnComponent]) -> None:
    """Raise InputError where components have more together than is read from a file."""
    every = list(components)
    texts = [text for c in every for text in c.equations.every.values()]
    variables = sum(len(getattr(c, k)) for c in every for k in (*_KINDS, "balances", "ports"))
    counts = zip(_MOST.items(), (variables, len(texts), sum(map(len, texts))), strict=True)
    for (what, most), count in counts:
        if count > most:
            raise InputError(
                f"its user-defined components have {count} {what}, of which a file holds"
                f" {most} at most; simplify the model."
            )


def components_of(file: Mapping[str, OwnComponent], opener: Opener) -> dict[str, Component]:
    """Return the components that a file declares, by name.

    Raises InputError with a sentence for each mistake, which starts with its place in the file.
    """
    refuse_large(file.values())
    problems, components = Problems(), {}
    for name, declared in file.items():
        try:
            components[name] = _component(name, declared, opener)
        except InputError as error:
            problems.extend(error.problems)
    problems.raise_if_any()
    return components


def _component(name: str, declared: OwnComponent, opener: Opener) -> Component:
    place = f"own.{name[:80]}"
    variables: dict[str, Any] = {
        kind: tuple(_variable(made, v) for v in getattr(declared, kind))
        for kind, (made, _) in _KINDS.items()
    }
    problems = Problems()
    table = {p.name: p.value for p in variables["parameters"]}
    every = [v for group in variables.values() for v in group]
    sums = [Output(b.name, b.unit, b.description) for b in declared.balances]
    places = [Output(p.variable, p.unit, p.words) for p in declared.ports]
    for variable in (Output(name, "1", ""), *every, *sums, *places):
        check_variable(variable, table, problems)
    for named in (declared.gain, *declared.linear):
        if named is not None and named not in table:
            problems.add(f"'{named}' is a gain or linear, and no parameter of it; declare it.")
    if problems:
        raise InputError([f"'{place}': {p}" for p in problems.sentences()])
    same: dict[str, Any] = {n: getattr(declared, n) for n in _SAME}
    if declared.fmu is not None:
        component = opener(declared.fmu, name, variables["parameters"])
    else:
        equations = equations_of(declared.equations, f"{place}.equations")
        component = Component(name=name, equations=equations, **same, **variables)
        check_declarations(component, equations(OnDemand()))
    opened = ported(component, frozenset(declared.ports))
    kept = opened.equations.ports if isinstance(opened.equations, Opened) else ()
    for port in set(declared.ports) - set(kept):
        raise InputError(f"'{place}.ports' has {port.words}, which it does not have; leave it out.")
    return opened


def _variable(kind: type[T], declared: Any) -> T:
    table = {f.name: getattr(declared, f.name) for f in fields(declared)}
    if "bounds" in table:
        low, high = table["bounds"]
        table["bounds"] = (-math.inf if low is None else low, math.inf if high is None else high)
    return kind(**table)
