"""The symbolic model against the paper's equations in plain NumPy: two programs, one answer."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from math import cos, exp, pi, sin

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi import reference
from psa_casadi.reference import Mechanics
from tests.tiers import slow_but

#: Samples of the stepper's input, linear in between; a sine's error between them is 5e-9 of it.
SAMPLES = 30001
#: The paths take this long [s], or five times the stack's lag.
SHORTEST, LAGS = 2e-3, 5.0
FORCE = 0.05


@dataclass(frozen=True)
class Drive:
    """A voltage in units of the rated one; its kinks and jumps in units of the duration."""

    name: str
    shape: Callable[[float], float]
    breakpoints: tuple[float, ...] = ()
    hold: str = "linear"


def _sine(s: float) -> float:
    return 0.4 * (1.0 - cos(3 * pi * s))


def _triangle(s: float) -> float:
    return 0.8 * (1.0 - abs(2.0 * ((1.5 * s) % 1.0) - 1.0)) - 0.1 * s


def _step(s: float) -> float:
    return 0.6 if s < 0.4 else -0.1 if s < 0.7 else 0.35


def _multisine(s: float) -> float:
    tones = ((1, 0.3), (2, 1.9), (3, 4.4), (5, 2.2))
    return 0.3 + 0.12 * sum(sin(2 * pi * k * s + phase) for k, phase in tones)


def _wander(s: float) -> float:
    """A chirp on a bend that never comes back."""
    return 0.3 * s**2 + 0.25 * s * sin(2.0 + 9.0 * float(s**1.5)) + 0.3 * exp(-3.0 * s)


DRIVES = (
    Drive("sine", _sine),
    Drive("triangle", _triangle, (1 / 3, 2 / 3)),
    Drive("step", _step, (0.4, 0.7), hold="zero"),
    Drive("multisine", _multisine),
    Drive("non_periodic", _wander),
)


def stack_values(stack: str, mechanics: Mechanics) -> dict[str, float]:
    """Return a named stack's values; for the single mass, both masses on springs in series."""
    p = {name: figure.value for name, figure in psa.STACKS[stack].values.items()}
    if mechanics == "single_mass":
        k = 1 / (1 / p["k_P"] + 1 / p["k_B"])
        p |= {"m": p["m_P"] + p["m_B"], "k": k, "c": p["c_B"]}
        for name in ("m_P", "c_P", "k_P", "m_B", "c_B", "k_B"):
            del p[name]
    return p


#: Every stack with one voltage of its own, and every voltage.
ONCE = [(s, "cascade", d) for s, d in zip(sorted(psa.STACKS), DRIVES, strict=True)]
ONCE += [("P-885.51", "single_mass", DRIVES[0])]
#: Any two of stack, mechanics and voltage.
IN_TURN = [
    (stack, ("cascade", "single_mass")[(k + j) % 2], drive)
    for (k, stack), (j, drive) in product(enumerate(sorted(psa.STACKS)), enumerate(DRIVES))
]
AGREEMENTS = [*ONCE, *(case for case in IN_TURN if case not in ONCE)]


@pytest.mark.parametrize(
    ("stack", "mechanics", "drive"),
    slow_but(ONCE, AGREEMENTS),
    ids=[f"{stack}-{mechanics}-{drive.name}" for stack, mechanics, drive in AGREEMENTS],
)
def test_displacement_agrees_with_the_reference(
    stack: str, mechanics: Mechanics, drive: Drive
) -> None:
    p = stack_values(stack, mechanics)
    model = psa.compose(psa.BASE if mechanics == "cascade" else psa.SIMPLIFIED, p)
    size, force = p["u_rated"], FORCE * p["k_L"] * p["u_rated"]
    duration = max(SHORTEST, LAGS * p["tau"])
    t = np.linspace(0.0, duration, SAMPLES)
    samples = [size * drive.shape(k / (SAMPLES - 1)) for k in range(SAMPLES)]

    def voltage(time: float) -> float:
        return size * drive.shape(time / duration)

    def load(time: float) -> float:
        return force * sin(7.0 * time / duration) if drive.hold == "linear" else 0.0

    found = psa.simulate(
        model, t, samples, load_force=[load(s) for s in t],
        from_rest_at_zero=True, rtol=1e-8, hold=drive.hold,
    )  # fmt: skip
    every = slice(None, None, 60)
    true = reference.simulate(
        p, voltage, t[every], load_force=load, mechanics=mechanics,
        breakpoints=[b * duration for b in drive.breakpoints], rtol=1e-10,
    )  # fmt: skip
    error = np.abs(found.outputs["displacement"][every] - true.displacement).max()
    assert error < 1e-6 * np.ptp(true.displacement)
    for name, wanted in (
        ("velocity", true.velocity),
        ("charge", true.charge),
        ("blocked_force", true.blocked_force),
    ):
        difference = np.abs(found.outputs[name][every] - wanted).max()
        assert difference < 1e-5 * np.ptp(wanted), name
