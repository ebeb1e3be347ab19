"""Whole systems: models wired output to input, as a list of wires and as one model.

A wire leads from an output, "controller.command", to an input, "amplifier.command". An output may
feed any number of inputs, an input takes one wire. `connect` substitutes the wires' equations and
gives one model, which simulates and exports like any other: its variables are named
`part_variable`, its components are the parts.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca

from psa_casadi.common.errors import InputError, Problems
from psa_casadi.common.units import parse_unit
from psa_casadi.model.component import Component, Equations, Expression, Symbols
from psa_casadi.model.compose import Model, compose
from psa_casadi.model.ode_model import is_identifier
from psa_casadi.model.variables import Input, Nominal, Output, Values, nominal_value

#: A port: the name of a part and of one of its inputs or outputs.
Port = tuple[str, str]


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
            self.parts, self.wires, name=self.name, inputs=self.inputs, outputs=self.outputs,
            description=self.description,
        )  # fmt: skip


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
    wiring = _Wiring(parts, wires, inputs, outputs)
    components = [wiring.component(part) for part in parts]
    table = {f"{part}_{n}": v for part, model in parts.items() for n, v in model.values.items()}
    values = {p.name: table[p.name] for c in components for p in c.parameters}
    return compose(components, values, name=name, description=description)


class _Wiring:
    """The parts in symbols by their names in the system, and the outputs resolved so far.

    `sources` maps each wired input to the output that feeds it, `outside` the ports with a name
    outside to it; `period` is the parameter of the period. Inputs that are fed from inside have
    temporary symbols until they are replaced.
    """

    def __init__(
        self,
        parts: Mapping[str, Model],
        wires: Sequence[tuple[str, str]],
        inputs: Mapping[str, str] | None,
        outputs: Mapping[str, str] | None,
    ) -> None:
        self.models, self.problems = parts, Problems()
        for name in (*parts, *(inputs or ()), *(outputs or ())):
            if not is_identifier(name):
                self.problems.add(
                    f"'{name}' cannot name a part or a port; use letters, digits, underscores, no"
                    " digit first."
                )
        self.sources: dict[Port, Port] = {}
        for start, end in wires:
            self._wire(start, end)
        self.inputs = self._named("input", inputs, self.sources)
        self.outputs = self._named("output", outputs, {})
        self.period = self._period()
        self.problems.raise_if_any()
        self.symbols: dict[str, Expression] = {"time": ca.SX.sym("time")}
        self.inside: dict[Port, Expression] = {}
        self.known: dict[Port, Expression] = {}
        self.results = {name: self._renamed(name, model) for name, model in parts.items()}

    def _wire(self, start: str, end: str) -> None:
        """Lead a wire from an output to an input, both as "part.port"; note what is wrong."""
        feeding, taking = self._port(start, "output"), self._port(end, "input")
        if feeding is None or taking is None:
            return
        (source, fed), (target, taken) = feeding, taking
        if target in self.sources:
            self.problems.add(
                f"The input '{end}' has two sources, '{'.'.join(self.sources[target])}' and"
                f" '{start}'; leave one out."
            )
        one, other = parse_unit(fed.unit), parse_unit(taken.unit)
        if (one.dimension, one.ratio, one.offset) != (other.dimension, other.ratio, other.offset):
            self.problems.add(
                f"The wire from '{start}' [{fed.unit}] to '{end}' [{taken.unit}] joins"
                " different units; wire ports of one unit, or put a part between them."
            )
        self.sources[target] = source

    def _period(self) -> str | None:
        """Return the parameter of the first period; note periods that differ."""
        periods = {
            f"{name}_{q}": model.values[q]
            for name, model in self.models.items()
            if (q := model.structure.period) is not None
        }
        if len(set(periods.values())) > 1:
            listed = ", ".join(f"{name} = {value:g} s" for name, value in periods.items())
            self.problems.add(f"The sampled parts have different periods: {listed}; give them one.")
        return next(iter(periods), None)

    def _variables(self, part: str, kind: str) -> tuple[Input | Output, ...]:
        s = self.models[part].structure
        return s.inputs if kind == "input" else s.outputs

    def _port(self, text: str, kind: str) -> tuple[Port, Input | Output] | None:
        """Return a port and its variable by its text, or None after noting what is wrong."""
        name, dot, variable = text.partition(".")
        if name not in self.models or not dot:
            self.problems.add(
                f"'{text}' names no part; write part.{kind}, the parts are"
                f" {', '.join(self.models)}."
            )
            return None
        known = {v.name: v for v in self._variables(name, kind)}
        if variable not in known:
            listed = ", ".join(known) or "none"
            self.problems.add(f"'{text}' is no {kind}; the {kind}s of '{name}' are: {listed}.")
            return None
        return (name, variable), known[variable]

    def _named(
        self, kind: str, names: Mapping[str, str] | None, sources: Mapping[Port, Port]
    ) -> dict[Port, str]:
        """Return the names outside of the inputs or outputs that have one; one name each."""
        if names is None:
            every = [(part, v.name) for part in self.models for v in self._variables(part, kind)]
            return {port: "_".join(port) for port in every if port not in sources}
        texts: dict[Port, str] = {}
        for name, text in names.items():
            known = self._port(text, kind)
            if known is None:
                continue
            port, _ = known
            other = ".".join(sources[port]) if port in sources else texts.get(port)
            if other is not None:
                what = "has two sources," if kind == "input" else "is named twice outside,"
                self.problems.add(
                    f"The {kind} '{text}' {what} '{other}' and '{name}'; leave one out."
                )
            texts[port] = name
        return texts

    def _renamed(self, name: str, model: Model) -> list[Expression]:
        """Return slopes, next values, switches and outputs of a part in new symbols."""
        s, new = model.structure, [self.symbols["time"]]
        names = [*model.parameter_names, *model.state_names, *model.sampled_names]
        names += model.input_names
        for n in names:
            symbol, port = ca.SX.sym(f"{name}_{n}"), (name, n)
            if n in model.input_names and port not in self.inputs:
                new.append(self.inside.setdefault(port, symbol))
                continue
            outside = self.inputs.get(port) or f"{name}_{n}"
            if n == s.period and self.period is not None:
                outside = self.period
            new.append(self.symbols.setdefault(outside, symbol))
        results = [s.xdot, s.znext, ca.vertcat(ca.SX(0, 1), *s.switches.values()), s.y]
        expressions: list[Expression] = ca.substitute(
            results, [s.time, *(s.symbols[n] for n in names)], new
        )
        return expressions

    def component(self, name: str) -> Component:
        """Return a part as a component whose variables are named `part_variable`.

        Its inputs are replaced by what feeds them. Raises InputError for a loop of outputs that
        follow their inputs at once.
        """
        model = self.models[name]
        s = model.structure
        places = {"der": model.state_names, "next": model.sampled_names, "switches": s.switches}
        whole = self._wired(name, ca.vertcat(*self.results[name][:3]), ())
        elements = iter([whole[k] for k in range(whole.numel())])
        values = {k: {f"{name}_{n}": next(elements) for n in names} for k, names in places.items()}
        table = {n: self.output((name, n), ()) for n in model.output_names}
        values["out"] = {
            self.outputs[q]: e for n, e in table.items() if (q := (name, n)) in self.outputs
        }
        before = list(self.symbols.values())

        def equations(symbols: Symbols) -> Equations:
            after = [getattr(symbols, n) for n in self.symbols]
            return Equations(
                **{
                    kind: dict(
                        zip(rows, ca.substitute(list(rows.values()), before, after), strict=True)
                    )
                    for kind, rows in values.items()
                }
            )

        sources = "; ".join(dict.fromkeys(c.source.rstrip(".") for c in model.components))
        return Component(
            name=name,
            description=model.description or "; ".join(c.description for c in model.components),
            source=sources,
            equation_text=";  ".join(c.equation_text for c in model.components if c.equation_text),
            equations=equations,
            sample_period=self.period if s.sampled else None,
            **self._declared(name, model),
        )

    def _declared(self, name: str, model: Model) -> dict[str, Any]:
        """Return the variables of a part as they are named in the system, by kind."""
        s = model.structure
        places = {n: f"{name}_{n}" for n in model.parameter_names}
        if s.period is not None and self.period is not None:
            places[s.period] = self.period

        def renamed(variable: Any, **size: Any) -> Any:
            text = f"{name}: {variable.description}"
            return replace(variable, name=f"{name}_{variable.name}", description=text, **size)

        def size(nominal: Nominal) -> Nominal:
            return _BySystem(nominal, places) if callable(nominal) else nominal

        def named(variables: Sequence[Any], names: Mapping[Port, str]) -> tuple[Any, ...]:
            return tuple(
                replace(v, name=names[name, v.name], nominal=size(v.nominal))
                for v in variables
                if (name, v.name) in names
            )

        return {
            "parameters": tuple(
                renamed(p, scale=None if p.scale is None else size(p.scale))
                for p in s.parameters
                if p.name != s.period or self.period == f"{name}_{p.name}"
            ),
            "states": tuple(renamed(v, nominal=size(v.nominal)) for v in s.states),
            "sampled": tuple(renamed(v, nominal=size(v.nominal)) for v in s.sampled),
            "inputs": named(s.inputs, self.inputs),
            "outputs": named(s.outputs, self.outputs),
        }

    def output(self, port: Port, path: tuple[Port, ...]) -> Expression:
        """Return an output in states, parameters and the inputs from outside."""
        if port in path:
            loop = " -> ".join(".".join(p) for p in (*path[path.index(port) :], port))
            raise InputError(
                f"The outputs form a loop, each following its inputs at once: {loop}; put a part"
                " with a state or a sampled part between two of them."
            )
        if port not in self.known:
            name, variable = port
            row = self.models[name].output_names.index(variable)
            self.known[port] = self._wired(name, self.results[name][3][row], (*path, port))
        return self.known[port]

    def _wired(self, name: str, expression: Expression, path: tuple[Port, ...]) -> Expression:
        """Replace the inputs that an expression of a part depends on by what feeds them."""
        symbols, feeding = [], []
        for it in self.models[name].structure.inputs:
            symbol = self.inside.get((name, it.name))
            if symbol is None or not ca.depends_on(expression, symbol):
                continue
            symbols.append(symbol)
            source = self.sources.get((name, it.name))
            feeding.append(ca.SX(it.start) if source is None else self.output(source, path))
        return ca.substitute([expression], symbols, feeding)[0]


@dataclass(frozen=True)
class _BySystem:
    """A size of a part by the system's values; `places` are its parameters' names there."""

    size: Nominal
    places: Mapping[str, str]

    def __call__(self, values: Values) -> float:
        return nominal_value(self.size, {n: values[place] for n, place in self.places.items()})
