"""Rate-independent asymmetry: the branches curve differently, equally at every frequency."""

from psa_casadi.component import Component, Equations, Remedy, Symbols
from psa_casadi.smooth import magnitude_power, rate_magnitude
from psa_casadi.variables import Parameter, Values


def _rate_independent_asymmetry(s: Symbols) -> Equations:
    """Rate-independent asymmetry: the branches curve differently, equally at every frequency."""
    bend = s.asymmetry_bend * s.u_rated * magnitude_power(s.f_H / s.h_ref, s.n)
    return Equations(add={"hysteresis_rate": s.delta_r * (s.u + bend) * rate_magnitude(s)})


def _scale(p: Values) -> float:
    return 0.05 * abs(p["k_L"]) / abs(p["u_rated"])


RATE_INDEPENDENT_ASYMMETRY = Component(
    name="rate_independent_asymmetry",
    description="ascending and descending branch curve differently at every frequency",
    source=(
        "the paper's asymmetry (eq. 8, delta) made rate-independent, u sgn(u') -> u |u'|, with the"
        " even term of generalised Bouc-Wen models (Song and Der Kiureghian, J. Eng. Mech. 2006)"
    ),
    gain="delta_r",
    needs=("bouc_wen",),
    equation_text="f_H' gains delta_r |u'| (u + asymmetry_bend u_rated (|f_H|/h_ref)^n)",
    parameters=(
        Parameter("delta_r", 0.0, "N/V2", (-1e5, 1e5), "rate-independent asymmetry", scale=_scale),
        Parameter(
            "asymmetry_bend",
            0.0,
            "1",
            (-100.0, 100.0),
            "share that follows the hysteresis force",
            scale=1.0,
        ),
    ),
    equations=_rate_independent_asymmetry,
    probe={"asymmetry_bend": (-2.0, 0.0, 2.0)},
    remedy=Remedy("undo_hysteresis", "reversal"),
    looks_like=(
        "the residual differs between rising and falling voltage in the same way at every rate"
    ),
)
