"""One Modelica class from a model: declarations by component, one equation per balance.

Named parts stand in the place of long repeated expressions. Sampled states are discrete variables,
and one when-clause gives their values.

Source: Modelica Language Specification 3.6, sections 3.7.5 (`sample`, `pre`) and 8.3.5 (when).
"""

import math
import textwrap
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import casadi as ca

from psa_casadi.export.common.icon import drawing_of
from psa_casadi.export.common.templates import filled
from psa_casadi.export.modelica.expression import (
    Graph,
    Identifiers,
    Printer,
    comment,
    modifier,
    number,
    string,
    unit_text,
)
from psa_casadi.model.component import Expression, Symbols
from psa_casadi.model.compose import Model
from psa_casadi.model.shapes import (
    direction,
    magnitude_power,
    rate_magnitude,
    signed_power,
    static_stiffness,
    stroke,
)
from psa_casadi.model.structure import Structure
from psa_casadi.model.variables import Input, Output, Parameter, State, nominal_value

_WIDTH = 100
#: The signals that a connector replaces, and those of them that it determines.
CONNECTORS = {
    "pins": (("voltage", "current"), ("voltage",)),
    "output": (("displacement", "load_force"), ("load_force",)),
    "tip": (
        ("tip_position", "tip_velocity", "reaction_force"),
        ("tip_position", "tip_velocity"),
    ),
}
#: Names of the connectors.
IDENTIFIERS = ("pin_p", "pin_n", "flange_a", "flange_b")

#: Parts that have a name wherever a model has their symbols: unit, meaning, and how they are made.
#: static_stiffness asks for the stroke first, which only a stack has: the k of another model may be
#: anything.
PARTS: dict[str, tuple[str, str, Callable[[Symbols], Expression]]] = {
    "voltage_direction": ("1", "smooth sign of the voltage rate", direction),
    "voltage_speed": ("V/s", "magnitude of the voltage rate", rate_magnitude),
    "hysteresis_ratio": (
        "1", "hysteresis force over its reference", lambda s: s.f_H / s.h_ref),
    "hysteresis_bend": (
        "1", "magnitude of the ratio to the power n",
        lambda s: magnitude_power(s.f_H / s.h_ref, s.n)),
    "hysteresis_signed_bend": (
        "1", "the same with the sign of the ratio", lambda s: signed_power(s.f_H / s.h_ref, s.n)),
    "static_stiffness": (
        "N/m", "static stiffness of the stack", lambda s: (stroke(s), static_stiffness(s))[1]),
    "stroke": ("m", "linear free stroke at rated voltage", stroke),
    "elastic_force": (
        "N", "force of the wafers' spring and damper", lambda s: s.c_P * s.v_y + s.k_P * s.y),
    "bonding_force": (
        "N", "force of the bonding layers' spring and damper",
        lambda s: s.c_B * (s.v_x - s.v_y) + s.k_B * (s.x - s.y)),
    "contact_force": (
        "N", "force of the contact on the stage",
        lambda s: s.k_c * (s.tip_position - s.x_f) + s.c_c * (s.tip_velocity - s.v_f)),
}  # fmt: skip
#: A repeated expression of this many operations and symbols, or more, gets a variable.
_LEAST_NAMED_SIZE = 8
#: These stay in place: a tool takes a variable that is one of them for discrete.
_NEVER_NAMED = frozenset({"sign", "lt", "le", "eq", "ne", "not", "and", "or", "if"})


@dataclass(frozen=True)
class _Variable:
    """A variable and its equation; `unit` is None where it is not known.

    `terms` are the terms of a sum, each a text with its sign and the component that adds it.
    """

    name: str
    unit: str | None
    description: str
    text: str
    terms: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class _Equations:
    """Equations of a model; `names` are the Modelica names of its symbols.

    `sides` are right-hand sides by the name of their variable: of "derivatives", of "outputs" that
    are no balances, and of sampled states "after" an instant. `sampled_parts` change with these.
    """

    names: Mapping[str, str]
    balances: tuple[_Variable, ...]
    parts: tuple[_Variable, ...]
    sampled_parts: tuple[_Variable, ...]
    sides: Mapping[str, Mapping[str, str]]


def class_text(
    model: Model, name: str, description: str, annotation: str, connectors: Collection[str] = ()
) -> str:
    """Return the text of a model class; its icon is a stack's or a plain one.

    With `connectors` these stand in the place of inputs and outputs, and the gain of the reaction
    is fixed. Raises InputError for values that are not finite and for what Modelica cannot write.
    """
    s = model.structure
    equations = _equations(model, Identifiers(IDENTIFIERS if connectors else ()))
    names = equations.names
    inputs = {n for c in connectors for n in CONNECTORS[c][1]}

    def declared(its: Iterable[Input | Output], prefix: str) -> list[str]:
        return [_declaration(model, it, names[it.name], prefix) for it in its]

    public = {names[o.name] for o in s.outputs}
    hidden = [v for v in (*equations.balances, *equations.parts) if v.name not in public]
    fixed = ("reciprocal_gain",) if connectors else ()
    return filled(
        "class.mo",
        name=name,
        description=description,
        annotation=annotation,
        connectors=connectors,
        gained="G" in model.parameter_names,
        drawing=drawing_of(model),
        declarations=[
            *declared((i for i in s.inputs if i.name not in inputs), "input Real"),
            *declared(s.outputs, "Real" if connectors else "output Real"),
            *_declarations_of_components(model, names, fixed),
        ],
        hidden=[
            *declared((i for i in s.inputs if i.name in inputs), "Real"),
            *(_variable(v, "Real") for v in hidden),
            *(_variable(v, "discrete Real") for v in equations.sampled_parts),
        ],
        equations=_equation_lines(model, equations),
    )


def _declarations_of_components(
    model: Model, names: Mapping[str, str], fixed: Collection[str]
) -> list[str]:
    """Return parameters, states and sampled states under a comment that names their component."""
    lines: list[str] = []
    states = {s.name: s for s in model.structure.states}
    for component in model.components:
        declared: list[tuple[Parameter | State, str]] = [
            (p, "final parameter Real" if p.name in fixed else "parameter Real")
            for p in component.parameters
        ]
        declared += [(states[s.name], "Real") for s in component.states]
        declared += [(s, "discrete Real") for s in component.sampled]
        lines += _section(
            f"{component.name}: {component.description}",
            [_declaration(model, it, names[it.name], prefix) for it, prefix in declared],
        )
    return lines


def _declaration(
    model: Model, it: Input | Output | Parameter | State, name: str, prefix: str
) -> str:
    display = string(unit_text(it.display_unit)) if it.display_unit else None
    stated, value = {"unit": string(unit_text(it.unit)), "displayUnit": display}, ""
    if isinstance(it, Parameter):
        for end, bound in zip(("min", "max"), it.bounds, strict=True):
            if not math.isinf(bound):
                stated[end] = number(bound, f"A bound of '{it.name}'")
        value = " = " + number(model.values[it.name], f"Parameter '{it.name}'")
    else:
        if not isinstance(it, Output):
            kind = "input" if isinstance(it, Input) else "state"
            stated["start"] = number(it.start, f"The start of {kind} '{it.name}'")
        if isinstance(it, State):
            stated["fixed"] = "true"
        stated["nominal"] = size_text(nominal_value(it.nominal, model.values), it.name)
    return f"  {prefix} {name}{modifier(stated)}{value} {string(it.description)};"


def size_text(size: float, name: str) -> str:
    """Return the usual size of a variable with three digits."""
    number(size, f"The usual size of '{name}'")
    return repr(float(f"{abs(size):.3g}"))


def _variable(it: _Variable, prefix: str) -> str:
    stated = {"unit": string(it.unit) if it.unit else None}
    if prefix == "discrete Real":
        stated |= {"start": "0.0", "fixed": "true"}
    return f"  {prefix} {it.name}{modifier(stated)} {string(it.description)};"


def _section(title: str, body: Iterable[str]) -> list[str]:
    """Return lines under a comment; nothing where there are none."""
    lines = list(body)
    return ["  " + comment(title), *lines] if lines else []


def _equation_lines(model: Model, equations: _Equations) -> list[str]:
    names, sides = equations.names, equations.sides

    def written(pairs: Iterable[tuple[str, str]]) -> list[str]:
        return [line for name, text in pairs for line in _wrapped(f"{name} = {text}")]

    balances = [line for v in equations.balances for line in _balance(v)]
    lines = _section(
        "what several equations use", written((v.name, v.text) for v in equations.parts)
    )
    lines += _section("balances: sums of what the components add", balances)
    inside = written((v.name, v.text) for v in equations.sampled_parts)
    for c in model.components:
        title = f"{c.name}: {c.source.rstrip('.')}"
        rates = ((f"der({names[s.name]})", sides["derivatives"][s.name]) for s in c.states)
        lines += _section(title, written(rates))
        inside += _section(
            title, written((names[s.name], sides["after"][s.name]) for s in c.sampled)
        )
    if model.structure.period is not None:
        lines.append(f"  when sample(0, {names[model.structure.period]}) then")
        lines += [*(f"  {line}" for line in inside), "  end when;"]
    return lines + _section("outputs", written((names[n], t) for n, t in sides["outputs"].items()))


def _balance(it: _Variable) -> list[str]:
    """Return a balance in one line, or with a line and a component's name for each term."""
    owners = ", ".join(dict.fromkeys(owner for _, owner in it.terms if owner))
    line = f"  {it.name} = {it.text}; // {owners}" if owners else f"  {it.name} = {it.text};"
    if len(line) <= _WIDTH:
        return [line]
    if len(it.terms) < 2:
        return _wrapped(f"{it.name} = {it.text}")
    lines = [f"  {it.name} ="]
    for i, (text, owner) in enumerate(it.terms):
        end = ";" if i == len(it.terms) - 1 else ""
        *parts, last = _wrapped(text, "    ", end)
        lines += [*parts, f"{last} // {owner}" if owner else last]
    return lines


def _wrapped(text: str, indent: str = "  ", end: str = ";") -> list[str]:
    """Break an equation at spaces; Modelica takes a line's end for one."""
    return textwrap.wrap(
        text + end,
        width=_WIDTH,
        initial_indent=indent,
        subsequent_indent=indent + "  ",
        break_long_words=False,
        break_on_hyphens=False,
    )


def _equations(model: Model, identifiers: Identifiers) -> _Equations:
    """Return the equations of a model; raises InputError for what Modelica cannot write."""
    s, graph = model.structure, Graph()
    names = variable_names(s, identifiers)
    used, later = _used(s), _following(s)
    groups = {
        "balances": {n: s.balances.get(n, ca.SX(0)) for n in s.balance_table if n in used},
        "derivatives": {q.name: s.der[q.name] for q in s.states},
        "outputs": dict(_outputs(s)),
        "after": later,
    }
    roots = graph.read([side for group in groups.values() for side in group.values()])
    places = iter(roots)
    numbers = {kind: {n: next(places) for n in group} for kind, group in groups.items()}
    named = {k: names[n] for n, k in numbers["balances"].items() if graph.nodes[k].arguments}
    parts = _name_parts(graph, roots, named, identifiers, s, later)
    names |= {f"der({q.name})": f"der({names[q.name]})" for q in s.states}
    names |= {_before(q.name): _before(names[q.name]) for q in s.sampled}
    printer = Printer(graph, names, named)
    by_kind: dict[bool, list[_Variable]] = {False: [], True: []}
    for k, (unit, description) in sorted(parts.items()):
        sampled = any(graph.nodes[i].name.startswith("pre(") for i in graph.below([k]))
        by_kind[sampled].append(_Variable(named[k], unit, description, printer.definition(k)))
    return _Equations(
        names=names,
        balances=tuple(
            _Variable(
                names[n], s.balance_table[n].unit, s.balance_table[n].description,
                printer.definition(k), _terms(graph, printer, s, n, k),
            )
            for n, k in numbers.pop("balances").items()
        ),
        parts=tuple(by_kind[False]),
        sampled_parts=tuple(by_kind[True]),
        sides={
            kind: {n: printer.definition(k) for n, k in group.items()}
            for kind, group in numbers.items()
        },
    )  # fmt: skip


def variable_names(structure: Structure, identifiers: Identifiers) -> dict[str, str]:
    """Return the Modelica names of symbols, balances and outputs; `time` is Modelica's."""
    s, used = structure, _used(structure)
    symbols: list[Input | Parameter | State] = [*s.inputs, *s.parameters, *s.states, *s.sampled]
    wanted = [q.name for q in symbols]
    wanted += [name for name in s.balance_table if name in used]
    wanted += [o.name for o in s.outputs if o.name not in wanted]
    return {"time": "time"} | {name: identifiers.new(name) for name in wanted}


def _used(structure: Structure) -> set[str]:
    """Return the balances that have terms and those that are read."""
    sides = (structure.balances, structure.der, structure.next, structure.out)
    every = ca.vertcat(*(e for side in sides for e in side.values()))
    read = {s.name() for s in ca.symvar(every)}
    return {n for n in structure.balance_table if n in structure.balances or n in read}


def _outputs(structure: Structure) -> Iterator[tuple[str, Expression]]:
    """Yield the outputs that are not balances; the velocity is the displacement's derivative."""
    s = structure
    for output in s.outputs:
        expression = s.out[output.name]
        if output.name == "velocity" and "displacement" in s.balances:
            position = _written_out(s.balances["displacement"], s, list(s.balances))
            rates = ca.vertcat(*[ca.SX.sym(f"der({q.name})") for q in s.states])
            expression = ca.jtimes(position, s.x, rates) + ca.jacobian(position, s.time)
        if not (output.name in s.symbols and is_symbol(expression, output.name)):
            yield output.name, expression


def is_symbol(expression: Expression, name: str) -> bool:
    """Whether an expression is nothing but the symbol of that name."""
    scalar = ca.SX(expression)
    return bool(scalar.is_symbolic()) and scalar.name() == name


def _written_out(expression: Expression, structure: Structure, names: Sequence[str]) -> ca.SX:
    """Return an expression with these balances in the place of their symbols."""
    sx = ca.SX(expression)
    symbols = [structure.symbols[n] for n in names]
    while any(ca.depends_on(sx, s) for s in symbols):
        sx = ca.substitute([sx], symbols, [structure.balances[n] for n in names])[0]
    return sx


def _before(name: str) -> str:
    """Return the name of the symbol of a sampled state before an instant."""
    return f"pre({name})"


def _following(structure: Structure) -> dict[str, Expression]:
    """Return each sampled state's value after an instant, those before it as symbols `pre(z)`.

    A balance that depends on a sampled state, through others too, is written out, because its
    variable has the values after the instant.
    """
    s = structure
    moving: list[str] = []
    more = [""]
    while more:
        reached = ca.vertcat(s.z, *(s.symbols[name] for name in moving))
        more = [n for n, b in s.balances.items() if n not in moving and ca.depends_on(b, reached)]
        moving += more
    earlier = ca.vertcat(ca.SX(0, 1), *(ca.SX.sym(_before(q.name)) for q in s.sampled))
    return {
        q.name: ca.substitute([_written_out(s.next[q.name], s, moving)], [s.z], [earlier])[0]
        for q in s.sampled
    }


def _name_parts(
    graph: Graph, roots: Sequence[int], named: dict[int, str], identifiers: Identifiers,
    structure: Structure, later: Mapping[str, Expression],
) -> dict[int, tuple[str | None, str]]:  # fmt: skip
    """Name nodes: the known parts that the equations hold, and what is long and used twice or more.

    Repeated ones are named from the smallest up. Return unit and meaning of each.
    """
    chosen: dict[int, tuple[str | None, str]] = {}
    below = graph.below(roots)
    for name, (unit, meaning, made) in PARTS.items():
        try:
            (k,) = graph.read([made(Symbols(structure.symbols))])
        except AttributeError:  # the model has not all of its symbols
            continue
        if k in below and k not in named:
            named[k], chosen[k] = identifiers.new(name), (unit, meaning)
    owners = _owners(graph, structure, later)
    present = sorted(below)
    uses = dict.fromkeys(present, 0)
    for argument in (a for k in present for a in graph.nodes[k].arguments):
        uses[argument] += 1
    sizes: dict[int, int] = {}
    for k in present:
        node = graph.nodes[k]
        sizes[k] = 1 + sum(sizes[a] for a in node.arguments)
        is_repeated = sizes[k] >= _LEAST_NAMED_SIZE and uses[k] > 1
        if is_repeated and k not in named and node.operation not in _NEVER_NAMED:
            owner = owners.get(k, "shared")
            named[k] = identifiers.new(f"{owner}_part")
            chosen[k] = None, f"repeated part of {owner}"
        if k in named:
            sizes[k] = 1
    return chosen


def _owners(graph: Graph, structure: Structure, later: Mapping[str, Expression]) -> dict[int, str]:
    """Return the first component whose equations hold a node, for every node."""
    owners: dict[int, str] = {}
    for component in structure.components:
        sides = component.equations(Symbols(structure.symbols))
        terms = [*sides.der.values(), *sides.add.values(), *sides.out.values()]
        terms += [later[s.name] for s in component.sampled]
        for k in graph.below(graph.read(terms)):
            owners.setdefault(k, component.name)
    return owners


def _terms(
    graph: Graph, printer: Printer, structure: Structure, balance: str, number: int
) -> tuple[tuple[str, str], ...]:
    """Return the terms of a balance with their signs and components, the first one first.

    A sum that CasADi has rearranged stays in one piece, without a component's name.
    """
    contributions = [
        (c.name, added[balance])
        for c in structure.components
        if balance in (added := c.equations(Symbols(structure.symbols)).add)
    ]
    terms: list[tuple[str, str]] = []
    for name, term in reversed(contributions[1:]):
        node = graph.nodes[number]
        (root,) = graph.read([term])
        if node.operation == "add" and node.arguments[1] == root:
            sign = "+ "
        elif node.operation == "sub" and graph.add("neg", node.arguments[1]) == root:
            sign = "- "
        else:
            return ((printer.definition(number), ""), *terms)
        terms.insert(0, (sign + printer.summand(node.arguments[1]), name))
        number = node.arguments[0]
    name = contributions[0][0] if contributions else ""
    return ((printer.definition(number), name), *terms)
