"""The variables of an ODE: what the user declared of each row, and defaults for the rest."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from psa_casadi.component import BALANCES
from psa_casadi.errors import InputError, Problems
from psa_casadi.model.from_casadi.casadi_ode import CasadiOde, rows_of
from psa_casadi.units import parse_unit
from psa_casadi.variables import Input, Output, Parameter, State, nominal_value

_KINDS: dict[str, tuple[type, str]] = {
    "x": (State, "states"),
    "u": (Input, "inputs"),
    "p": (Parameter, "parameters"),
    "y": (Output, "outputs"),
}
_EVERYWHERE = (-math.inf, math.inf)


@dataclass(frozen=True)
class Declared:
    """The variables of an ODE in the order of its columns."""

    states: tuple[State, ...]
    inputs: tuple[Input, ...]
    parameters: tuple[Parameter, ...]
    outputs: tuple[Output, ...]


def declare(
    read: CasadiOde,
    given: Mapping[str, Sequence[Any] | None],
    *,
    values: Mapping[str, float],
    name: str,
) -> Declared:
    """Return a declaration for each row of "x", "u", "p", "y"; `values` are parameters' numbers.

    Raises InputError with every mistake in names, numbers of rows, units and values.
    """
    problems = Problems()
    if not _is_identifier(name):
        problems.add(
            f"'{name}' cannot name a model; use letters, digits, underscores, no digit first."
        )
    found = {k: _rows(k, read, given.get(k), values, problems) for k in _KINDS}
    declared = [v for rows in found.values() for v in rows]
    if read.rows("y") == 0:
        found["y"] = [_shown(state) for state in found["x"]]
    known = [p.name for p in found["p"]]
    for unknown in (k for k in values if k not in known and len(known) == read.rows("p")):
        problems.add(f"`values` has '{unknown}', which is no parameter; there are {known}.")
    _check_variables(declared, problems)
    _check_sizes(declared, {**{p.name: p.value for p in found["p"]}, **values}, problems)
    _check_names([v.name for rows in found.values() for v in rows], problems)
    for output in found["y"]:
        if output.name == "velocity":
            problems.add(
                "An output is named 'velocity', which models of this package derive from"
                " 'displacement'; choose another name."
            )
    problems.raise_if_any()
    return Declared(tuple(found["x"]), tuple(found["u"]), tuple(found["p"]), tuple(found["y"]))


def _rows(
    column: str,
    read: CasadiOde,
    given: Sequence[Any] | None,
    values: Mapping[str, float],
    problems: Problems,
) -> list[Any]:
    """Return the declarations of one column."""
    kind, what = _KINDS[column]
    count = read.rows(column)
    if given is None:
        rows = f"{column}_" if count > 1 else column
        own = read.names.get(column) or [rows + (str(i) if count > 1 else "") for i in range(count)]
        given = list(own)
    if isinstance(given, str):
        given = [given]
    if len(given) != count:
        problems.add(
            f"{len(given)} of the {what} are declared and '{column}' has {rows_of(count)}; declare"
            " one for every row, in the same order."
        )
        return []
    found = []
    for entry in given:
        if isinstance(entry, kind):
            found.append(entry)
        elif isinstance(entry, str):
            found.append(_default(kind, entry, values, problems))
        else:
            problems.add(f"{entry!r} is among the {what}; give a {kind.__name__} or a name there.")
    return found


def _default(kind: type, name: str, values: Mapping[str, float], problems: Problems) -> Any:
    """Return the declaration of a variable of which only the name is known."""
    word = name.replace("_", " ")
    if kind is State:
        return State(name, "1", f"state {word}", 1.0)
    if kind is Input:
        return Input(name, "1", f"input {word}")
    if kind is Output:
        return Output(name, "1", f"output {word}")
    if name not in values:
        problems.add(
            f"The parameter '{name}' has no number; give it in `values`, or declare a Parameter."
        )
    return Parameter(name, float(values.get(name, 0.0)), "1", _EVERYWHERE, f"parameter {word}")


def _shown(state: State) -> Output:
    """Return the output that shows a state: an ODE without outputs shows all of them."""
    return Output(
        f"{state.name}_out", state.unit, state.description, state.nominal, state.display_unit
    )


def _is_identifier(name: str) -> bool:
    return re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name) is not None


def _check_names(names: list[str], problems: Problems) -> None:
    """All variables share one space of names, as in FMI and Modelica."""
    for name in sorted({n for n in names if names.count(n) > 1}):
        problems.add(f"Two variables are named '{name}'; rename one.")


def _check_variables(variables: list[Any], problems: Problems) -> None:
    """Names are identifiers and not reserved; units are known, numbers finite."""
    for variable in variables:
        if not _is_identifier(variable.name):
            problems.add(
                f"'{variable.name}' cannot name a variable; use letters, digits, underscores, no"
                " digit first."
            )
        if variable.name == "time" or variable.name in BALANCES:
            problems.add(
                f"'{variable.name}' is the name of time or of a sum that models of this package"
                " share; choose another name."
            )
        for unit in (variable.unit, variable.display_unit):
            _check_unit(variable.name, unit, problems)
        numbers = [getattr(variable, k, 0.0) for k in ("start", "value", "nominal")]
        if any(isinstance(n, float | int) and not math.isfinite(n) for n in numbers):
            problems.add(
                f"'{variable.name}' has a start, value or nominal that is not finite; give numbers."
            )


def _check_sizes(variables: list[Any], values: Mapping[str, float], problems: Problems) -> None:
    """A usual size may be a function of parameters; those must be parameters of this model."""
    for variable in variables:
        try:
            nominal_value(getattr(variable, "nominal", 1.0), values)
        except KeyError as error:
            problems.add(
                f"The usual size (nominal) of '{variable.name}' is a function of the parameter"
                f" {error}, which the model does not have; give the size as a number."
            )


def _check_unit(name: str, unit: str | None, problems: Problems) -> None:
    if not unit:
        return
    try:
        parse_unit(unit)
    except InputError as error:
        for problem in error.problems:
            problems.add(f"The unit of '{name}': {problem}")
