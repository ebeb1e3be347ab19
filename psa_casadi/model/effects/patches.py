"""Unnamed corrections as components: generic forms with fitted weights, at a port of the stack.

They are no effects and in no search: a diagnosis offers one where nothing named explains the data,
and writes it on request. Its cause is not known, so that nothing may be concluded from its
parameters; outside of the range of its records it means nothing.
"""

from collections.abc import Callable

import casadi as ca

from psa_casadi.model.component import Component, Equations, Expression, Symbols, effect
from psa_casadi.model.shapes import (
    reading_scale,
    static_stiffness,
    stop_rate,
    stop_rates,
    stroke_scale,
    voltage_scale,
)
from psa_casadi.model.variables import Nominal, Parameter, State

#: Terms of a curve and of one for each direction or over time; play and stop elements; relaxations.
CURVE, BRANCH, ELEMENTS, RELAXATIONS = 24, 8, 10, 16
#: Share of the voltage's range over which a branch changes to the other one.
NARROW = 0.01
GAIN = "patch_gain"
_SOURCE = "a form without a name, fitted to records: Prandtl-Ishlinskii elements, cosines, lags"


def weight(index: int) -> str:
    """Return the name of a weight, counted from 1."""
    return f"patch_w{index}"


def radius(index: int) -> float:
    """Return the threshold of a play over the range of the voltage; `index` counts from 0."""
    return (index + 0.5) / (1.5 * ELEMENTS)


def _weights(s: Symbols, count: int) -> list[Expression]:
    return [getattr(s, weight(k + 1)) for k in range(count)]


def _cosines(s: Symbols, q: Expression, first: int, count: int) -> Expression:
    terms = [w * ca.cos(ca.pi * (first + k) * q) for k, w in enumerate(_weights(s, count))]
    return s.patch_gain * sum(terms)


def _place(s: Symbols, value: Expression) -> Expression:
    return (value - s.patch_low) / (s.patch_high - s.patch_low)


def _curve(s: Symbols, value: Expression) -> Expression:
    return _cosines(s, _place(s, value), 1, CURVE)


def _course(s: Symbols) -> Expression:
    return _cosines(s, s.time / s.patch_time, 1, BRANCH)


def _parameters(count: int, unit: str = "") -> tuple[Parameter, ...]:
    weights = [
        Parameter(
            weight(k + 1), 0.0, "m", (-1.0, 1.0), f"weight of term {k + 1}", scale=reading_scale
        )
        for k in range(count)
    ]
    if not unit:
        return tuple(weights)
    ends = [
        Parameter(f"patch_{end}", value, unit, (-1e6, 1e6), f"{end} end of the records' range",
                  fitted=False)
        for end, value in (("low", 0.0), ("high", 1.0 if unit == "V" else 1e-5))
    ]  # fmt: skip
    return (*ends, *weights)


def _time(name: str, text: str) -> Parameter:
    return Parameter(name, 1.0, "s", (1e-9, 1e9), text, log=True, fitted=False)


_RATIO = Parameter(
    "patch_ratio", 10**0.5, "1", (1.0, 1e3), "from one time constant to the next", fitted=False
)


def _states(count: int, unit: str, scale: Nominal) -> tuple[State, ...]:
    """Return memories; those of a voltage rest at any value."""
    return tuple(
        State(f"z_p{k + 1}", unit, f"element {k + 1}", scale, memory=True, settles=unit != "V")
        for k in range(count)
    )


def _plays(count: int) -> tuple[State, ...]:
    return _states(count, "V", voltage_scale)


#: The corrections by kind and port.
PATCHES: dict[tuple[str, str], Component] = {}


def _patch(
    kind: str, port: str, *variables: Parameter | State
) -> Callable[[Callable[[Symbols], Equations]], Component]:
    """Return the decorator of the correction of a kind at a port, which enters it in the table."""

    def entered(equations: Callable[[Symbols], Equations]) -> Component:
        PATCHES[kind, port] = made = decorator(equations)
        return made

    gain = Parameter(GAIN, 0.0, "1", (0.0, 1.0), "1 with the correction, 0 without", fitted=False)
    decorator = effect(
        gain, *variables, description=f"unnamed correction: {kind} at the {port}", source=_SOURCE,
        belongs_to="sensor" if port == "reading" else "plant",
        looks_like="what no effect of the table describes",
    )  # fmt: skip
    return entered


@_patch("curve", "reading", *_parameters(CURVE, "m"))
def patch_curve_reading(s: Symbols) -> Equations:
    """A curve over the displacement."""
    return Equations(add={"measured_displacement": _curve(s, s.displacement)})


@_patch("curve", "drive voltage", *_parameters(CURVE, "V"))
def patch_curve_drive_voltage(s: Symbols) -> Equations:
    """A curve over the voltage."""
    return Equations(add={"free_force": static_stiffness(s) * _curve(s, s.u)})


@_patch("curve", "force", *_parameters(CURVE, "m"))
def patch_curve_force(s: Symbols) -> Equations:
    """A curve over the displacement that the force would cause at rest."""
    moved = (s.k_L * s.u + s.f_H) / static_stiffness(s)
    return Equations(add={"free_force": static_stiffness(s) * _curve(s, moved)})


@_patch("direction", "force", *_parameters(BRANCH, "V"), *_plays(1))
def patch_direction_force(s: Symbols) -> Equations:
    """Two curves over the voltage, one for either direction."""
    narrow = NARROW * (s.patch_high - s.patch_low)
    curve = _cosines(s, _place(s, s.u), 0, BRANCH)
    return Equations(
        der={"z_p1": stop_rate(s, s.z_p1, narrow)},
        add={"free_force": static_stiffness(s) * s.z_p1 / narrow * curve},
    )


@_patch("memory", "force", *_parameters(3 * ELEMENTS, "V"), *_plays(ELEMENTS))
def patch_memory_force(s: Symbols) -> Equations:
    """Plays of the voltage, their squares and cubes."""
    span, q = s.patch_high - s.patch_low, _place(s, s.u)
    stops, rates = stop_rates(s, "z_p", [radius(k) * span for k in range(ELEMENTS)])
    weights = _weights(s, 3 * ELEMENTS)
    each = zip(*(weights[k * ELEMENTS : (k + 1) * ELEMENTS] for k in range(3)), strict=True)
    total = 0.0
    for (plain, square, cube), z in zip(each, stops, strict=True):
        p = q - z / span
        total += plain * z / span + square * p**2 + cube * p**3
    return Equations(der=rates, add={"free_force": static_stiffness(s) * s.patch_gain * total})


@_patch(
    "relaxation", "force", *_parameters(RELAXATIONS, "m"),
    _time("patch_time", "first time constant"), _RATIO,
    *_states(RELAXATIONS, "m", stroke_scale),
)  # fmt: skip
def patch_relaxation_force(s: Symbols) -> Equations:
    """What lags of first order leave of the displacement."""
    span = s.patch_high - s.patch_low
    lags = [getattr(s, f"z_p{k + 1}") for k in range(RELAXATIONS)]
    x = s.tip_displacement
    total = sum(w * (z - x) for w, z in zip(_weights(s, RELAXATIONS), lags, strict=True))
    return Equations(
        der={
            f"z_p{k + 1}": (x - z) / (s.patch_time * s.patch_ratio**k) for k, z in enumerate(lags)
        },
        add={"displacement": s.patch_gain * total / span},
    )


@_patch("time", "reading", *_parameters(BRANCH), _time("patch_time", "duration"))
def patch_time_reading(s: Symbols) -> Equations:
    """A function of time."""
    return Equations(add={"measured_displacement": _course(s)})


@_patch("gain in time", "force", *_parameters(BRANCH, "m"), _time("patch_time", "duration"))
def patch_gain_in_time_force(s: Symbols) -> Equations:
    """A gain that is a function of time."""
    return Equations(add={"displacement": _place(s, s.tip_displacement) * _course(s)})
