"""What the wafers generate: linear force, hysteresis force, and the lag the paper calls creep."""

from psa_casadi.component import Component, Equations, Symbols
from psa_casadi.scales import force_scale
from psa_casadi.smooth import (
    direction,
    magnitude_power,
    rate_magnitude,
    signed_power,
)
from psa_casadi.variables import Parameter, State, Values


def _linear_force(s: Symbols) -> Equations:
    return Equations(add={"free_force": s.k_L * s.u})


def _bouc_wen(s: Symbols) -> Equations:
    ratio = s.f_H / s.h_ref
    rate = (
        s.A * s.voltage_rate
        - s.beta * rate_magnitude(s) * signed_power(ratio, s.n)
        - s.gamma * s.voltage_rate * magnitude_power(ratio, s.n)
        + s.delta * s.u * direction(s)
    )
    return Equations(
        der={"f_H": s.hysteresis_rate},
        add={"hysteresis_rate": rate, "free_force": s.f_H},
        switches={"voltage_reversal": s.voltage_rate},
    )


def _creep_lag(s: Symbols) -> Equations:
    return Equations(der={"f_out": (s.free_force - s.f_out) / s.tau}, add={"wafer_force": s.f_out})


def _hysteresis_scale(p: Values) -> float:
    return abs(p["h_ref"])


def _rate_scale(p: Values) -> float:
    return 0.1 * abs(p["k_L"])


def _delta_scale(p: Values) -> float:
    return 0.05 * abs(p["k_L"])


LINEAR_FORCE = Component(
    name="linear_force",
    description="force proportional to the voltage at the electrodes",
    source="Yang and Zhu 2015, eq. 7 with f_0 = 0",
    equation_text="f_L = k_L u",
    equations=_linear_force,
    parameters=(Parameter("k_L", 10.0, "N/V", (1e-6, 1e6), "linear force per volt", log=True),),
)

#: Of every form of the hysteresis, which rests while the voltage is held.
HOLD_RATE = Parameter(
    "hold_rate",
    0.1,
    "V/s",
    (1e-9, 1e6),
    "voltage rate below which the voltage counts as held",
    fitted=False,
)

BOUC_WEN = Component(
    name="bouc_wen",
    description="asymmetric Bouc-Wen hysteresis force",
    source="Yang and Zhu 2015, eq. 8, read with sgn(u') as its eqs. 28, 31 and 34 require",
    equation_text=(
        "f_H' = A u' - beta |u'| sgn(f_H) (|f_H|/h_ref)^n - gamma u' (|f_H|/h_ref)^n"
        " + delta u sgn(u')"
    ),
    equations=_bouc_wen,
    parameters=(
        Parameter(
            "A", -2.0, "N/V", (-1e5, 1e5), "slope of the hysteresis force", scale=_rate_scale
        ),
        Parameter("beta", 1.0, "N/V", (-1e5, 1e5), "dissipative bend", scale=_rate_scale),
        Parameter("gamma", 0.5, "N/V", (-1e5, 1e5), "elastic bend", scale=_rate_scale),
        Parameter(
            "delta", 0.0, "N/(V.s)", (-1e5, 1e5), "asymmetry of the paper", scale=_delta_scale
        ),
        Parameter("n", 1.2, "1", (1.0, 4.0), "sharpness of the bend", scale=0.5),
        Parameter(
            "h_ref", 100.0, "N", (1e-9, 1e7), "reference force that makes (|f_H|/h_ref)^n pure"
        ),
        HOLD_RATE,
    ),
    states=(State("f_H", "N", "hysteresis force", _hysteresis_scale, memory=True, settles=False),),
)

CREEP_LAG = Component(
    name="creep_lag",
    description="first-order lag of the generated force (the paper's creep)",
    source="Yang and Zhu 2015, eq. 9 in the causal form that its eq. 13 uses",
    equation_text="tau f_out' + f_out = f_L + f_H",
    equations=_creep_lag,
    parameters=(
        Parameter("tau", 1e-4, "s", (1e-7, 1.0), "time constant of the force", "ms", log=True),
    ),
    states=(State("f_out", "N", "force after the lag", force_scale),),
)
