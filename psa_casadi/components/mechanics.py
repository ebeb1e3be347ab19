"""Mechanics: the paper's one-way cascade of wafers and bonding layers, and the single mass."""

from psa_casadi.component import Component, Equations, Symbols
from psa_casadi.scales import force_scale, stroke_scale, velocity_scale
from psa_casadi.variables import Input, Output, Parameter, State

_LOAD = Input(
    "load_force",
    "N",
    "external force on the output mass, positive outward",
    nominal=force_scale,
)
_OUTPUTS = (
    Output("displacement", "m", "displacement of the stack's output", stroke_scale, "um"),
    Output("velocity", "m/s", "velocity of the stack's output", velocity_scale, "um/s"),
    Output(
        "blocked_force", "N", "force that would hold the output at zero displacement", force_scale
    ),
)


def _mass(name: str, value: float, what: str) -> Parameter:
    return Parameter(name, value, "kg", (1e-9, 1e3), f"equivalent mass of {what}", log=True)


def _damping(name: str, value: float, what: str) -> Parameter:
    return Parameter(name, value, "N.s/m", (1e-6, 1e9), f"equivalent damping of {what}", log=True)


def _stiffness(name: str, value: float, what: str) -> Parameter:
    return Parameter(name, value, "N/m", (1.0, 1e12), f"equivalent stiffness of {what}", log=True)


def _cascade(s: Symbols) -> Equations:
    elastic = s.c_P * s.v_y + s.k_P * s.y
    pull = s.c_B * (s.v_x - s.v_y) + s.k_B * (s.x - s.y)
    return Equations(
        der={
            "y": s.v_y,
            "v_y": (s.wafer_force - elastic) / s.m_P,
            "x": s.v_x,
            "v_x": (s.transmitted_force + s.tip_force - pull) / s.m_B,
        },
        add={
            "transmitted_force": elastic,
            "tip_force": s.load_force,
            "tip_displacement": s.x,
            "displacement": s.tip_displacement,
            "blocked_force": s.transmitted_force + s.c_B * s.v_y + s.k_B * s.y,
        },
        out={"displacement": s.displacement, "blocked_force": s.blocked_force},
    )


def _single_mass(s: Symbols) -> Equations:
    return Equations(
        der={
            "x": s.v_x,
            "v_x": (s.wafer_force + s.tip_force - s.c * s.v_x - s.k * s.x) / s.m,
        },
        add={
            "tip_force": s.load_force,
            "tip_displacement": s.x,
            "displacement": s.tip_displacement,
            "blocked_force": s.wafer_force,
        },
        out={"displacement": s.displacement, "blocked_force": s.blocked_force},
    )


_OUTPUT_STATES = (
    State("x", "m", "displacement of the output mass", stroke_scale, display_unit="um"),
    State("v_x", "m/s", "velocity of the output mass", velocity_scale, display_unit="um/s"),
)

CASCADE_MECHANICS = Component(
    name="cascade_mechanics",
    description="one-way cascade of the wafers' and the bonding layers' oscillator",
    source="Yang and Zhu 2015, eqs. 4 and 5, with an external force on the output mass",
    equation_text=(
        "m_P y'' + c_P y' + k_P y = f_out;  "
        "m_B x'' + c_B (x' - y') + k_B (x - y) = c_P y' + k_P y + f_load"
    ),
    equations=_cascade,
    parameters=(
        _mass("m_P", 5e-3, "the wafers"),
        _damping("c_P", 100.0, "the wafers"),
        _stiffness("k_P", 1.2e8, "the wafers"),
        _mass("m_B", 5e-3, "the bonding layers"),
        _damping("c_B", 300.0, "the bonding layers"),
        _stiffness("k_B", 6e8, "the bonding layers"),
    ),
    states=(
        State("y", "m", "displacement of the wafers", stroke_scale, display_unit="um"),
        State("v_y", "m/s", "velocity of the wafers", velocity_scale, display_unit="um/s"),
        *_OUTPUT_STATES,
    ),
    inputs=(_LOAD,),
    outputs=_OUTPUTS,
)

SINGLE_MASS = Component(
    name="single_mass",
    description="one equivalent mass, spring and damper for the whole stack",
    source="Yang and Zhu 2015, eq. 6 (the simplified comprehensive model)",
    equation_text="m x'' + c x' + k x = f_out + f_load",
    equations=_single_mass,
    parameters=(
        _mass("m", 1e-2, "the stack"),
        _damping("c", 200.0, "the stack"),
        _stiffness("k", 1e8, "the stack"),
    ),
    states=_OUTPUT_STATES,
    inputs=(_LOAD,),
    outputs=_OUTPUTS,
)
