"""The equations of wired parts: wires substituted, one component for each part."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import casadi as ca

from psa_casadi.component import Component, Equations, Expression, Symbols
from psa_casadi.errors import InputError
from psa_casadi.model.compose import Model
from psa_casadi.model.system.ports import Plan, Port, port_text
from psa_casadi.variables import Nominal, State, Values, nominal_value


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
