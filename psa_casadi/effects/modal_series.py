"""Modal series: several resonances of the mount, the guide or the load that the stack moves.

Every mode is driven by the force of the wafers and adds its share to the displacement. A residue
that is not in phase with the force, of damping that is not proportional, has a part ahead of it.
There is a component for every number of modes.
"""

from functools import partial

from psa_casadi.component import Component, Equations, Expression, Remedy, Symbols
from psa_casadi.effects.structural_mode import STRUCTURAL_MODE
from psa_casadi.scales import stroke_scale
from psa_casadi.variables import Parameter, State, Values

_TWO_PI = 6.283185307179586
#: Numbers of modes for which there is a component.
FEWEST, MOST = 2, 9


def _modal_series(count: int, s: Symbols) -> Equations:
    """Modal series: several resonances of the mount, the guide or the load that the stack moves.

    Every mode is driven by the force of the wafers and adds its share to the displacement. A
    residue that is not in phase with the force, of damping that is not proportional, has a part
    ahead of it. There is a component for every number of modes.
    """
    der, total, rest = {}, 0.0, s.wafer_force * _compliance(s)
    for k in range(1, count + 1):
        q, rate = getattr(s, f"q_s{k}"), getattr(s, f"r_s{k}")
        omega = _TWO_PI * getattr(s, f"series_frequency_{k}")
        damping = 2.0 * getattr(s, f"series_damping_{k}") * omega
        der[f"q_s{k}"] = rate
        der[f"r_s{k}"] = omega**2 * (rest - q) - damping * rate
        ahead = getattr(s, f"series_ahead_{k}") * rate / omega
        total = total + getattr(s, f"series_share_{k}") * q + ahead
    return Equations(der=der, add={"displacement": s.series_gain * total})


def _compliance(s: Symbols) -> Expression:
    """Return what a force of the wafers moves the output at rest by [m/N]."""
    try:
        return 1.0 / s.k_P + 1.0 / s.k_B
    except AttributeError:  # the single mass
        return 1.0 / s.k


def _rate_scale(k: int, p: Values) -> float:
    return stroke_scale(p) * _TWO_PI * p[f"series_frequency_{k}"]


def _parameters(k: int) -> tuple[Parameter, ...]:
    def share(name: str, value: float, text: str) -> Parameter:
        return Parameter(f"series_{name}_{k}", value, "1", (-1e3, 1e3), text, scale=0.01)

    def positive(name: str, value: float, unit: str, high: float, text: str) -> Parameter:
        return Parameter(f"series_{name}_{k}", value, unit, (1e-4, high), text, log=True)

    return (
        share("share", 0.01, f"static share of mode {k}"),
        share("ahead", 0.0, f"share of mode {k} a quarter period ahead"),
        positive("frequency", 1e3, "Hz", 1e6, f"natural frequency of mode {k}"),
        positive("damping", 0.02, "1", 0.7, f"damping ratio of mode {k}"),
    )


def _states(k: int) -> tuple[State, ...]:
    rate = partial(_rate_scale, k)
    return (
        State(f"q_s{k}", "m", f"displacement of mode {k}", stroke_scale, display_unit="um"),
        State(f"r_s{k}", "m/s", f"velocity of mode {k}", rate, display_unit="um/s"),
    )


def modal_series(count: int) -> Component:
    """Return the component of so many modes; `series_gain` is 1 with them and 0 without."""
    numbers = range(1, count + 1)
    gain = Parameter("series_gain", 0.0, "1", (0.0, 2.0), "1 with the modes", fitted=False)
    return Component(
        name=f"modal_series_{count}",
        description=f"{count} further resonances, of the mount, the guide or the load",
        source="modal superposition; Ewins, Modal Testing, 2nd ed. 2000, ch. 2",
        gain=gain.name,
        equation_text=(
            "q_k'' + 2 zeta_k w_k q_k' + w_k^2 q_k = w_k^2 x_rest,"
            "  x gains sum_k (share_k q_k + ahead_k q_k'/w_k),  w_k = 2 pi frequency_k,"
            "  x_rest: displacement that the wafers' force has at rest"
        ),
        parameters=(gain, *(p for k in numbers for p in _parameters(k))),
        states=tuple(s for k in numbers for s in _states(k)),
        equations=partial(_modal_series, count),
        remedy=Remedy("avoid_resonance", "resonance"),
        looks_like="the residual rings at several tones that are no poles of the stack",
        more_of=STRUCTURAL_MODE.name,
        count=count,
    )


MODAL_SERIES: dict[int, Component] = {n: modal_series(n) for n in range(FEWEST, MOST + 1)}
