"""Whole systems: models wired output to input, as a list of wires and as one model.

A wire leads from an output, "controller.command", to an input, "amplifier.command". An output may
feed any number of inputs, an input takes one wire. `connect` substitutes the wires' equations and
gives one model, which simulates and exports like any other: its variables are named
`part_variable`, its components are the parts.
"""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import casadi as ca

from psa_casadi.component import Component, Equations, Expression, Symbols
from psa_casadi.errors import InputError, Problems
from psa_casadi.model.compose import Model, compose
from psa_casadi.units import parse_unit
from psa_casadi.variables import Input, Nominal, Output, State, Values, nominal_value

#: A port: the name of a part and of one of its inputs or outputs.
Port = tuple[str, str]


@dataclass(frozen=True)
class Plan:
    """Which output feeds each wired input; names outside by port; the parameter of the period."""

    sources: Mapping[Port, Port]
    inputs: Mapping[Port, str]
    outputs: Mapping[Port, str]
    period: str | None


def port_text(port: Port) -> str:
    """Return a port as it is written in a wire."""
    return ".".join(port)


def plan_of(
    parts: Mapping[str, Model],
    wires: Sequence[tuple[str, str]],
    inputs: Mapping[str, str] | None,
    outputs: Mapping[str, str] | None,
) -> Plan:
    """Check wires and names outside and return what they say.

    Raises InputError with all mistakes: names that are no identifiers, ports that do not exist, an
    input with two sources, units that differ, periods that differ.
    """
    problems = Problems()
    _check_names([*parts, *(inputs or ()), *(outputs or ())], problems)
    sources = _sources(parts, wires, problems)
    plan = Plan(
        sources,
        _inputs(parts, inputs, sources, problems),
        _outputs(parts, outputs, problems),
        _period(parts, problems),
    )
    problems.raise_if_any()
    return plan


def _check_names(names: Sequence[str], problems: Problems) -> None:
    for name in names:
        if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name):
            problems.add(
                f"'{name}' cannot name a part or a port; use letters, digits, underscores, no digit"
                " first."
            )


def _sources(
    parts: Mapping[str, Model], wires: Sequence[tuple[str, str]], problems: Problems
) -> dict[Port, Port]:
    found: dict[Port, Port] = {}
    for start, end in wires:
        source = _port(parts, start, "output", problems)
        target = _port(parts, end, "input", problems)
        if source is None or target is None:
            continue
        if target in found:
            problems.add(
                f"The input '{end}' has two sources, '{port_text(found[target])}' and '{start}';"
                " leave one out."
            )
        given, wanted = _unit(parts, source, "output"), _unit(parts, target, "input")
        if not _same(given, wanted):
            problems.add(
                f"The wire from '{start}' [{given}] to '{end}' [{wanted}] joins different units;"
                " wire ports of one unit, or put a part between them."
            )
        found[target] = source
    return found


def _port(parts: Mapping[str, Model], text: str, kind: str, problems: Problems) -> Port | None:
    """Return a port by its text, or None after noting what is wrong with it."""
    name, dot, variable = text.partition(".")
    if name not in parts or not dot:
        problems.add(
            f"'{text}' names no part; write part.{kind}, the parts are {', '.join(parts)}."
        )
        return None
    model = parts[name]
    known = model.output_names if kind == "output" else model.input_names
    if variable not in known:
        listed = ", ".join(known) or "none"
        problems.add(f"'{text}' is no {kind}; the {kind}s of '{name}' are: {listed}.")
        return None
    return name, variable


def _same(one: str, other: str) -> bool:
    first, second = parse_unit(one), parse_unit(other)
    return (first.dimension, first.ratio, first.offset) == (
        second.dimension,
        second.ratio,
        second.offset,
    )


def _unit(parts: Mapping[str, Model], port: Port, kind: str) -> str:
    s = parts[port[0]].structure
    every: tuple[Input | Output, ...] = s.inputs if kind == "input" else s.outputs
    return next(v.unit for v in every if v.name == port[1])


def _inputs(
    parts: Mapping[str, Model],
    inputs: Mapping[str, str] | None,
    sources: Mapping[Port, Port],
    problems: Problems,
) -> dict[Port, str]:
    """Return the names outside of the inputs that have one."""
    if inputs is None:
        every = [(part, n) for part, model in parts.items() for n in model.input_names]
        return {port: "_".join(port) for port in every if port not in sources}
    found: dict[Port, str] = {}
    for name, text in inputs.items():
        port = _port(parts, text, "input", problems)
        if port is None:
            continue
        other = port_text(sources[port]) if port in sources else found.get(port)
        if other is not None:
            problems.add(f"The input '{text}' has two sources, '{other}' and '{name}';"
                         " leave one out.")  # fmt: skip
        found[port] = name
    return found


def _outputs(
    parts: Mapping[str, Model], outputs: Mapping[str, str] | None, problems: Problems
) -> dict[Port, str]:
    """Return the names outside of the outputs that have one; one name each."""
    if outputs is None:
        every = [(part, n) for part, model in parts.items() for n in model.output_names]
        return {port: "_".join(port) for port in every}
    found: dict[Port, str] = {}
    for name, text in outputs.items():
        port = _port(parts, text, "output", problems)
        if port is None:
            continue
        if port in found:
            problems.add(f"The output '{text}' is named twice outside, '{found[port]}' and"
                         f" '{name}'; leave one out.")  # fmt: skip
        found[port] = name
    return found


def _period(parts: Mapping[str, Model], problems: Problems) -> str | None:
    """Return the parameter that is the period of all sampled parts: that of the first of them."""
    periods = {
        f"{name}_{model.structure.period}": model.values[model.structure.period]
        for name, model in parts.items()
        if model.structure.period is not None
    }
    if len(set(periods.values())) > 1:
        listed = ", ".join(f"{name} = {value:g} s" for name, value in periods.items())
        problems.add(f"The sampled parts have different periods: {listed}; give them one.")
    return next(iter(periods), None)


@dataclass(frozen=True)
class _Part:
    """A part's equations in symbols of its own, by their names; its inputs are still symbols."""

    symbols: Mapping[str, Expression]
    xdot: Expression
    y: Expression
    znext: Expression
    switches: Expression


def wired_components(parts: Mapping[str, Model], plan: Plan) -> tuple[Component, ...]:
    """Return one component for each part, its inputs replaced by what feeds them.

    Raises InputError for a loop of outputs that follow their inputs at once.
    """
    wiring = _Wiring(parts, plan)
    return tuple(wiring.component(part) for part in parts)


class _Wiring:
    """The parts in symbols of their own, and the outputs that are resolved so far."""

    def __init__(self, parts: Mapping[str, Model], plan: Plan) -> None:
        self.models = parts
        self.plan = plan
        self.time = ca.SX.sym("time")
        self.period = ca.SX.sym("period")
        self.parts = {name: self._renamed(name, model) for name, model in parts.items()}
        self.known: dict[Port, Expression] = {}

    def _renamed(self, name: str, model: Model) -> _Part:
        s = model.structure
        names = (*model.parameter_names, *model.state_names, *model.sampled_names)
        symbols = {n: ca.SX.sym(f"{name}_{n}") for n in (*names, *model.input_names)}
        if s.period is not None:
            symbols[s.period] = self.period
        results = [s.xdot, s.y, s.znext, ca.vertcat(ca.SX(0, 1), *s.switches.values())]
        old = [s.time, *(s.symbols[n] for n in symbols)]
        return _Part(symbols, *ca.substitute(results, old, [self.time, *symbols.values()]))

    def component(self, name: str) -> Component:
        """Return a part as a component whose variables are named `part_variable`."""
        model, plan = self.models[name], self.plan
        s, part = model.structure, self.parts[name]
        every = ca.vertcat(part.xdot, part.znext, part.switches)
        whole: Expression = self._wired(name, [every], ())[0]
        nx, nz = len(s.states), len(s.sampled)
        outputs = {o.name: self.output((name, o.name), ()) for o in s.outputs}
        values = _Named(
            der={f"{name}_{v.name}": whole[i] for i, v in enumerate(s.states)},
            next={f"{name}_{v.name}": whole[nx + i] for i, v in enumerate(s.sampled)},
            switches={f"{name}_{n}": whole[nx + nz + i] for i, n in enumerate(s.switches)},
            out={plan.outputs[name, n]: e for n, e in outputs.items() if (name, n) in plan.outputs},
        )
        return _declared(name, model, plan, self._equations(values))

    def output(self, port: Port, path: tuple[Port, ...]) -> Expression:
        """Return an output in states, parameters and the inputs from outside."""
        if port in path:
            loop = " -> ".join(port_text(p) for p in (*path[path.index(port) :], port))
            raise InputError(
                f"The outputs form a loop, each following its inputs at once: {loop}; put a part"
                " with a state or a sampled part between two of them."
            )
        if port not in self.known:
            name, variable = port
            index = self.models[name].output_names.index(variable)
            own = self.parts[name].y[index]
            self.known[port] = self._wired(name, [own], (*path, port))[0]
        return self.known[port]

    def _wired(
        self, name: str, expressions: list[Expression], path: tuple[Port, ...]
    ) -> list[Expression]:
        """Replace the inputs that expressions of a part depend on by what feeds them."""
        every = ca.vertcat(*expressions)
        symbols, feeding = [], []
        for it in self.models[name].structure.inputs:
            symbol, port = self.parts[name].symbols[it.name], (name, it.name)
            if port in self.plan.inputs or not ca.depends_on(every, symbol):
                continue
            symbols.append(symbol)
            source = self.plan.sources.get(port)
            feeding.append(ca.SX(it.start) if source is None else self.output(source, path))
        replaced: list[Expression] = ca.substitute(expressions, symbols, feeding)
        return replaced

    def _equations(self, values: "_Named") -> Callable[[Symbols], Equations]:
        """Return the function that gives a part's equations in the symbols of the system."""
        places = [(self.time, "time")]
        if self.plan.period is not None:
            places.append((self.period, self.plan.period))
        for name, part in self.parts.items():
            for variable, symbol in part.symbols.items():
                port = (name, variable)
                if variable == self.models[name].structure.period:
                    continue
                if variable not in self.models[name].input_names:
                    places.append((symbol, f"{name}_{variable}"))
                elif port in self.plan.inputs:
                    places.append((symbol, self.plan.inputs[port]))
        symbols = [symbol for symbol, _ in places]

        def equations(s: Symbols) -> Equations:
            after = [getattr(s, name) for _, name in places]

            def of(expressions: Mapping[str, Expression]) -> dict[str, Expression]:
                found = ca.substitute(list(expressions.values()), symbols, after)
                return dict(zip(expressions, found, strict=True))

            return Equations(
                der=of(values.der),
                next=of(values.next),
                switches=of(values.switches),
                out=of(values.out),
            )

        return equations


@dataclass(frozen=True)
class _Named:
    """A part's equations by the names they have in the system, still in symbols of the parts."""

    der: Mapping[str, Expression]
    next: Mapping[str, Expression]
    switches: Mapping[str, Expression]
    out: Mapping[str, Expression]


def _declared(
    name: str, model: Model, plan: Plan, equations: Callable[[Symbols], Equations]
) -> Component:
    """Return the component of a part: its variables renamed, its sources and equations kept."""
    s = model.structure
    size = _sizes(name, model, plan.period)
    sources = "; ".join(dict.fromkeys(c.source.rstrip(".") for c in model.components))
    texts = ";  ".join(c.equation_text for c in model.components if c.equation_text)

    def own(variable: State) -> State:
        text = f"{name}: {variable.description}"
        name_there = f"{name}_{variable.name}"
        return replace(variable, name=name_there, description=text, nominal=size(variable.nominal))

    return Component(
        name=name,
        description=model.description or "; ".join(c.description for c in model.components),
        source=sources,
        equation_text=texts,
        equations=equations,
        parameters=tuple(
            replace(
                p,
                name=f"{name}_{p.name}",
                description=f"{name}: {p.description}",
                scale=None if p.scale is None else size(p.scale),
            )
            for p in s.parameters
            if p.name != s.period or plan.period == f"{name}_{p.name}"
        ),
        states=tuple(own(v) for v in s.states),
        sampled=tuple(own(v) for v in s.sampled),
        sample_period=plan.period if s.sampled else None,
        inputs=tuple(
            replace(v, name=plan.inputs[name, v.name], nominal=size(v.nominal))
            for v in s.inputs
            if (name, v.name) in plan.inputs
        ),
        outputs=tuple(
            replace(v, name=plan.outputs[name, v.name], nominal=size(v.nominal))
            for v in s.outputs
            if (name, v.name) in plan.outputs
        ),
    )


def _sizes(name: str, model: Model, period: str | None) -> Callable[[Nominal], Nominal]:
    """Return what turns a size, given by a part's own values, into one by the system's."""
    places = {n: f"{name}_{n}" for n in model.parameter_names}
    if model.structure.period is not None and period is not None:
        places[model.structure.period] = period

    return lambda own: _BySystem(own, places) if callable(own) else own


@dataclass(frozen=True)
class _BySystem:
    """A size of a part by the system's values; `places` are its parameters' names there."""

    own: Nominal
    places: Mapping[str, str]

    def __call__(self, values: Values) -> float:
        return nominal_value(self.own, {n: values[place] for n, place in self.places.items()})


@dataclass(frozen=True)
class System:
    """Parts by name, the wires between them, and what the surroundings see of them.

    `inputs` and `outputs` map the name outside to "part.port". An input that has neither a wire
    nor a name outside rests at its start value.
    """

    name: str
    parts: Mapping[str, Model]
    wires: tuple[tuple[str, str], ...]
    inputs: Mapping[str, str]
    outputs: Mapping[str, str]
    description: str = ""

    def model(self) -> Model:
        """Return the system as one model."""
        return connect(
            self.parts,
            self.wires,
            name=self.name,
            inputs=self.inputs,
            outputs=self.outputs,
            description=self.description,
        )


def connect(
    parts: Mapping[str, Model],
    wires: Sequence[tuple[str, str]],
    *,
    name: str,
    inputs: Mapping[str, str] | None = None,
    outputs: Mapping[str, str] | None = None,
    description: str = "",
) -> Model:
    """Return one model of wired parts; each part becomes a component.

    `inputs` and `outputs` map names outside to "part.port". Without `inputs` every input that has
    no wire is one, named `part_port`; without `outputs` every output is. A sampled part sees, at an
    instant, what the other sampled parts held before it; all have one period, the parameter of the
    first of them.

    Raises InputError, with all mistakes at once, for a port that does not exist, an input with two
    sources, a wire between units that differ, periods that differ, and a loop of outputs that
    follow their inputs at once, which it names.
    """
    plan = plan_of(parts, wires, inputs, outputs)
    components = wired_components(parts, plan)
    return compose(components, _values(parts, components), name=name, description=description)


def _values(parts: Mapping[str, Model], components: Iterable[Component]) -> dict[str, float]:
    given = {f"{part}_{n}": v for part, model in parts.items() for n, v in model.values.items()}
    declared = {p.name for c in components for p in c.parameters}
    return {n: v for n, v in given.items() if n in declared}
