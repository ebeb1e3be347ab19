"""The equations of a model as Modelica text: its balances, named parts, derivatives, outputs.

Sampled states are discrete variables, and one when-clause gives their values.

Source: Modelica Language Specification 3.6, sections 3.7.5 (`sample`, `pre`) and 8.3.5 (when).
"""

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import casadi as ca

from psa_casadi.component import Component, Equations, Expression, Symbols
from psa_casadi.export.modelica.expression import Graph, Identifiers, Printer, comment
from psa_casadi.model.compose import Model
from psa_casadi.model.structure import Structure
from psa_casadi.scales import static_stiffness, stroke
from psa_casadi.shapes import direction, magnitude_power, rate_magnitude, signed_power


@dataclass(frozen=True)
class Part:
    """A named expression: what it is called, its unit, its meaning, and how it is made."""

    name: str
    unit: str
    description: str
    expression: Callable[[Symbols], Expression]


def _elastic(s: Symbols) -> Expression:
    return s.c_P * s.v_y + s.k_P * s.y


def _pull(s: Symbols) -> Expression:
    return s.c_B * (s.v_x - s.v_y) + s.k_B * (s.x - s.y)


def _ratio(s: Symbols) -> Expression:
    return s.f_H / s.h_ref


def _stiffness(s: Symbols) -> Expression:
    """Only a stack has a stroke; the k of another model may be anything."""
    stroke(s)  # raises AttributeError in a model that is no stack
    return static_stiffness(s)


PARTS: tuple[Part, ...] = (
    Part("voltage_direction", "1", "smooth sign of the voltage rate", direction),
    Part("voltage_speed", "V/s", "magnitude of the voltage rate", rate_magnitude),
    Part("hysteresis_ratio", "1", "hysteresis force over its reference", _ratio),
    Part(
        "hysteresis_bend",
        "1",
        "magnitude of the ratio to the power n",
        lambda s: magnitude_power(_ratio(s), s.n),
    ),
    Part(
        "hysteresis_signed_bend",
        "1",
        "the same with the sign of the ratio",
        lambda s: signed_power(_ratio(s), s.n),
    ),
    Part("static_stiffness", "N/m", "static stiffness of the stack", _stiffness),
    Part("stroke", "m", "linear free stroke at rated voltage", stroke),
    Part("elastic_force", "N", "force of the wafers' spring and damper", _elastic),
    Part("bonding_force", "N", "force of the bonding layers' spring and damper", _pull),
    Part("contact_force", "N", "force of the contact on the stage", lambda s: (
        s.k_c * (s.tip_position - s.x_f) + s.c_c * (s.tip_velocity - s.v_f)
    )),
)  # fmt: skip


def known_parts(symbols: Symbols) -> list[tuple[Part, Expression]]:
    """Return the parts whose symbols the model has, with their expressions."""
    found = []
    for part in PARTS:
        try:
            found.append((part, part.expression(symbols)))
        except AttributeError:
            continue
    return found


def before(name: str) -> str:
    """Return the name of the symbol that stands for a sampled state before an instant."""
    return f"pre({name})"


def is_before(name: str) -> bool:
    """Whether a symbol stands for a sampled state before an instant."""
    return name.startswith("pre(")


def following(structure: Structure) -> dict[str, Expression]:
    """Return each sampled state's value after an instant, those before it as symbols `pre(z)`.

    A balance that depends on a sampled state is written out, because its variable has the values
    after the instant.
    """
    moving = _moving_balances(structure)
    symbols = [structure.symbols[name] for name in moving]
    terms = [structure.balances[name] for name in moving]
    earlier = ca.vertcat(ca.SX(0, 1), *(ca.SX.sym(before(s.name)) for s in structure.sampled))
    found = {}
    for state in structure.sampled:
        expression = ca.SX(structure.next[state.name])
        while any(ca.depends_on(expression, s) for s in symbols):
            expression = ca.substitute([expression], symbols, terms)[0]
        found[state.name] = ca.substitute([expression], [structure.z], [earlier])[0]
    return found


def _moving_balances(structure: Structure) -> list[str]:
    """Return the balances that depend on a sampled state, through others too."""
    moving: list[str] = []
    while True:
        reached = [structure.z, *(structure.symbols[name] for name in moving)]
        more = [
            name
            for name, terms in structure.balances.items()
            if name not in moving and ca.depends_on(terms, ca.vertcat(*reached))
        ]
        if not more:
            return moving
        moving += more


def when_lines(
    model: Model,
    period: str,
    parts: Iterable[Sequence[str]],
    equations: Mapping[str, Sequence[str]],
) -> list[str]:
    """Return the when-clause of the instants of a period.

    `equations` are the lines of each sampled state's equation, `parts` those of what they share.
    """
    lines = [f"  when sample(0, {period}) then"]
    lines += [f"  {line}" for part in parts for line in part]
    for component in model.components:
        if component.sampled:
            lines.append("    " + comment(f"{component.name}: {component.source.rstrip('.')}"))
            lines += [f"  {line}" for s in component.sampled for line in equations[s.name]]
    return [*lines, "  end when;"]


#: A repeated expression of this many operations and symbols, or more, gets a variable.
_WORTH_A_NAME = 8
#: These stay in place: a tool takes a variable that is one of them for discrete.
_NEVER_NAMED = frozenset({"sign", "lt", "le", "eq", "ne", "not", "and", "or", "if"})


@dataclass(frozen=True)
class Variable:
    """A variable and its equation; `unit` is None where it is not known.

    `terms` are the terms of a sum, each a text with its sign and the component that adds it.
    """

    name: str
    unit: str | None
    description: str
    text: str
    terms: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class ModelEquations:
    """Right-hand sides by the name of their variable; `names` are the symbols' Modelica names.

    A balance that is also an output is in `balances` only. `following` are the values of the
    sampled states after an instant; `sampled_parts` belong to them and change with them.
    """

    names: Mapping[str, str]
    balances: tuple[Variable, ...]
    parts: tuple[Variable, ...]
    derivatives: Mapping[str, str]
    outputs: Mapping[str, str]
    sampled_parts: tuple[Variable, ...]
    following: Mapping[str, str]


def model_equations(model: Model, taken: tuple[str, ...] = ()) -> ModelEquations:
    """Return the equations of a model; `taken` are identifiers that are in use beside them.

    Raises InputError for what Modelica cannot write.
    """
    structure = model.structure
    identifiers = Identifiers(taken)
    names = variable_names(structure, identifiers)
    graph = Graph()
    sums = _balances(structure)
    outputs = _outputs(structure)
    roots = [*sums.values(), *(structure.der[s.name] for s in structure.states)]
    numbers = graph.read([*roots, *outputs.values(), *following(structure).values()])
    named = {
        number: names[name]
        for name, number in zip(sums, numbers, strict=False)
        if graph.nodes[number].arguments
    }
    parts = _Parts(graph, numbers, named, identifiers)
    parts.find_known(known_parts(Symbols(structure.symbols)))
    parts.find_repeated(_owners(graph, structure))
    names |= {f"der({s.name})": f"der({names[s.name]})" for s in structure.states}
    names |= {before(s.name): before(names[s.name]) for s in structure.sampled}
    printer = Printer(graph, names, parts.named)
    texts = [printer.definition(n) for n in numbers]
    table = structure.balance_table
    counts = (len(it) for it in (sums, structure.states, outputs))
    first, second, third = itertools.accumulate(counts)
    terms = [_terms(graph, printer, structure, *it) for it in zip(sums, numbers, strict=False)]
    return ModelEquations(
        names=names,
        balances=tuple(
            Variable(names[n], table[n].unit, table[n].description, text, added)
            for n, text, added in zip(sums, texts[:first], terms, strict=True)
        ),
        parts=parts.variables(printer, sampled=False),
        derivatives=dict(zip(model.state_names, texts[first:second], strict=True)),
        outputs=dict(zip(outputs, texts[second:third], strict=True)),
        sampled_parts=parts.variables(printer, sampled=True),
        following=dict(zip(model.sampled_names, texts[third:], strict=True)),
    )


class _Parts:
    """Chooses the nodes that get a variable of their own."""

    def __init__(
        self, graph: Graph, roots: list[int], named: dict[int, str], identifiers: Identifiers
    ) -> None:
        self._graph = graph
        self._roots = roots
        self._identifiers = identifiers
        self.named = named
        self.chosen: dict[int, tuple[str | None, str]] = {}

    def find_known(self, known: list[tuple[Part, Expression]]) -> None:
        """Name the known parts that the equations hold, as they are in the table."""
        present = self._graph.below(self._roots)
        numbers = self._graph.read([expression for _, expression in known]) if known else []
        for (part, _), number in zip(known, numbers, strict=True):
            if number in present and number not in self.named:
                self._name(number, part.name, part.unit, part.description)

    def find_repeated(self, owners: Mapping[int, str]) -> None:
        """Name what is long and used twice or more, from the smallest up."""
        present = sorted(self._graph.below(self._roots))
        uses = dict.fromkeys(present, 0)
        for number in present:
            for argument in self._graph.nodes[number].arguments:
                uses[argument] += 1
        sizes: dict[int, int] = {}
        for number in present:
            node = self._graph.nodes[number]
            size = 1 + sum(sizes[a] for a in node.arguments)
            if (
                size >= _WORTH_A_NAME
                and uses[number] > 1
                and number not in self.named
                and node.operation not in _NEVER_NAMED
            ):
                owner = owners.get(number, "shared")
                self._name(number, f"{owner}_part", None, f"repeated part of {owner}")
            sizes[number] = 1 if number in self.named else size

    def variables(self, printer: Printer, *, sampled: bool) -> tuple[Variable, ...]:
        """Return the named nodes that are no balances, each after those it is made of.

        Either those that hold a state before an instant, or the others.
        """
        return tuple(
            Variable(self.named[n], unit, description, printer.definition(n))
            for n, (unit, description) in sorted(self.chosen.items())
            if any(is_before(self._graph.nodes[i].name) for i in self._graph.below([n])) == sampled
        )

    def _name(self, number: int, name: str, unit: str | None, description: str) -> None:
        self.named[number] = self._identifiers.new(name)
        self.chosen[number] = (unit, description)


def component_equations(component: Component, structure: Structure) -> Equations:
    """Return what one component contributes to a model."""
    return component.equations(Symbols(structure.symbols))


def variable_names(structure: Structure, identifiers: Identifiers) -> dict[str, str]:
    """Return the Modelica names of symbols, balances and outputs; `time` is Modelica's own."""
    wanted = [i.name for i in structure.inputs]
    wanted += [p.name for p in structure.parameters]
    wanted += [s.name for s in (*structure.states, *structure.sampled)]
    wanted += [name for name in structure.balance_table if name in _used(structure)]
    wanted += [o.name for o in structure.outputs if o.name not in wanted]
    return {"time": "time"} | {name: identifiers.new(name) for name in wanted}


def _used(structure: Structure) -> set[str]:
    """Return the balances that have terms and those that are read."""
    sides = (structure.balances, structure.der, structure.next)
    every = ca.vertcat(*(e for side in sides for e in side.values()))
    read = {s.name() for s in ca.symvar(ca.vertcat(every, *structure.out.values()))}
    return {n for n in structure.balance_table if n in structure.balances or n in read}


def _balances(structure: Structure) -> dict[str, Expression]:
    """Return the balances in the order of their table; one that is read but empty is 0."""
    used = _used(structure)
    return {n: structure.balances.get(n, ca.SX(0)) for n in structure.balance_table if n in used}


def _outputs(structure: Structure) -> dict[str, Expression]:
    """Return the outputs that are not balances; the velocity is the displacement's derivative."""
    found = {}
    for output in structure.outputs:
        expression = structure.out[output.name]
        if output.name == "velocity" and "displacement" in structure.balances:
            expression = _velocity(structure)
        if not (output.name in structure.symbols and is_symbol(expression, output.name)):
            found[output.name] = expression
    return found


def is_symbol(expression: Expression, name: str) -> bool:
    """Whether an expression is nothing but the symbol of that name."""
    scalar = ca.SX(expression)
    return bool(scalar.is_symbolic()) and scalar.name() == name


def _velocity(structure: Structure) -> Expression:
    """Return d(displacement)/dt with the derivatives of the states as symbols."""
    shown = structure.balances["displacement"]
    sums = list(structure.balances)
    symbols = [structure.symbols[n] for n in sums]
    while any(ca.depends_on(shown, s) for s in symbols):
        shown = ca.substitute([shown], symbols, [structure.balances[n] for n in sums])[0]
    rates = ca.vertcat(*[ca.SX.sym(f"der({s.name})") for s in structure.states])
    return ca.jtimes(shown, structure.x, rates) + ca.jacobian(shown, structure.time)


def _owners(graph: Graph, structure: Structure) -> dict[int, str]:
    """Return the first component whose equations hold a node, for every node."""
    owners: dict[int, str] = {}
    later = following(structure)
    for component in structure.components:
        equations = component_equations(component, structure)
        terms = [*equations.der.values(), *equations.add.values(), *equations.out.values()]
        terms += [later[s.name] for s in component.sampled]
        for number in graph.below(graph.read(terms)):
            owners.setdefault(number, component.name)
    return owners


def _terms(
    graph: Graph, printer: Printer, structure: Structure, balance: str, number: int
) -> tuple[tuple[str, str], ...]:
    """Return the terms of a balance with their signs and components, the first one first.

    A sum that CasADi has rearranged stays in one piece, without a component's name.
    """
    contributions = [
        (c.name, equations.add[balance])
        for c in structure.components
        if balance in (equations := component_equations(c, structure)).add
    ]
    terms: list[tuple[str, str]] = []
    for name, term in reversed(contributions[1:]):
        node = graph.nodes[number]
        (own,) = graph.read([term])
        if node.operation == "add" and node.arguments[1] == own:
            sign = "+ "
        elif node.operation == "sub" and graph.add("neg", node.arguments[1]) == own:
            sign = "- "
        else:
            return ((printer.definition(number), ""), *terms)
        terms.insert(0, (sign + printer.summand(node.arguments[1]), name))
        number = node.arguments[0]
    name = contributions[0][0] if contributions else ""
    return ((printer.definition(number), name), *terms)
