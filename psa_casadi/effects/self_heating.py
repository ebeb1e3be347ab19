"""Self-heating: losses warm the stack under fast drive, and its gain changes with the warmth.

The loss is a share of the energy that goes through the capacitance, |u| C_p |u'|; the share,
the heat capacity and the gain's temperature coefficient act as one number, heating_gain.
"""

from psa_casadi.component import Component, Equations, Symbols
from psa_casadi.smooth import rate_magnitude, smooth_magnitude
from psa_casadi.variables import Parameter, State, Values

#: Width of the smooth magnitude of the voltage, over rated voltage.
_WIDTH = 1e-3


def _equations(s: Symbols) -> Equations:
    throughput = smooth_magnitude(s.u, _WIDTH * s.u_rated) * s.C_p * rate_magnitude(s)
    return Equations(
        der={"heat": throughput - s.heat / s.heating_time},
        add={"free_force": s.heating_gain * s.heat * s.k_L * s.u},
    )


def _heat(p: Values) -> float:
    """Heat [J] under one cycle 0 .. u_rated .. 0 a second: C_p u_rated^2 each, at equilibrium."""
    return p["C_p"] * p["u_rated"] ** 2 * p["heating_time"]


def _scale(p: Values) -> float:
    """A gain that changes by 1 % under one full cycle a second."""
    return 0.01 / _heat(p)


SELF_HEATING = Component(
    name="self_heating",
    description="the gain changes as losses warm the stack, and recovers when it rests",
    source=(
        "Zheng, Takahashi, Yoshikawa, Uchino and de Vries, J. Am. Ceram. Soc. 79 (1996) 3193: heat"
        " generation in multilayer actuators"
    ),
    gain="heating_gain",
    equation_text=("f_L gains heating_gain q k_L u,  q' = |u| C_p |u'| - q / heating_time"),
    parameters=(
        Parameter(
            "heating_gain",
            0.0,
            "1/J",
            (0.0, 1e9),
            "growth of the gain per joule of electric energy still felt",
            scale=_scale,
        ),
        Parameter("heating_time", 3.0, "s", (1e-2, 1e5), "time constant of cooling", log=True),
    ),
    states=(State("heat", "J", "energy put through and not cooled off", _heat, memory=True),),
    equations=_equations,
    probe={"heating_time": (1.0, 10.0)},
    looks_like="the gain climbs while the drive is fast and recovers when it rests",
)
