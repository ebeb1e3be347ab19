"""A prestress mechanism around a stack, and the port by which the two models are coupled."""

from psa_casadi.component import Component, Equations, Expression, Symbols
from psa_casadi.scales import force_scale
from psa_casadi.variables import Input, Output, Parameter, State


def _mechanism(s: Symbols) -> Equations:
    force = s.m_m * s.tip_acceleration + s.c_m * s.tip_velocity + s.k_m * s.tip_position
    return Equations(
        der={"heat": s.c_m * s.tip_velocity**2},
        out={"reaction_force": -force, "dissipated_energy": s.heat},
    )


def _port(s: Symbols) -> Equations:
    return Equations(
        add={"wafer_force": s.prestress_force},
        out={
            "tip_velocity": s.v_x,
            "tip_acceleration": (s.transmitted_force + s.tip_force - _pull(s)) / s.m_B,
        },
    )


def _pull(s: Symbols) -> Expression:
    """Force of the bonding layers on the wafers [N]."""
    return s.c_B * (s.v_x - s.v_y) + s.k_B * (s.x - s.y)


def _on_wafers(s: Symbols) -> Equations:
    acceleration = (s.transmitted_force + s.tip_force - _pull(s)) / s.m_B
    force = s.m_m * acceleration + s.c_m * s.v_x + s.k_m * s.x
    return Equations(add={"wafer_force": -s.mounted * force})


def _on_tip(s: Symbols) -> Equations:
    mass, held = s.mounted * s.m_m, s.mounted * (s.c_m * s.v_x + s.k_m * s.x)
    beside = s.transmitted_force + s.load_force - _pull(s)
    return Equations(add={"tip_force": -(mass * beside + s.m_B * held) / (s.m_B + mass)})


_MECHANISM = (
    Parameter("m_m", 0.05, "kg", (0.0, 1e3), "mass of the mechanism", "g", scale=0.01),
    Parameter("c_m", 100.0, "N.s/m", (0.0, 1e9), "damping of the mechanism"),
    Parameter("k_m", 5e6, "N/m", (0.0, 1e12), "stiffness of the mechanism"),
)
_MOUNTED = Parameter(
    "mounted", 0.0, "1", (0.0, 1.0), "share of the mechanism that is there: 0 the free stack",
    scale=1.0,
)  # fmt: skip
_COUPLED = "Yang and Zhu 2015, eq. 45: the mechanism is feedback around the stack's mechanics"

PRESTRESS_MECHANISM = Component(
    name="prestress_mechanism",
    description="elastic mechanism that holds a stack under prestress: mass, damper, spring",
    source="Yang and Zhu 2015, eq. 44",
    equation_text="F = -(m x'' + c x' + k x);  W' = c x'^2",
    equations=_mechanism,
    parameters=_MECHANISM,
    inputs=(
        Input("tip_position", "m", "position of the stack's output", 0.0, 1e-5, "um"),
        Input("tip_velocity", "m/s", "velocity of the stack's output", 0.0, 1e-2, "um/s"),
        Input("tip_acceleration", "m/s2", "acceleration of the stack's output", 0.0, 1e2),
    ),
    states=(State("heat", "J", "energy that the damper has turned into heat", 1e-3),),
    outputs=(
        Output("reaction_force", "N", "force of the mechanism on the stack", 100.0),
        Output("dissipated_energy", "J", "energy that the damper has turned into heat", 1e-3),
    ),
)

PRESTRESS_PORT = Component(
    name="prestress_port",
    description="where a prestress mechanism acts: its force comes in, the tip's motion goes out",
    source="Yang and Zhu 2015, eq. 45 and figure 12: the mechanism is feedback around G_P",
    equation_text="f_out + F acts on the wafers;  x', x'' of the output go out",
    needs=("cascade_mechanics",),
    equations=_port,
    inputs=(
        Input("prestress_force", "N", "force of the mechanism on the stack", nominal=force_scale),
    ),
    outputs=(
        Output("tip_velocity", "m/s", "velocity of the output mass", 1e-2, "um/s"),
        Output("tip_acceleration", "m/s2", "acceleration of the output mass", 1e2),
    ),
)

#: A mechanism around a stack in one model: its force acts where the key says.
PRESTRESS_MOUNTS = {
    "wafers": Component(
        name="prestress_on_wafers",
        description="prestress mechanism around a stack, whose force acts on the wafers",
        source=_COUPLED,
        equation_text="f_out - (m x'' + c x' + k x) acts on the wafers",
        needs=("cascade_mechanics",),
        gain="mounted",
        equations=_on_wafers,
        parameters=(_MOUNTED, *_MECHANISM),
        looks_like="more damping, resonances elsewhere, and a share of the stroke that is lost",
    ),
    "tip": Component(
        name="prestress_on_tip",
        description="prestress mechanism that pushes on the output mass of a stack",
        source=_COUPLED,
        equation_text="(m_B + m) x'' = F - c x' - k x,  F: all else that acts on the output mass",
        needs=("cascade_mechanics",),
        gain="mounted",
        equations=_on_tip,
        parameters=(_MOUNTED, *_MECHANISM),
        looks_like="more damping, resonances elsewhere, and a share of the stroke that is lost",
    ),
}
