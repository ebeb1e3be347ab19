"""Parameters that change, and gains of intermediates: with a state, an input or time."""

from dataclasses import replace

import casadi as ca

from psa_casadi.component import Expression, Symbols
from psa_casadi.diagnosis.generic.attached import Attached, Own, at_port, scale_of
from psa_casadi.diagnosis.generic.of_signals import ANGLE
from psa_casadi.model.compose import Model
from psa_casadi.model.ports import Port, parameter_ports, ports_of, true_sum, unit_of
from psa_casadi.shapes import ANGLES
from psa_casadi.simulation.sizes import Sizes
from psa_casadi.variables import Parameter

#: A parameter changes by this share of its value as a rule, and by so many times it at most.
_ORDINARY, _MOST = 0.1, 5.0


def changing(model: Model, sizes: Sizes) -> tuple[Attached, ...]:
    """Return how every parameter and intermediate may change with states, inputs and time."""
    states = [q.name for c in model.components if c.gain is None for q in c.states]
    known = {i.name: i.unit for i in model.structure.inputs}
    marked = [p for p in ports_of(model) if p.kind == "intermediate"]
    attacheds: list[Attached] = []
    for port in (*parameter_ports(model), *marked):
        attacheds += [_with(port, x, unit_of(model, x), sizes.signals[x]) for x in states]
        attacheds += [_with(port, u, unit, sizes.signals[u]) for u, unit in known.items()]
        attacheds.append(_with(port, "time", "s", sizes.duration))
    return tuple(attacheds)


def _with(port: Port, x: str, unit: str, size: float) -> Attached:
    p = port.variable if port.kind == "parameter" else true_sum(port.variable)

    def law(s: Symbols, item: Own) -> Expression:
        part = getattr(s, x) / item("range")
        curve = ca.cos(item("angle")) * part + ca.sin(item("angle")) * part**2
        return item("size") * getattr(s, p) * curve

    return at_port(
        port, f"change_of_{port.variable}_with_{x}", law,
        gain="size",
        words=(
            "it drifts: ageing, heat, wear" if x == "time" else f"it depends on {x}",
            "first two terms of its series",
            f"Q = {p} (1 + size (cos(angle) r + sin(angle) r^2)),  r = {x}/range",
            "what the parameter stands for is another one at another level or time",
        ),
        parameters=(
            Parameter(
                "size", 0.0, "1", (-_MOST, _MOST), "relative change at the range's end",
                scale=_ORDINARY,
            ),
            replace(ANGLE, description="form of the curve: 0 straight, pi/2 quadratic"),
            scale_of("range", size, unit, x),
        ),
        probe={"angle": ANGLES},
    )  # fmt: skip
