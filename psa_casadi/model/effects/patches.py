"""Unnamed corrections as components: generic forms with fitted weights, at a port of the stack.

They are no effects and in no search: a diagnosis offers one where nothing named explains the data,
and writes it on request. Its cause is not known, so that nothing may be concluded from its
parameters; outside of the range of its records it means nothing.
"""

from collections.abc import Callable, Mapping

import casadi as ca

from psa_casadi.model.component import Component, Equations, Expression, Symbols
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
_Equations = Callable[[Symbols], Equations]
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


def _moved(s: Symbols) -> Expression:
    return (s.k_L * s.u + s.f_H) / static_stiffness(s)


def _adding(balance: str, term: Callable[[Symbols], Expression]) -> _Equations:
    """Return the equations that add one term to a balance."""
    return lambda s: Equations(add={balance: term(s)})


def _direction(s: Symbols) -> Equations:
    narrow = NARROW * (s.patch_high - s.patch_low)
    curve = _cosines(s, _place(s, s.u), 0, BRANCH)
    return Equations(
        der={"z_p1": stop_rate(s, s.z_p1, narrow)},
        add={"free_force": static_stiffness(s) * s.z_p1 / narrow * curve},
    )


def _memory(s: Symbols) -> Equations:
    span, q = s.patch_high - s.patch_low, _place(s, s.u)
    stops, rates = stop_rates(s, "z_p", [radius(k) * span for k in range(ELEMENTS)])
    weights = _weights(s, 3 * ELEMENTS)
    each = zip(*(weights[k * ELEMENTS : (k + 1) * ELEMENTS] for k in range(3)), strict=True)
    total = 0.0
    for (plain, square, cube), z in zip(each, stops, strict=True):
        p = q - z / span
        total += plain * z / span + square * p**2 + cube * p**3
    return Equations(der=rates, add={"free_force": static_stiffness(s) * s.patch_gain * total})


def _relaxation(s: Symbols) -> Equations:
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


def _parameters(count: int, unit: str = "") -> tuple[Parameter, ...]:
    gain = Parameter(GAIN, 0.0, "1", (0.0, 1.0), "1 with the correction, 0 without", fitted=False)
    weights = [
        Parameter(
            weight(k + 1), 0.0, "m", (-1.0, 1.0), f"weight of term {k + 1}", scale=reading_scale
        )
        for k in range(count)
    ]
    if not unit:
        return (gain, *weights)
    ends = [
        Parameter(f"patch_{end}", value, unit, (-1e6, 1e6), f"{end} end of the records' range",
                  fitted=False)
        for end, value in (("low", 0.0), ("high", 1.0 if unit == "V" else 1e-5))
    ]  # fmt: skip
    return (gain, *ends, *weights)


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


def _patch(
    kind: str,
    port: str,
    equations: _Equations,
    parameters: tuple[Parameter, ...],
    states: tuple[State, ...] = (),
) -> tuple[tuple[str, str], Component]:
    component = Component(
        name=f"patch_{kind}_{port}".replace(" ", "_"),
        description=f"unnamed correction: {kind} at the {port}",
        source=_SOURCE,
        gain=GAIN,
        parameters=parameters,
        states=states,
        equations=equations,
        belongs_to="sensor" if port == "reading" else "plant",
        looks_like="what no effect of the table describes",
    )
    return (kind, port), component


_LAGS = (*_parameters(RELAXATIONS, "m"), _time("patch_time", "first time constant"), _RATIO)
_PLAYS = _states(ELEMENTS, "V", voltage_scale)
_BEHIND = _states(RELAXATIONS, "m", stroke_scale)
_DURATION = _time("patch_time", "duration")
_ON_READING = _adding("measured_displacement", lambda s: _curve(s, s.displacement))
_ON_VOLTAGE = _adding("free_force", lambda s: static_stiffness(s) * _curve(s, s.u))
_ON_FORCE = _adding("free_force", lambda s: static_stiffness(s) * _curve(s, _moved(s)))
_IN_TIME = _adding("measured_displacement", _course)
_GAIN_IN_TIME = _adding("displacement", lambda s: _place(s, s.tip_displacement) * _course(s))
#: The corrections by kind and port.
PATCHES: Mapping[tuple[str, str], Component] = dict(
    (
        _patch("curve", "reading", _ON_READING, _parameters(CURVE, "m")),
        _patch("curve", "drive voltage", _ON_VOLTAGE, _parameters(CURVE, "V")),
        _patch("curve", "force", _ON_FORCE, _parameters(CURVE, "m")),
        _patch("direction", "force", _direction, _parameters(BRANCH, "V"), _PLAYS[:1]),
        _patch("memory", "force", _memory, _parameters(3 * ELEMENTS, "V"), _PLAYS),
        _patch("relaxation", "force", _relaxation, _LAGS, _BEHIND),
        _patch("time", "reading", _IN_TIME, (*_parameters(BRANCH), _DURATION)),
        _patch("gain in time", "force", _GAIN_IN_TIME, (*_parameters(BRANCH, "m"), _DURATION)),
    )
)
