"""The hysteresis observed and taken off, sample by sample: observer, feed-forward, both tracked.

The voltage goes in a line from one sample to the next, so that it turns at samples only: the kink
of eq. (8) never lies inside a step (`hysteresis_step`). The voltage at which `k_L u + f_H(u)` is
the wanted force, `K w` of a wanted displacement w at the stiffness K, is solved for by three Newton
steps. Every sample takes the same operations.
"""

from dataclasses import replace

from psa_casadi.component import Component, Equations, Expression, Symbols
from psa_casadi.components.hysteresis_step import (
    TRACKED,
    Constants,
    constants,
    estimates,
    force_after,
    linearising_voltage,
)
from psa_casadi.components.online_identification import (
    ONLINE_IDENTIFICATION,
    SAMPLED,
    estimate_outputs,
    flattened,
    force_scale,
    gathered,
    stroke,
)
from psa_casadi.components.online_recursion import advance
from psa_casadi.scales import voltage_scale
from psa_casadi.variables import Input, Output, Parameter, State

_LEARNING = ("lag", "memory", "standstill_rate", "noise", "spread")
_OBSERVING = tuple(
    replace(p, description=p.description.removeprefix("start of the "))
    for p in ONLINE_IDENTIFICATION.parameters
    if p.name not in _LEARNING
)
_FORCE = Output("hysteresis_force", "N", "estimated hysteresis force", force_scale)
_VOLTAGE = Output("voltage", "V", "voltage at which the stack is where it is wanted", voltage_scale)
_WANTED = Input("wanted", "m", "displacement that is wanted", 0.0, stroke, "um")
_LAST = (
    State("u_last", "V", "voltage at the last instant", voltage_scale),
    State("f_H", "N", "estimated hysteresis force", force_scale),
)
_WANTED_LAST = State("wanted_last", "m", "wanted displacement of the last instant", stroke,
                     display_unit="um")  # fmt: skip
_PAPER = "Yang and Zhu 2015, section 5.1:"


def _constants(s: Symbols, parameters: tuple[Parameter, ...]) -> Constants:
    """Return the constants; what learning needs has its default where a block does not learn."""
    default: dict[str, Expression] = {p.name: p.value for p in ONLINE_IDENTIFICATION.parameters}
    return constants(default | {p.name: getattr(s, p.name) for p in parameters})


def _observer(s: Symbols) -> Equations:
    c = _constants(s, _OBSERVING)
    force = force_after(c, c.start, s.f_H, s.u_last, s.voltage)
    return Equations(
        next={"u_last": s.voltage, "f_H": force},
        out={"hysteresis_force": s.f_H, "correction": -s.f_H / s.k_L},
    )


def _next_voltage(
    c: Constants, s: Symbols, theta: list[Expression], force: Expression, last: Expression
) -> Expression:
    """Return the voltage at the next instant, from the force and the voltage at the last one."""
    guess = last + (s.wanted - s.wanted_last) * s.stiffness / s.k_L
    return linearising_voltage(c, theta, force, last, guess, s.stiffness * s.wanted)


def _feed_forward(s: Symbols) -> Equations:
    c = _constants(s, _OBSERVING)
    u = _next_voltage(c, s, list(c.start), s.f_H, s.u_last)
    force = force_after(c, c.start, s.f_H, s.u_last, u)
    return Equations(
        next={"u_last": u, "f_H": force, "wanted_last": s.wanted},
        out={"voltage": s.u_last, "hysteresis_force": s.f_H},
    )


def _adaptive(s: Symbols) -> Equations:
    """The voltage that was returned last has been applied when the displacement is measured."""
    c = _constants(s, ONLINE_IDENTIFICATION.parameters)
    now = gathered([getattr(s, state.name) for state in SAMPLED])
    after = advance(c, now, s.applied, s.position)
    u = _next_voltage(c, s, estimates(c, after.z), after.f, after.u)
    names = [state.name for state in SAMPLED]
    found = dict(zip(TRACKED, estimates(c, now.z), strict=True))
    return Equations(
        next={
            **dict(zip(names, flattened(after), strict=True)),
            "applied": u,
            "wanted_last": s.wanted,
        },
        out={
            "voltage": s.applied,
            **{f"{name}_hat": value for name, value in found.items()},
            "hysteresis_force": now.f,
        },
    )


HYSTERESIS_OBSERVER = Component(
    name="hysteresis_observer",
    description="observer of the hysteresis force on the known voltage, one sample in, one out",
    source=f"{_PAPER} observer (37)",
    equation_text="f_H+ = f_H by (8) along the line from u- to u",
    belongs_to="drive",
    equations=_observer,
    parameters=_OBSERVING,
    sampled=_LAST,
    sample_period="period",
    inputs=(Input("voltage", "V", "voltage at the stack", nominal=voltage_scale),),
    outputs=(
        _FORCE,
        Output("correction", "V", "voltage to add so that the stack is linear", voltage_scale),
    ),
)

FEED_FORWARD = Component(
    name="feed_forward",
    description="voltage for a wanted displacement of a stack, its hysteresis taken off, sampled",
    source=f"{_PAPER} observer (37), compensation (39) to (41)",
    equation_text="k_L u + f_H(u) = K w for u;  f_H(u) by (8) along the line from u-",
    belongs_to="drive",
    equations=_feed_forward,
    parameters=_OBSERVING,
    sampled=(*_LAST, _WANTED_LAST),
    sample_period="period",
    inputs=(_WANTED,),
    outputs=(_VOLTAGE, _FORCE),
)

ADAPTIVE_FEED_FORWARD = Component(
    name="adaptive_feed_forward",
    description="feed-forward whose hysteresis parameters follow the measured displacement",
    source=f"{_PAPER} equations (37) to (41)",
    equation_text="as feed_forward, with A, beta, gamma, delta, n, k_L of online_identification",
    belongs_to="drive",
    equations=_adaptive,
    parameters=ONLINE_IDENTIFICATION.parameters,
    sampled=(
        *SAMPLED,
        State("applied", "V", "voltage that was returned last", voltage_scale),
        _WANTED_LAST,
    ),
    sample_period="period",
    inputs=(_WANTED, Input("position", "m", "measured displacement", 0.0, stroke, "um")),
    outputs=(_VOLTAGE, *estimate_outputs(), _FORCE),
)
