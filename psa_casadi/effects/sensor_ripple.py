"""Sensor ripple: an error of the reading that repeats with the displacement.

A grating, a fringe or a pitch repeats with the period L. Offsets of its two signals make an error
of that period, unequal amplitudes and a phase that is not 90 degrees one of half of it.
"""

from math import pi

import casadi as ca

from psa_casadi.component import (
    DISPLACEMENT_PEAKS,
    Component,
    Equations,
    Expression,
    Remedy,
    Symbols,
)
from psa_casadi.scales import reading_scale
from psa_casadi.variables import Parameter


def _wave(s: Symbols, angle: Expression) -> Expression:
    second = s.ripple_second_cosine * ca.cos(2 * angle) + s.ripple_second_sine * ca.sin(2 * angle)
    return ca.sin(angle + s.ripple_phase) + second


def _sensor_ripple(s: Symbols) -> Equations:
    """Sensor ripple: an error of the reading that repeats with the displacement.

    A grating, a fringe or a pitch repeats with the period L. Offsets of its two signals make an
    error of that period, unequal amplitudes and a phase that is not 90 degrees one of half of it.
    """
    wave = _wave(s, 2 * pi * s.displacement / s.ripple_period)
    return Equations(add={"measured_displacement": s.ripple_gain * (wave - _wave(s, ca.SX(0)))})


def _second(name: str) -> Parameter:
    return Parameter(
        f"ripple_second_{name}",
        0.0,
        "1",
        (-20.0, 20.0),
        f"{name} of half the period, over the ripple",
        scale=0.3,
    )


SENSOR_RIPPLE = Component(
    name="sensor_ripple",
    description="an error of the reading that repeats with the displacement",
    source=(
        "quadrature errors of encoders and interferometers: Heydemann, Applied Optics 20 (1981)"
        " 3382"
    ),
    belongs_to="sensor",
    gain="ripple_gain",
    equation_text=(
        "x_m = x + ripple_gain (w(2 pi x/ripple_period) - w(0)),  w(a) = sin(a + ripple_phase)"
        " + second_cosine cos(2 a) + second_sine sin(2 a)"
    ),
    parameters=(
        Parameter(
            "ripple_gain", 0.0, "m", (-1e-3, 1e-3), "size of the ripple", "um", scale=reading_scale
        ),
        Parameter(
            "ripple_period", 2e-6, "m", (1e-9, 1e-2), "displacement of one period", "um", log=True
        ),
        Parameter(
            "ripple_phase", 0.0, "rad", (-4.0 * pi, 4.0 * pi), "phase at displacement 0", scale=0.3
        ),
        _second("cosine"),
        _second("sine"),
    ),
    equations=_sensor_ripple,
    probe={"ripple_period": DISPLACEMENT_PEAKS, "ripple_phase": (0.0, 0.5 * pi)},
    remedy=Remedy("calibrate_sensor", "range"),
    looks_like="the residual repeats many times over the displacement, the same on both branches",
)
