"""A flexure stage that a stack pushes on through a contact spring: a second model to couple."""

from psa_casadi.component import Component, Equations, Symbols
from psa_casadi.variables import Input, Output, Parameter, State


def _flexure(s: Symbols) -> Equations:
    """A flexure stage that a stack pushes on through a contact spring: a second model to couple."""
    contact = s.k_c * (s.tip_position - s.x_f) + s.c_c * (s.tip_velocity - s.v_f)
    return Equations(
        der={"x_f": s.v_f, "v_f": (contact - s.c_f * s.v_f - s.k_f * s.x_f) / s.m_f},
        out={"reaction_force": -contact, "stage_position": s.x_f},
    )


FLEXURE = Component(
    name="flexure",
    description="guided stage (mass, damper, spring) behind a contact stiffness",
    source="Newton's second law; Yang and Zhu 2015, eq. 44 for the mechanism",
    equation_text="m_f x_f'' + c_f x_f' + k_f x_f = F,  F = k_c (x - x_f) + c_c (x' - x_f')",
    equations=_flexure,
    parameters=(
        Parameter("m_f", 0.2, "kg", (1e-6, 1e3), "mass of the stage", log=True),
        Parameter("c_f", 50.0, "N.s/m", (0.0, 1e9), "damping of the flexure"),
        Parameter("k_f", 5e6, "N/m", (0.0, 1e12), "stiffness of the flexure"),
        Parameter("k_c", 5e7, "N/m", (1.0, 1e12), "contact stiffness", log=True),
        Parameter("c_c", 500.0, "N.s/m", (0.0, 1e9), "contact damping"),
    ),
    states=(
        State("x_f", "m", "position of the stage", 1e-5, display_unit="um"),
        State("v_f", "m/s", "velocity of the stage", 1e-2, display_unit="um/s"),
    ),
    inputs=(
        Input(
            "tip_position", "m", "position of the stack's output", display_unit="um", nominal=1e-5
        ),
        Input(
            "tip_velocity",
            "m/s",
            "velocity of the stack's output",
            display_unit="um/s",
            nominal=1e-2,
        ),
    ),
    outputs=(
        Output("reaction_force", "N", "force of the stage on the stack", 100.0),
        Output("stage_position", "m", "position of the stage", 1e-5, "um"),
    ),
)
