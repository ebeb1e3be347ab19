"""Slow creep: displacement that keeps growing for seconds to hours at constant voltage."""

from psa_casadi.component import Component, Equations, Remedy, Symbols
from psa_casadi.scales import stroke_scale
from psa_casadi.variables import Parameter, State, Values

#: Time constants of the relaxations, as multiples of `creep_time`: a decade apart.
_RATIOS = (1.0, 10.0, 100.0)


def _slow_creep(s: Symbols) -> Equations:
    """Slow creep: displacement that keeps growing for seconds to hours at constant voltage."""
    relaxed = [s.z_c1, s.z_c2, s.z_c3]
    names = ("z_c1", "z_c2", "z_c3")
    return Equations(
        der={
            name: (s.tip_displacement - z) / (s.creep_time * ratio)
            for name, z, ratio in zip(names, relaxed, _RATIOS, strict=True)
        },
        add={"displacement": s.creep_gain * sum(relaxed)},
    )


def _state(index: int) -> State:
    return State(
        f"z_c{index}",
        "m",
        f"elongation relaxed with time constant {_RATIOS[index - 1]:g} creep_time",
        _relaxed_scale,
        display_unit="um",
        memory=True,
    )


def _relaxed_scale(p: Values) -> float:
    return stroke_scale(p)


SLOW_CREEP = Component(
    name="slow_creep",
    description="displacement that keeps growing for seconds to hours at constant voltage",
    source="Croft, Shed and Devasia, J. Dyn. Sys. Meas. Control 123 (2001) 35: relaxations",
    gain="creep_gain",
    equation_text="x_c = creep_gain (z_1 + z_2 + z_3),  creep_time 10^(i-1) z_i' + z_i = x",
    parameters=(
        Parameter(
            "creep_gain",
            0.0,
            "1",
            (0.0, 0.5),
            "creep per decade of time over elongation",
            scale=0.01,
        ),
        Parameter(
            "creep_time", 0.1, "s", (1e-3, 1e4), "fastest time constant of the creep", log=True
        ),
    ),
    states=(_state(1), _state(2), _state(3)),
    equations=_slow_creep,
    probe={"creep_time": (0.03, 0.3, 3.0)},
    remedy=Remedy("wait_or_feed_forward", "hold"),
    looks_like="the residual is a straight line in log time after every change of voltage",
)
