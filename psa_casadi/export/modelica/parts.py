"""Expressions that deserve a name where they occur in a model, with their units and meanings."""

from collections.abc import Callable
from dataclasses import dataclass

from psa_casadi.component import Expression, Symbols
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
