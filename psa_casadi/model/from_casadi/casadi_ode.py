"""What a user gives as an ODE in CasADi's words, checked and made one function of scalars."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca

from psa_casadi.component import Expression
from psa_casadi.errors import InputError, Problems

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
