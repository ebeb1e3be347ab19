"""Any ordinary differential equation written with CasADi, as a model like every other."""

import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca

from psa_casadi.component import BALANCES, Component, Equations, Expression, Symbols
from psa_casadi.errors import InputError, Problems
from psa_casadi.model.compose import Model, compose
from psa_casadi.units import parse_unit
from psa_casadi.variables import Input, Output, Parameter, State, nominal_value

#: The columns of symbols and of expressions, in the order of the function's inputs and outputs.
SYMBOLS, EXPRESSIONS = ("t", "x", "u", "p"), ("ode", "y", "zero")

#: What else CasADi's integrators know, and why it cannot be here.
_REFUSED = {
    "z": "algebraic variables: solve the algebraic equations for them, or differentiate them once",
    "alg": "algebraic equations: solve them, or differentiate them once",
    "quad": "quadratures: make each a state, its expression a row of 'ode'",
}
#: Other names of the same columns, as this package's own functions have them.
_ALIASES = {"time": "t", "xdot": "ode"}


@dataclass(frozen=True, eq=False)
class CasadiOde:
    """An ODE as a function `f(t, x, u, p) -> (ode, y, zero)` of SX columns.

    `names` are those of the symbols in each column, where they have any.
    """

    f: ca.Function
    names: Mapping[str, tuple[str, ...]]

    def rows(self, column: str) -> int:
        """Return the number of rows of "x", "u", "p" or "y"."""
        if column in SYMBOLS:
            return int(self.f.numel_in(SYMBOLS.index(column)))
        return int(self.f.numel_out(EXPRESSIONS.index(column)))


def read_ode(ode: Mapping[str, Expression] | ca.Function) -> CasadiOde:
    """Read an ODE given as a mapping or as a function.

    Raises InputError with every mistake; see `ode_model`.
    """
    if isinstance(ode, ca.Function):
        return _of_function(ode)
    if not isinstance(ode, Mapping):
        raise InputError(
            f"The ODE is a {type(ode).__name__}; give a mapping such as"
            " {'x': x, 'p': p, 'ode': xdot} or a casadi.Function with such names."
        )
    given = {_ALIASES.get(k, k): v for k, v in ode.items()}
    _check_names(list(given), "The ODE")
    kinds = {k: type(v).__name__ for k, v in given.items() if isinstance(v, ca.SX | ca.MX)}
    if len(set(kinds.values())) > 1:
        listed = ", ".join(f"'{k}' is {kind}" for k, kind in sorted(kinds.items()))
        raise InputError(
            f"The ODE mixes SX and MX ({listed}), which CasADi cannot combine; make all symbols"
            " with casadi.SX.sym, or all with casadi.MX.sym."
        )
    kind = ca.MX if "MX" in kinds.values() else ca.SX
    columns = {k: _column(k, v, kind) for k, v in given.items()}
    _check_symbols(columns)
    function = ca.Function(
        "ode",
        [
            columns.get(k, kind(0, 1)) if k != "t" else columns.get(k, kind.sym("t"))
            for k in SYMBOLS
        ],
        [columns.get(k, kind(0, 1)) for k in EXPRESSIONS],
        list(SYMBOLS),
        list(EXPRESSIONS),
    )
    names = {k: tuple(_names(v)) for k, v in columns.items() if k in SYMBOLS}
    return CasadiOde(_scalar(function), names)


def _of_function(given: ca.Function) -> CasadiOde:
    """Give a user's function our order of inputs and outputs, and empty columns for the rest."""
    inputs = [_ALIASES.get(n, n) for n in given.name_in()]
    outputs = [_ALIASES.get(n, n) for n in given.name_out()]
    _check_names([*inputs, *outputs], f"The function '{given.name()}'")
    sizes = {name: given.size_in(i) for i, name in enumerate(inputs)}
    columns = {k: ca.MX.sym(k, *sizes.get(k, (1 if k == "t" else 0, 1))) for k in SYMBOLS}
    found = given.call([columns[k] for k in inputs])
    results = dict(zip(outputs, found, strict=True))
    _check_symbols({**columns, **results})
    function = ca.Function(
        "ode",
        [columns[k] for k in SYMBOLS],
        [results.get(k, ca.MX(0, 1)) for k in EXPRESSIONS],
        list(SYMBOLS),
        list(EXPRESSIONS),
    )
    return CasadiOde(_scalar(function), {})


def _check_names(names: list[str], what: str) -> None:
    problems = Problems()
    for name in names:
        if name in _REFUSED:
            problems.add(f"{what} has '{name}', {_REFUSED[name]}.")
        elif name not in (*SYMBOLS, *EXPRESSIONS):
            problems.add(
                f"{what} has '{name}', which is not known; there are the symbols"
                f" {', '.join(SYMBOLS)} and the expressions {', '.join(EXPRESSIONS)}."
            )
    for name in ("x", "ode"):
        if name not in names:
            what_it_is = "states" if name == "x" else "derivatives of the states"
            problems.add(f"{what} lacks '{name}', the column of the {what_it_is}; give it.")
    problems.raise_if_any()


def _column(name: str, value: Any, kind: Any) -> Expression:
    """Return what the user gave for one name (an expression, a number, a list) as one column."""
    try:
        column = ca.vertcat(*value) if isinstance(value, list | tuple) else value
        return ca.densify(kind(column))
    except (NotImplementedError, TypeError, RuntimeError) as error:
        raise InputError(
            f"'{name}' is a {type(value).__name__} that is no {kind.__name__} expression; give a"
            " column of CasADi expressions, as casadi.vertcat makes it."
        ) from error


def _check_symbols(columns: Mapping[str, Expression]) -> None:
    """Symbols must be symbols, each in one place; expressions may use no others, and must fit."""
    problems = Problems()
    for name, column in columns.items():
        if column.shape[1] != 1 and column.numel() > 0:
            problems.add(
                f"'{name}' is {column.shape[0]} by {column.shape[1]}; give one column"
                " (casadi.vec makes one of a matrix)."
            )
        if name in SYMBOLS and not column.is_valid_input():
            problems.add(
                f"'{name}' has a row that is an expression; its rows must be symbols of casadi's"
                " sym, and what is computed from them belongs in 'ode' and 'y'."
            )
    problems.raise_if_any()
    if "t" in columns and columns["t"].numel() != 1:
        problems.add(f"'t' has {rows_of(columns['t'].numel())}; time is one symbol.")
    known = _known_symbols(columns, problems)
    for name in EXPRESSIONS:
        if name in columns:
            _check_free(name, columns[name], known, problems)
    if columns["ode"].numel() != columns["x"].numel():
        problems.add(
            f"'x' has {rows_of(columns['x'].numel())} and 'ode' {rows_of(columns['ode'].numel())};"
            " give one derivative for every state."
        )
    problems.raise_if_any()


def _known_symbols(columns: Mapping[str, Expression], problems: Problems) -> set[int]:
    """Return what tells the symbols apart; note those that stand in more than one place."""
    owners: dict[str, list[str]] = {}
    known = set()
    for name in SYMBOLS:
        for symbol in ca.symvar(columns[name]) if name in columns else ():
            known.add(symbol.__hash__())
            owners.setdefault(symbol.name(), []).append(name)
    for own_name, places in owners.items():
        if len(places) > 1:
            problems.add(
                f"The symbol '{own_name}' stands {len(places)} times in {' and '.join(places)};"
                " give every row a symbol and a name of its own."
            )
    return known


def _check_free(
    name: str, expression: Expression, known: Collection[int], problems: Problems
) -> None:
    for symbol in ca.symvar(expression):
        if symbol.__hash__() not in known:
            problems.add(
                f"'{name}' uses the symbol '{symbol.name()}', which is in none of 'x', 'u', 'p' and"
                " 't'; add it to one of them, or put in its number."
            )


def _names(column: Expression) -> list[str]:
    """Return a name for every row of a column of symbols."""
    names = []
    for symbol in ca.symvar(column):
        count = symbol.numel()
        own = symbol.name()
        names += [own] if count == 1 else [f"{own}_{i}" for i in range(count)]
    return names


def rows_of(count: int) -> str:
    """Return "1 row", "2 rows", ..."""
    return f"{count} row{'' if count == 1 else 's'}"


def _scalar(function: ca.Function) -> ca.Function:
    """Return the function of SX; InputError where an operation has no scalar form."""
    try:
        expanded = function.expand("ode")
    except RuntimeError as error:
        raise _no_scalars(str(error).splitlines()[-1].strip()) from error
    for k in range(expanded.n_instructions()):
        if expanded.instruction_id(k) == ca.OP_CALL:
            raise _no_scalars("It calls a function of CasADi that is no formula.")
    return expanded


def _no_scalars(why: str) -> InputError:
    return InputError(
        "The ODE has an operation that is no elementary function of scalars (a table, a solver, an"
        f" external function): {why} Write it with elementary functions, so that it can be printed"
        " as C and as Modelica."
    )


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
    _check_repeated([v.name for rows in found.values() for v in rows], problems)
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


def _check_repeated(names: list[str], problems: Problems) -> None:
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


#: Equations longer than this are not repeated as text in an exported model's documentation.
_TEXT_LIMIT = 600


def ode_model(
    ode: Mapping[str, Expression] | ca.Function,
    *,
    name: str,
    states: Sequence[State | str] | None = None,
    inputs: Sequence[Input | str] | None = None,
    parameters: Sequence[Parameter | str] | None = None,
    outputs: Sequence[Output | str] | None = None,
    values: Mapping[str, float] | None = None,
    description: str = "",
    source: str = "given as a CasADi ODE",
) -> Model:
    """Return the model of x' = ode(t, x, u, p), y = y(t, x, u, p).

    It simulates, and it is exported as an FMU and as a Modelica package, like any other model.

    `ode` maps CasADi's own names to symbols and expressions: "x" (nx states), "ode" (nx
    derivatives), and where there are any "u" (nu inputs), "p" (np parameters), "t" (time [s]), "y"
    (ny outputs; without it every state is shown as NAME_out), "zero" (expressions at whose zeros
    the derivatives have a kink: the solver looks for them, an FMU has them as events). Or it is a
    CasADi function with these names of inputs and outputs. Symbols are SX or MX, in one column for
    each name.

    `states`, `inputs`, `parameters` and `outputs` say what the rows are: `State`, `Input`,
    `Parameter`, `Output` with unit, start, size and bounds; or a name alone: then the unit is 1,
    the start 0 and the usual size 1, and a parameter needs its number in `values`. Left out, the
    names of the symbols are taken (outputs: y, or y_0, y_1, ...). The usual size (`nominal`) is
    what the solver's absolute tolerance is measured by. `values` are numbers of parameters in SI
    units.

    The model cannot be saved as MODEL.json, which names components of this package: CasADi's own
    format of expressions can be read neither in a diff nor by another version. The script that
    makes the model is its source.

    Raises InputError with every mistake: a symbol that is not in x, u, p or t; rows that do not
    fit; SX beside MX; what cannot be expanded to scalar operations; names used twice or reserved;
    unknown units; numbers that are not finite; algebraic equations.
    """
    read = read_ode(ode)
    table = declare(
        read,
        {"x": states, "u": inputs, "p": parameters, "y": outputs},
        values=values or {},
        name=name,
    )
    component = Component(
        name=name,
        description=description or f"the ordinary differential equation '{name}'",
        source=source,
        equations=_equations(read.f, table),
        parameters=table.parameters,
        states=table.states,
        inputs=table.inputs,
        outputs=table.outputs,
        equation_text=_text(read, table),
    )
    return compose([component], values, name=name, description=description)


def _equations(f: ca.Function, table: Declared) -> Callable[[Symbols], Equations]:
    """Return what a component wants: its equations as a function of a model's symbols."""

    def equations(s: Symbols) -> Equations:
        return _named(f, table, lambda name: getattr(s, name))

    return equations


def _named(f: ca.Function, table: Declared, symbol: Callable[[str], Expression]) -> Equations:
    """Return the equations by the names of the table, in the symbols that `symbol` gives."""
    columns = [
        ca.vertcat(ca.SX(0, 1), *[symbol(v.name) for v in rows])
        for rows in (table.states, table.inputs, table.parameters)
    ]
    xdot, y, zero = (ca.SX(e) for e in f(symbol("time"), *columns))
    y = y if y.numel() else columns[0]
    kinks = {f"kink_{i}": zero[i] for i in range(zero.numel())}
    return Equations(
        der={state.name: xdot[i] for i, state in enumerate(table.states)},
        out={output.name: y[i] for i, output in enumerate(table.outputs)},
        switches={"kink": zero[0]} if len(kinks) == 1 else kinks,
    )


def _text(read: CasadiOde, table: Declared) -> str:
    """Return the equations as text, or nothing where they are long."""
    written = _named(read.f, table, ca.SX.sym)
    lines = [f"{name}' = {side}" for name, side in written.der.items()]
    lines += [f"{name} = {side}" for name, side in written.out.items()]
    text = ",  ".join(lines)
    return text if len(text) <= _TEXT_LIMIT else ""
