"""Rate-independent asymmetry: the two branches curve differently, equally at every frequency."""

from psa_casadi.component import Component, Equations, Symbols
from psa_casadi.smooth import rate_magnitude
from psa_casadi.variables import Parameter, Values


def _equations(s: Symbols) -> Equations:
    return Equations(add={"hysteresis_rate": s.delta_r * s.u * rate_magnitude(s)})


def _scale(p: Values) -> float:
    return 0.05 * abs(p["k_L"]) / abs(p["u_rated"])


RATE_INDEPENDENT_ASYMMETRY = Component(
    name="rate_independent_asymmetry",
    description="ascending and descending branch curve differently at every frequency",
    source="the paper's asymmetry (eq. 8, delta) made rate-independent: u sgn(u') -> u |u'|",
    gain="delta_r",
    equation_text="f_H' gains delta_r u |u'|",
    parameters=(
        Parameter("delta_r", 0.0, "N/V2", (-1e5, 1e5), "rate-independent asymmetry", scale=_scale),
    ),
    equations=_equations,
    looks_like="the residual differs between rising and falling voltage in the same way at every rate",
)
