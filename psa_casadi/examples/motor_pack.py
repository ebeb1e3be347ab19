"""A pack for a motor: its model, three effects for it, and records that hide each of them.

The plants have other laws than the effects: a pull of the teeth that is stronger near a magnet's
edge, arcs of a cosine with kinks, and a winding in a case that convection cools.
"""

from collections.abc import Callable
from pathlib import Path

import casadi as ca
import numpy as np
import scipy

import psa_casadi as psa

# The pack: the model of the motor ...
voltage, i, w, theta = (ca.SX.sym(n) for n in ("voltage", "i", "w", "theta"))
R, L, k, J, b = (ca.SX.sym(n) for n in ("R", "L", "k", "J", "b"))
motor = psa.ode_model(
    {
        "x": [i, w, theta],
        "u": voltage,
        "p": [R, L, k, J, b],
        "y": [i, w, theta],
        "ode": [(voltage - R * i - k * w) / L, (k * i - b * w) / J, w],
    },
    name="dc_motor",
    states=[
        psa.State("i", "A", "current in the winding", nominal=1.0),
        psa.State("w", "rad/s", "speed of the shaft", nominal=50.0),
        psa.State("theta", "rad", "angle of the shaft", nominal=10.0),
    ],
    inputs=[psa.Input("voltage", "V", "voltage at the terminals")],
    parameters=[
        psa.Parameter("R", 1.0, "Ohm", (0.1, 10.0), "resistance when cold", log=True),
        psa.Parameter("L", 1e-3, "H", (1e-4, 1e-2), "inductance", log=True),
        psa.Parameter("k", 0.04, "N.m/A", (0.005, 0.5), "torque constant", log=True),
        psa.Parameter("J", 5e-5, "kg.m2", (1e-6, 1e-3), "inertia of rotor and load", log=True),
        psa.Parameter("b", 1e-4, "N.m.s", (1e-7, 1e-2), "damping", log=True),
    ],
    outputs=[
        psa.Output("current", "A", "current in the winding"),
        psa.Output("speed", "rad/s", "speed of the shaft"),
        psa.Output("angle", "rad", "angle of the shaft"),
    ],
    source="Hughes and Drury, Electric Motors and Drives, 2019, chapter 3",
)

# ... and three effects. Two poles and five slots: 10 cogs and 10 commutations in a turn.
TURN = 10


def phase_of(effect: str) -> psa.Parameter:
    """Return the phase of a wave over the angle."""
    return psa.Parameter(f"{effect}_phase", 0.0, "rad", (-7.0, 7.0), "where the wave starts")


cogging = psa.Component(
    "cogging",
    description="the teeth of the rotor are drawn to the magnets",
    source="Zhu and Howe, IEEE Transactions on Energy Conversion 15, 2000, 407",
    equation_text="J w' gains cogging_torque sin(10 theta + cogging_phase)",
    equations=lambda s: psa.Equations(
        add={"rate_w": s.cogging_torque * ca.sin(TURN * s.theta + s.cogging_phase) / s.J},
    ),
    parameters=(
        psa.Parameter("cogging_torque", 0.0, "N.m", (0.0, 0.1), "its peak", scale=0.005),
        phase_of("cogging"),
    ),
    gain="cogging_torque",
    probe={"cogging_phase": (0.0, 1.57, 3.14, 4.71)},
)


def ripple_of(s: psa.Symbols) -> psa.Equations:
    """Return the torque constant over the angle, in the torque and in the induced voltage."""
    more = s.k * s.ripple * ca.cos(TURN * s.theta + s.ripple_phase)
    return psa.Equations(add={"rate_w": more * s.i / s.J, "applied_voltage": -more * s.w})


commutation_ripple = psa.Component(
    "commutation_ripple",
    description="the torque constant swings as the brushes pass from bar to bar",
    source="Hughes and Drury, Electric Motors and Drives, 2019, chapter 3",
    equation_text="k(theta) = k (1 + ripple cos(10 theta + ripple_phase))",
    equations=ripple_of,
    parameters=(
        psa.Parameter("ripple", 0.0, "1", (0.0, 0.5), "share of the torque constant", scale=0.02),
        phase_of("ripple"),
    ),
    gain="ripple",
    probe={"ripple_phase": (0.0, 1.57, 3.14, 4.71)},
)


def heat_of(s: psa.Symbols) -> psa.Equations:
    """Return the resistance R (1 + heating loss) by the loss of the last seconds."""
    hot = s.R * s.heating * s.loss
    return psa.Equations(
        add={"applied_voltage": -hot * s.i},
        der={"loss": ((s.R + hot) * s.i**2 - s.loss) / s.heat_time},
    )


winding_heat = psa.Component(
    "winding_heat",
    description="the resistance rises as the winding gets warm",
    source="IEC 60028 (copper); a body with one capacity and one resistance of heat",
    equation_text="R_hot = R (1 + heating loss);  heat_time loss' = R_hot i^2 - loss",
    equations=heat_of,
    parameters=(
        psa.Parameter("heating", 0.0, "1/W", (0.0, 0.5), "rise of R by the loss", scale=0.01),
        psa.Parameter("heat_time", 10.0, "s", (1.0, 100.0), "time constant of the heat", log=True),
    ),
    states=(psa.State("loss", "W", "loss, as the winding feels it", nominal=5.0, memory=True),),
    gain="heating",
    probe={"heat_time": (3.0, 10.0, 30.0)},
)
effects = [cogging, commutation_ripple, winding_heat]
# The end of the pack.

# The plants, whose laws have other forms.
t = np.arange(4000) * 2e-3
tones = (2, 0.5, 0), (3, 2.9, 1), (1, 1.3, 2)
u = sum(a * np.sin(2 * np.pi * f * t + p) for a, f, p in tones)


def magnets(turn: float) -> float:
    """Return the pull on a tooth, stronger near a magnet's edge than far from it, in N.m."""
    s = 10 * turn - 0.7
    return float(-0.012 * np.sin(s) * np.exp(0.5 * (np.cos(s) - 1)))


def brushes(turn: float) -> float:
    """Return the pull of the coil as it turns away from the field, until the next one comes."""
    return float(np.cos(np.mod(turn - 0.1, 2 * np.pi / 10) - np.pi / 10))


def plant(hidden: str) -> Callable[[float, np.ndarray], list[float]]:
    """Return the rates of current, speed, angle, and of the heat in winding and case."""

    def rates(now: float, q: np.ndarray) -> list[float]:
        amps, speed, turn, winding, case = q
        hot = 1.2 * (1 + 0.0039 * winding) if hidden == "winding_heat" else 1.2
        kt = 0.05 * (brushes(turn) if hidden == "commutation_ripple" else 1)
        pull = magnets(turn) if hidden == "cogging" else 0
        away = 0.1 * (winding - case)
        return [
            (np.interp(now, t, u) - hot * amps - kt * speed) / 2e-3,
            (kt * amps - 5e-5 * speed + pull) / 1e-4,
            speed,
            (hot * amps**2 - away) / 1.5,
            (away - 0.03 * max(case, 0) ** 1.25) / 20,
        ]

    return rates


def record(hidden: str, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return what is measured of a motor that has one of the effects, or nothing."""
    run = scipy.integrate.solve_ivp(
        plant(hidden), (0, t[-1]), np.zeros(5), t_eval=t, method="LSODA", rtol=1e-8, max_step=2e-3
    )
    amps, speed, turn = run.y[:3]
    return {
        "time": t,
        "voltage": u,
        "current": amps + 0.005 * rng.standard_normal(4000),
        "speed": speed + 0.1 * rng.standard_normal(4000),
        "angle": turn + 0.002 * rng.standard_normal(4000),
    }


def main(folder: Path) -> dict[str, psa.Diagnosis]:
    """Hide nothing and then each effect, diagnose, write the pages; return the diagnoses."""
    rng = np.random.default_rng(1)
    results = {}
    for hidden in ("nothing", "cogging", "commutation_ripple", "winding_heat"):
        # hysteresis takes longest to search, and changes none of these answers
        d = psa.diagnose(motor, record(hidden, rng), effects=effects, leave_out=["hysteresis"])
        d.report(folder / f"{hidden}.html")
        results[hidden] = d
    return results
