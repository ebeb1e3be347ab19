"""Any ordinary differential equation written with CasADi, as a model like every other."""

from collections.abc import Callable, Mapping, Sequence

import casadi as ca

from psa_casadi.component import Component, Equations, Expression, Symbols
from psa_casadi.model.compose import Model, compose
from psa_casadi.model.from_casadi.casadi_ode import CasadiOde, read_ode
from psa_casadi.model.from_casadi.ode_variables import Declared, declare
from psa_casadi.variables import Input, Output, Parameter, State

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
