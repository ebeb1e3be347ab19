"""A load that can lift off the tip of a stack: contact, preload and mass in one component.

A constant force presses the load on the tip; it is not glued, so that its position is a separate
state. It stays on the tip while the tip withdraws with less than preload / mass, here 300 m/s2.
"""

from pathlib import Path

import casadi as ca
import numpy as np

import psa_casadi as psa


def equations(s: psa.Symbols) -> psa.Equations:
    """Return the motion of the load; the contact is rounded over 0.1 um, and never pulls."""
    depth = s.x - s.x_load
    force = s.k_touch * 0.5 * (depth + ca.sqrt(depth**2 + 1e-14))
    return psa.Equations(
        der={"x_load": s.v_load, "v_load": (force - s.preload - s.c_load * s.v_load) / s.m_load},
        add={"tip_force": -force},
        out={"contact_force": force},
        switches={"touch": depth},  # the solver ends a step where the contact opens
    )


LOAD = psa.Component(
    name="loose_load",
    description="a mass that a constant force presses on the tip, and that can lift off",
    source="Newton's second law; unilateral contact (Signorini)",
    equations=equations,
    parameters=(
        psa.Parameter("m_load", 0.1, "kg", (1e-6, 1e3), "mass of the load"),
        psa.Parameter("preload", 30.0, "N", (0.0, 1e5), "force that presses it on the tip"),
        psa.Parameter("c_load", 5.0, "N.s/m", (0.0, 1e6), "damping of its guide"),
        psa.Parameter("k_touch", 5e7, "N/m", (1.0, 1e12), "stiffness of the contact"),
    ),
    states=(
        psa.State("x_load", "m", "position of the load", 1e-5),
        psa.State("v_load", "m/s", "velocity of the load", 1e-2),
    ),
    outputs=(psa.Output("contact_force", "N", "force between tip and load", 30.0),),
)


def main(folder: Path) -> dict[str, float]:
    """Withdraw the stack slowly and fast; return the least force and the largest gap; export it."""
    stack = psa.stack_model("P-885.51").plant()
    model = stack.with_components((*stack.components, LOAD))
    figures = {}
    for edge in (10e-3, 0.1e-3):  # s
        t = np.linspace(0.0, 15e-3, 3001)
        run = psa.simulate(model, t, 100.0 * (1.0 - np.clip((t - 2e-3) / edge, 0.0, 1.0)))
        gap = float((run.states["x_load"] - run.states["x"]).max())
        least = float(run.outputs["contact_force"].min())
        figures[f"least force, edge of {1e3 * edge:g} ms [N]"] = least
        figures[f"gap, edge of {1e3 * edge:g} ms [um]"] = 1e6 * max(gap, 0.0)
    psa.export_fmu(psa.settled_at(model, 0.0), folder / "loose.fmu")
    return figures
