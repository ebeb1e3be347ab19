"""Any ordinary differential equation written with CasADi, as a model like every other."""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import casadi as ca

from psa_casadi.common.errors import InputError, Problems
from psa_casadi.common.symbolic import instructions
from psa_casadi.common.units import parse_unit
from psa_casadi.model.component import Balance, Component, Equations, Expression, OnDemand, Symbols
from psa_casadi.model.compose import Model, compose
from psa_casadi.model.variables import Input, Output, Parameter, State, nominal_value

#: The columns of symbols and of expressions, in the order of the function's inputs and outputs.
SYMBOLS, EXPRESSIONS = ("t", "x", "u", "p", "w", "z"), ("ode", "y", "zero", "wdef", "alg")
#: What else CasADi's integrators know, and why it cannot be here.
_REFUSED = {"quad": "quadratures: make each a state, its expression a row of 'ode'"}
#: Columns with as many rows as each other, and what the rows of both are.
_PAIRS = (
    ("x", "ode", "state", "derivative"),
    ("w", "wdef", "intermediate", "expression"),
    ("z", "alg", "algebraic variable", "equation"),
)
#: Other names of the same columns, as this package's functions have them.
_ALIASES = {"time": "t", "xdot": "ode"}
#: What the rows of a column are declared as.
_KINDS: dict[str, tuple[type, str]] = {
    "x": (State, "states"),
    "u": (Input, "inputs"),
    "p": (Parameter, "parameters"),
    "y": (Output, "outputs"),
    "w": (Output, "intermediates"),
}
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
    intermediates: Sequence[Output | str] | None = None,
    values: Mapping[str, float] | None = None,
    description: str = "",
    source: str = "specified as a CasADi ODE",
) -> Model:
    """Return the model of x' = ode(t, x, u, p), y = y(t, x, u, p).

    It simulates, and it is exported as an FMU and as a Modelica package, like any other model.

    `ode` maps CasADi's names to symbols and expressions: "x" (nx states), "ode" (nx
    derivatives), and where there are any "u" (nu inputs), "p" (np parameters), "t" (time [s]), "y"
    (ny outputs; without it every state has an output NAME_out), "zero" (expressions at whose zeros
    the derivatives have a kink: the solver looks for them, an FMU has them as events). Or it is a
    CasADi function with these names of inputs and outputs. Symbols are SX or MX, in one column for
    each name.

    "w" are intermediates (nw symbols: a force, a flow, a voltage drop), which "ode", "y" and other
    intermediates use, and "wdef" their expressions. Each is a port: a place where a diagnosis looks
    for what is missing. "z" are algebraic variables (nz), and "alg" the equations alg(t, x, u, p,
    w, z) = 0, linear in z, that they are solved from.

    `states`, `inputs`, `parameters`, `outputs` and `intermediates` say what the rows are: `State`,
    `Input`, `Parameter`, `Output` (of intermediates, too) with unit, start, size and bounds; or a
    name alone: then the unit is 1, the start 0 and the usual size 1, and a parameter needs its
    number in `values`. Left out, the names of the symbols are taken (outputs: y, or y_0, y_1, ...).
    The usual size (`nominal`) is what the solver's absolute tolerance is measured by. `values` are
    numbers of parameters in SI units.

    MODEL.json keeps it with its equations as text (`psa.save_model`); a usual size that is a
    function of parameters is a number there.

    Raises InputError with every mistake: a symbol that is not in x, u, p or t; rows that do not
    fit; SX mixed with MX; what cannot be expanded to scalar operations; names used twice or
    reserved; unknown units; numbers that are not finite; algebraic equations that are not linear in
    z or leave it open; intermediates that need each other.
    """
    f, names = _read(ode)
    arguments = {"x": states, "u": inputs, "p": parameters, "y": outputs, "w": intermediates}
    table = _declared(f, names, arguments, values or {}, name)
    equations = _equations(f, table)
    written = equations(OnDemand())
    lines = [f"{state}' = {side}" for state, side in written.der.items()]
    sides = {**written.out, **written.add}
    text = ",  ".join([*lines, *(f"{name} = {side}" for name, side in sides.items())])
    component = Component(
        name=name,
        description=description or f"the ordinary differential equation '{name}'",
        source=source,
        equations=equations,
        parameters=tuple(table["p"]),
        states=tuple(table["x"]),
        inputs=tuple(table["u"]),
        outputs=tuple(table["y"]),
        balances=tuple(Balance(w.name, w.unit, w.description) for w in table["w"]),
        equation_text=text if len(text) <= _TEXT_LIMIT else "",
    )
    return compose([component], values, name=name, description=description)


def _read(
    ode: Mapping[str, Expression] | ca.Function,
) -> tuple[ca.Function, dict[str, list[str]]]:
    """Return f(t, x, u, p, w) -> (ode, y, zero, wdef) of SX, and the names of the symbols' rows."""
    kind: Any
    if isinstance(ode, ca.Function):
        kind, what = ca.MX, f"The function '{ode.name()}'"
        inputs, outputs = ([_ALIASES.get(n, n) for n in q] for q in (ode.name_in(), ode.name_out()))
        _check_names([*inputs, *outputs], what)
        columns = {k: ca.MX.sym(k, *ode.size_in(i)) for i, k in enumerate(inputs)}
        columns |= dict(zip(outputs, ode.call([columns[k] for k in inputs]), strict=True))
    elif isinstance(ode, Mapping):
        table = {_ALIASES.get(k, k): v for k, v in ode.items()}
        _check_names(list(table), "The ODE")
        kinds = {k: type(v).__name__ for k, v in table.items() if isinstance(v, ca.SX | ca.MX)}
        if len(set(kinds.values())) > 1:
            listed = ", ".join(f"'{k}' is {kind}" for k, kind in sorted(kinds.items()))
            raise InputError(
                f"The ODE mixes SX and MX ({listed}), which CasADi cannot combine; make all symbols"
                " with casadi.SX.sym, or all with casadi.MX.sym."
            )
        kind = ca.MX if "MX" in kinds.values() else ca.SX
        columns = {k: _column(k, v, kind) for k, v in table.items()}
    else:
        raise InputError(
            f"The ODE is a {type(ode).__name__}; give a mapping such as"
            " {'x': x, 'p': p, 'ode': xdot} or a casadi.Function with such names."
        )
    _check_symbols(columns)
    names: dict[str, list[str]] = {k: [] for k in SYMBOLS}
    for k in SYMBOLS:
        for symbol in ca.symvar(columns[k]) if k in columns else ():
            name, count = symbol.name(), symbol.numel()
            names[k] += [name] if count == 1 else [f"{name}_{i}" for i in range(count)]
    whole = {"t": kind.sym("t"), **columns}
    before, after = ([whole.get(k, kind(0, 1)) for k in q] for q in (SYMBOLS, EXPRESSIONS))
    function = _scalar(ca.Function("ode", before, after, list(SYMBOLS), list(EXPRESSIONS)))
    return _without_algebra(function), names


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
    for symbol, expression, row, side in _PAIRS:
        lacks = {symbol, expression} - {*names}
        if lacks and (row == "state" or len(lacks) == 1):
            for name in sorted(lacks, reverse=True):
                of = f"{row}s" if name == symbol else f"{side}s of the {row}s"
                problems.add(f"{what} lacks '{name}', the column of the {of}; give it.")
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


def _check_columns(columns: Mapping[str, Expression]) -> None:
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
        if name == "t" and column.numel() != 1:
            problems.add(f"'t' has {_rows(column.numel())}; time is one symbol.")
    problems.raise_if_any()


def _check_symbols(columns: Mapping[str, Expression]) -> None:
    """Symbols must be symbols, each in one place; expressions may use no others, and must fit."""
    _check_columns(columns)
    problems = Problems()
    symbols = [(k, s) for k in SYMBOLS if k in columns for s in ca.symvar(columns[k])]
    owners: dict[str, list[str]] = {}
    for column, symbol in symbols:
        owners.setdefault(symbol.name(), []).append(column)
    for name, places in owners.items():
        if len(places) > 1:
            problems.add(
                f"The symbol '{name}' occurs {len(places)} times in {' and '.join(places)};"
                " give every row a separate symbol and name."
            )
    known = {symbol.__hash__() for _, symbol in symbols}
    used = [(k, s) for k in EXPRESSIONS if k in columns for s in ca.symvar(columns[k])]
    for name, symbol in used:
        if symbol.__hash__() not in known:
            problems.add(
                f"'{name}' uses the symbol '{symbol.name()}', which is in none of 'x', 'u', 'p' and"
                " 't'; add it to one of them, or put in its number."
            )
    for one, other, row, side in _PAIRS:
        rows = [columns[n].numel() for n in (one, other) if n in columns]
        if len({*rows}) > 1:
            problems.add(
                f"'{one}' has {_rows(rows[0])} and '{other}' {_rows(rows[1])};"
                f" give one {side} for every {row}."
            )
    problems.raise_if_any()


def _rows(count: int) -> str:
    """Return "1 row", "2 rows", ..."""
    return f"{count} row{'' if count == 1 else 's'}"


def _scalar(function: ca.Function) -> ca.Function:
    """Return the function of SX; InputError where an operation has no scalar form."""
    why, expanded = "It calls a function of CasADi that is no formula.", None
    try:
        expanded = function.expand("ode")
    except RuntimeError as error:
        why = str(error).splitlines()[-1].strip()
    if expanded is None or any(op == ca.OP_CALL for op, *_ in instructions(expanded)):
        raise InputError(
            "The ODE has an operation that is no elementary function of scalars (a table, a"
            f" solver, an external function): {why} Write it with elementary functions, so that it"
            " can be printed as C and as Modelica; psa.table looks up with these."
        )
    return expanded


def _without_algebra(f: ca.Function) -> ca.Function:
    """Return f(t, x, u, p, w) with algebraic variables replaced by what their equations make them.

    These equations have the definition of an intermediate that depends on them.
    """
    *known, w, z = f.sx_in()
    *result, wdef, alg = f(*known, w, z)
    if z.numel():
        follows, of = ca.SX(z), [ca.SX(0, 1)] * 2
        for _ in range(w.numel()):
            rows = [k for k in range(w.numel()) if ca.depends_on(wdef[k], follows)]
            of = [ca.vertcat(*(column[k] for k in rows)) for column in (w, wdef)]
            follows = ca.vertcat(z, of[0])
        for _ in range(w.numel()):
            alg = ca.substitute(alg, *of)
        slopes = ca.jacobian(alg, z)
        open_rows = z.numel() - ca.sprank(slopes)
        if ca.depends_on(slopes, z) or open_rows:
            why = (
                f"leave {open_rows} of 'z' open; differentiate those that hold between states alone"
                if open_rows
                else "are not linear in 'z'; make the rest of each the rate of a fast state"
            )
            raise InputError(f"The algebraic equations 'alg' {why}.")
        solved = -ca.solve(slopes, ca.substitute(alg, z, ca.DM.zeros(z.shape)))
        result, wdef = ca.substitute(result, [z], [solved]), ca.substitute(wdef, z, solved)
    columns = [*SYMBOLS[:-1]], [*EXPRESSIONS[:-1]]
    return ca.Function("ode", [*known, w], [*result, wdef], *columns)


def _declared(
    f: ca.Function,
    names: Mapping[str, list[str]],
    inputs: Mapping[str, Sequence[Any] | None],
    values: Mapping[str, float],
    name: str,
) -> dict[str, list[Any]]:
    """Return a declaration for each row of "x", "u", "p", "y"; raise InputError with all mistakes.

    An ODE without outputs shows all of its states.
    """
    problems = Problems()
    if not is_identifier(name):
        problems.add(
            f"'{name}' cannot name a model; use letters, digits, underscores, no digit first."
        )
    table: dict[str, list[Any]] = {}
    for column, (kind, what) in _KINDS.items():
        count = f.numel_out(column) if column in EXPRESSIONS else f.numel_in(column)
        numbered = [column if count == 1 else f"{column}_{i}" for i in range(count)]
        wanted = inputs[column]
        rows = [wanted] if isinstance(wanted, str) else wanted
        rows = (names.get(column) or numbered) if rows is None else rows
        if len(rows) != count:
            problems.add(
                f"{len(rows)} of the {what} are declared and '{column}' has {_rows(count)}; declare"
                " one for every row, in the same order."
            )
            rows = []
        every = [_variable(kind, what, entry, values, problems) for entry in rows]
        table[column] = [v for v in every if v is not None]
        declared, symbols = [v.name for v in table[column]], names.get(column) or []
        if declared != symbols and sorted(declared) == sorted(symbols):
            problems.add(
                f"The {what} are {', '.join(declared)} and the symbols of '{column}'"
                f" {', '.join(symbols)}; declare them in the order of the symbols."
            )
    known = {p.name: p.value for p in table["p"]}
    for unknown in (k for k in values if k not in known and len(known) == f.numel_in("p")):
        problems.add(f"`values` has '{unknown}', which is no parameter; there are {[*known]}.")
    for variable in [v for rows in table.values() for v in rows]:
        check_variable(variable, {**known, **values}, problems)
    if f.numel_out("y") == 0:
        table["y"] = [
            Output(f"{s.name}_out", s.unit, s.description, s.nominal, s.display_unit)
            for s in table["x"]
        ]
    every_name = [v.name for rows in table.values() for v in rows]
    for twice in sorted({n for n in every_name if every_name.count(n) > 1}):
        problems.add(f"Two variables are named '{twice}'; rename one.")  # as in FMI and Modelica
    problems.raise_if_any()
    return table


def _variable(
    kind: type, what: str, entry: Any, values: Mapping[str, float], problems: Problems
) -> Any:
    """Return the declaration of a row that is declared, or of which only the name is known."""
    if isinstance(entry, kind):
        return entry
    if not isinstance(entry, str):
        problems.add(f"{entry!r} is among the {what}; give a {kind.__name__} or a name there.")
        return None
    about = f"{what[:-1]} {entry.replace('_', ' ')}"
    if kind is not Parameter:
        return kind(entry, "1", about, nominal=1.0)
    if entry not in values:
        problems.add(
            f"The parameter '{entry}' has no number; give it in `values`, or declare a Parameter."
        )
    return Parameter(entry, float(values.get(entry, 0.0)), "1", (-math.inf, math.inf), about)


def is_identifier(name: str) -> bool:
    """Whether a name is one in C and Modelica: letters, digits, underscores, no digit first."""
    return re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name) is not None


def check_variable(variable: Any, values: Mapping[str, float], problems: Problems) -> None:
    """Note a name that is no identifier or `time`, an unknown unit, a number that is not finite.

    A usual size may be a function of parameters; those must be parameters of this model.
    """
    name = variable.name
    if not is_identifier(name):
        problems.add(
            f"'{name}' cannot name a variable; use letters, digits, underscores, no digit first."
        )
    if name == "time":
        problems.add("'time' is the name of time; choose another name.")
    for unit in filter(None, (variable.unit, variable.display_unit)):
        try:
            parse_unit(unit)
        except InputError as error:
            problems.extend(f"The unit of '{name}': {problem}" for problem in error.problems)
    numbers = [getattr(variable, k, 0.0) for k in ("start", "value", "nominal")]
    if any(isinstance(n, float | int) and not math.isfinite(n) for n in numbers):
        problems.add(f"'{name}' has a start, value or nominal that is not finite; give numbers.")
    try:
        nominal_value(getattr(variable, "nominal", 1.0), values)
    except KeyError as error:
        problems.add(
            f"The usual size (nominal) of '{name}' is a function of the parameter {error}, which"
            " the model does not have; give the size as a number."
        )


def _equations(
    f: ca.Function, table: Mapping[str, Sequence[Any]]
) -> Callable[[Symbols], Equations]:
    """Return what a component wants: its equations as a function of a model's symbols."""

    def equations(s: Symbols) -> Equations:
        columns = [ca.vertcat(ca.SX(0, 1), *[getattr(s, v.name) for v in table[k]]) for k in "xupw"]
        xdot, y, zero, wdef = (ca.SX(e) for e in f(s.time, *columns))
        y = y if y.numel() else columns[0]
        kinks = {f"kink_{i}": zero[i] for i in range(zero.numel())}
        return Equations(
            der={state.name: xdot[i] for i, state in enumerate(table["x"])},
            add={w.name: wdef[i] for i, w in enumerate(table["w"])},
            out={output.name: y[i] for i, output in enumerate(table["y"])},
            switches={"kink": zero[0]} if len(kinks) == 1 else kinks,
        )

    return equations
