"""A prestress mechanism as feedback around the mechanics of a stack, in closed form.

With the stack's mechanics `X/F = N/D` (paper eq. 10) and the mechanism `H = m s^2 + c s + k`::

    X/U = k_L/(tau s + 1) * N/(D + M H)                                  (45), small signals

`M = N` where the mechanism acts as the paper draws it, around all of G_P: its force adds to that of
the wafers. `M = a`, the wafers' polynomial, where it pushes on the output mass only; in the paper's
one-way cascade it then moves the bonding layers' poles and leaves the wafers' alone. Source: Yang
and Zhu 2015, eqs. 10, 44, 45; eqs. 39 to 43 print m_P/4 for two different masses, a misprint.
"""

from dataclasses import dataclass

import numpy as np

from psa_casadi.common.errors import InputError
from psa_casadi.common.units import ComplexArray, FloatArray
from psa_casadi.model.compose import Model

#: Where a mechanism acts.
ACTS_ON = ("wafers", "tip")


@dataclass(frozen=True)
class Mechanics:
    """The linear mechanics of a stack, and what precedes it.

    Polynomials, highest power first: `numerator` N, `denominator` D [N/m], and `path` M. `lag` is
    tau and `drive` R_s C_p [s]; `force` is k_L u_rated [N].
    """

    numerator: FloatArray
    denominator: FloatArray
    path: FloatArray
    lag: float
    drive: float
    force: float

    @property
    def stiffness(self) -> float:
        """Static force per displacement at the wafers, D(0)/N(0) [N/m]."""
        return float(self.denominator[-1] / self.numerator[-1])

    @property
    def stroke(self) -> float:
        """Linear displacement at rated voltage without a mechanism [m]."""
        return self.force / self.stiffness

    @property
    def frequency(self) -> float:
        """Geometric mean of the poles' magnitudes [rad/s]."""
        order = len(self.denominator) - 1
        return float((self.denominator[-1] / self.denominator[0]) ** (1.0 / order))


@dataclass(frozen=True)
class Mounting:
    """A mechanism: mass [kg], damping [N.s/m], stiffness [N/m]."""

    mass: float
    damping: float
    stiffness: float

    @property
    def polynomial(self) -> FloatArray:
        """H(s), highest power first."""
        return np.array([self.mass, self.damping, self.stiffness])


def mechanics_of(model: Model, acts_on: str = "wafers") -> Mechanics:
    """Return the linear mechanics of a stack; of its effects only the reciprocal coupling counts.

    Raises InputError if the model has not the mechanics of the paper, or `acts_on` is unknown.
    """
    if acts_on not in ACTS_ON:
        raise InputError(
            f"A mechanism cannot act on '{acts_on}'; choose {' or '.join(ACTS_ON)}: around all of"
            " the stack's mechanics as in the paper, or on the output mass only."
        )
    names = {c.name for c in model.components}
    if not names >= {"cascade_mechanics", "creep_lag", "linear_force", "drive"}:
        raise InputError(
            f"The model '{model.name}' has not the two masses of the paper's stack (drive,"
            " linear_force, creep_lag, cascade_mechanics); give a stack that `psa identify` wrote,"
            " or --stack NAME."
        )
    p = model.values
    g = p.get("reciprocal_gain", 0.0)  # share of the reaction on the wafers, 0: the paper
    a = np.array([p["m_P"], p["c_P"] + g * p["c_B"], p["k_P"] + g * p["k_B"]])
    b = np.array([p["m_B"], p["c_B"], p["k_B"]])
    n = np.array([p["c_B"] + (1.0 - g) * p["c_P"], p["k_B"] + (1.0 - g) * p["k_P"]])
    back = g * np.array([p["c_B"], p["k_B"]])
    return Mechanics(
        numerator=n,
        denominator=np.polysub(np.polymul(a, b), np.polymul(back, n)),
        path=n if acts_on == "wafers" else a,
        lag=p["tau"],
        drive=p["R_s"] * p["C_p"],
        force=abs(p["k_L"]) * p["u_rated"],
    )


def closed_polynomial(mechanics: Mechanics, mounting: Mounting) -> FloatArray:
    """Return D + M H, highest power first."""
    return np.polyadd(mechanics.denominator, np.polymul(mechanics.path, mounting.polynomial))


def mechanical_poles(mechanics: Mechanics, mounting: Mounting) -> ComplexArray:
    """Return the roots of D + M H [rad/s], slowest first."""
    unit = mechanics.frequency
    scaled = in_units(closed_polynomial(mechanics, mounting), unit)
    roots = np.asarray(np.roots(scaled / np.max(np.abs(scaled))) * unit, dtype=np.complex128)
    return roots[np.argsort(np.abs(roots), kind="stable")]


def in_units(polynomial: FloatArray, unit: float) -> FloatArray:
    """Return a polynomial in s over a unit [rad/s], so that its coefficients are of one size."""
    powers = np.arange(len(polynomial) - 1, -1, -1)
    return np.asarray(polynomial * unit**powers, dtype=np.float64)


def damping_ratios(poles: ComplexArray) -> FloatArray:
    """Return -Re(s)/|s| of each pole: 1 for a real one, negative for an unstable one."""
    return np.asarray(-poles.real / np.abs(poles), dtype=np.float64)


def stroke_loss(mechanics: Mechanics, mounting: Mounting) -> float:
    """Return the share of the static stroke that the mechanism's stiffness takes."""
    held = mechanics.path[-1] * mounting.stiffness
    return float(held / (mechanics.denominator[-1] + held))


def bandwidth(mechanics: Mechanics, mounting: Mounting, *, whole: bool = False) -> float:
    """Return the first frequency [Hz] at which |X/F| is 3 dB below its static value.

    `whole` takes X/V with lag and drive instead, from the command to the displacement.
    """
    below: FloatArray = closed_polynomial(mechanics, mounting)
    if whole:
        for time in (mechanics.lag, mechanics.drive):
            below = np.asarray(np.polymul(below, [time, 1.0]), dtype=np.float64)
    unit = mechanics.frequency
    ratio = mechanics.numerator / mechanics.numerator[-1], below / below[-1]
    # |n|^2 - |d|^2/2 is a polynomial in w^2: its smallest positive root
    top, bottom = (_squared_magnitude(r, unit) for r in ratio)
    roots = np.roots(np.polysub(2.0 * top, bottom))
    real = roots.real[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0.0)]
    return float(np.sqrt(real.min()) * unit / (2.0 * np.pi)) if real.size else float("inf")


def _squared_magnitude(polynomial: FloatArray, unit: float) -> FloatArray:
    """|p(i w unit)|^2 as a polynomial in w^2, highest power first."""
    product = np.polymul(in_units(polynomial, unit), in_units(polynomial, -unit))  # even in s
    even = product[::-2][::-1]
    signs = (-1.0) ** np.arange(len(even) - 1, -1, -1)
    return np.asarray(even * signs, dtype=np.float64)


@dataclass(frozen=True)
class Response:
    """Step of the rated voltage: times (n,) [s], displacement [m], mechanism's force [N]."""

    time: FloatArray
    displacement: FloatArray
    force: FloatArray


def step_response(mechanics: Mechanics, mounting: Mounting, time: FloatArray) -> Response:
    """Return the linear answer to a step of the rated voltage, by partial fractions.

    `x(t) = sum_i R_i (e^(s_i t) - 1)/s_i` over the poles s_i of (45), with the drive's pole
    -1/(R_s C_p). `force` is `m x'' + c x' + k x`, what the mechanism takes. Poles must be simple;
    equal ones are taken apart by a millionth.
    """
    poles = [*mechanical_poles(mechanics, mounting), -1.0 / mechanics.lag, -1.0 / mechanics.drive]
    gain = mechanics.force / (closed_polynomial(mechanics, mounting)[0] * mechanics.lag)
    gain /= mechanics.drive
    s = _simple(np.array(poles, dtype=np.complex128))
    motion = np.zeros((3, len(time)))
    for i, pole in enumerate(s):
        residue = gain * np.polyval(mechanics.numerator, pole) / np.prod(pole - np.delete(s, i))
        growth = np.exp(pole * time)
        motion[0] += (residue * np.expm1(pole * time) / pole).real
        motion[1] += (residue * growth).real
        motion[2] += (residue * pole * growth).real
    force = mounting.polynomial[::-1] @ motion
    return Response(time, motion[0], force)


def _simple(poles: ComplexArray) -> ComplexArray:
    """Take poles that are equal to a millionth apart, so that partial fractions exist."""
    apart = poles.copy()
    for i in range(1, len(apart)):
        while np.any(np.abs(apart[i] - apart[:i]) < 1e-6 * np.abs(apart[i])):
            apart[i] *= 1.0 + 2e-6
    return apart


def response_times(mechanics: Mechanics, mounting: Mounting, count: int = 2000) -> FloatArray:
    """Return times [s] from 0 on that show the step until it has settled, dense at its start."""
    poles = [*mechanical_poles(mechanics, mounting), -1.0 / mechanics.lag, -1.0 / mechanics.drive]
    rates = np.array([-p.real for p in poles])
    slow, fast = 8.0 / max(rates.min(), 1e-12), 0.05 / max(np.abs(poles).max(), 1e-12)
    start = np.geomspace(max(fast, 1e-6 * slow), slow, count // 2)
    return np.union1d(np.linspace(0.0, slow, count // 2), start)
