"""A prestress mechanism around a stack, and the port by which the two models are coupled."""

from psa_casadi.component import Component, Equations, Symbols
from psa_casadi.scales import force_scale
from psa_casadi.variables import Input, Output, Parameter, State


def _mechanism(s: Symbols) -> Equations:
    force = s.m_m * s.tip_acceleration + s.c_m * s.tip_velocity + s.k_m * s.tip_position
    return Equations(
        der={"heat": s.c_m * s.tip_velocity**2},
        out={"reaction_force": -force, "dissipated_energy": s.heat},
    )


def _port(s: Symbols) -> Equations:
    pull = s.c_B * (s.v_x - s.v_y) + s.k_B * (s.x - s.y)
    return Equations(
        add={"wafer_force": s.prestress_force},
        out={
            "tip_velocity": s.v_x,
            "tip_acceleration": (s.transmitted_force + s.tip_force - pull) / s.m_B,
        },
    )


PRESTRESS_MECHANISM = Component(
    name="prestress_mechanism",
    description="elastic mechanism that holds a stack under prestress: mass, damper, spring",
    source="Yang and Zhu 2015, eq. 44",
    equation_text="F = -(m x'' + c x' + k x);  W' = c x'^2",
    equations=_mechanism,
    parameters=(
        Parameter("m_m", 0.05, "kg", (0.0, 1e3), "mass of the mechanism", "g", scale=0.01),
        Parameter("c_m", 100.0, "N.s/m", (0.0, 1e9), "damping of the mechanism"),
        Parameter("k_m", 5e6, "N/m", (0.0, 1e12), "stiffness of the mechanism"),
    ),
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
