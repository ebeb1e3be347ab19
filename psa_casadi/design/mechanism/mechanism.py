"""Design a prestress mechanism: mass, damping and stiffness for wanted dynamics (paper 5.2).

The search is a nonlinear programme with exact derivatives, from several starts, in units of the
stack: time 1/w0 (`Mechanics.frequency`), stiffness `K = D(0)/M(0)`. The unknowns are mass, damping
and stiffness (mu, chi, kappa) and, in logarithms, the natural frequency w_i and damping ratio z_i
of every pair of mechanical poles, tied to the mechanism by

    D + M H = lead * prod_i (s^2 + 2 z_i w_i s + w_i^2)

so that a pair that turns from complex to real has no kink, and an unstable loop does not exist. One
more unknown is the frequency w_b below which |X/F| stays above -3 dB of its static value. IPOPT
takes the derivatives from CasADi. The shortfall of a goal that the limits do not allow is as small
as possible: in logarithms, it is an unknown with a steep cost.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import permutations
from math import inf, isfinite, log, sqrt
from typing import Any

import casadi as ca
import numpy as np

from psa_casadi.common.errors import InputError, Problems
from psa_casadi.common.interruption import raise_if_stopped
from psa_casadi.common.units import ComplexArray, FloatArray
from psa_casadi.design.mechanism.loop import (
    Mechanics,
    Mounting,
    bandwidth,
    damping_ratios,
    in_units,
    mechanical_poles,
    mechanics_of,
    response_times,
    step_response,
    stroke_loss,
)
from psa_casadi.model.components.surroundings import (
    PRESTRESS_MOUNTS,
    prestress_mechanism,
    prestress_port,
)
from psa_casadi.model.compose import Model, compose
from psa_casadi.model.variables import Provenance


def product(a: Any, b: Any) -> Any:
    """Product of two polynomials in CasADi, highest power first."""
    a, b = ca.vertcat(a), ca.vertcat(b)
    last = a.numel() - 1
    return sum(ca.vertcat(*[0.0] * i, a[i] * b, *[0.0] * (last - i)) for i in range(last + 1))


def total(a: Any, b: Any) -> Any:
    """Sum of two polynomials in CasADi, highest power first."""
    size = max(a.numel(), b.numel())
    return ca.vertcat(*[0.0] * (size - a.numel()), a) + ca.vertcat(*[0.0] * (size - b.numel()), b)


def log_square(polynomial: Any, w: Any) -> Any:
    """Return ln |p(i w)|^2 of a polynomial, highest power first."""
    real, imaginary = 0.0, 0.0
    for k in range(polynomial.numel()):
        real, imaginary = -w * imaginary + polynomial[k], w * real
    return ca.log(real * real + imaginary * imaginary)


#: Steps of the answer: the step size doubles from phase to phase.
_PHASES, _STEPS = 14, 10
#: Parts of w_b at which |X/F| is held above -3 dB, and the cost of a shortfall.
_PARTS = np.linspace(0.05, 1.0, 20)
_STEEP = 100.0
#: The force is held below this share of its limit, since it is looked at in steps.
_MARGIN = 0.998
#: Cost of mass, damping and stiffness: of two equal designs the smaller one.
_SMALL = 1e-7
_OPTIONS: dict[str, Any] = {
    "print_time": False,
    "ipopt": {"print_level": 0, "sb": "yes", "max_iter": 300},
}


@dataclass(frozen=True)
class Limits:
    """What a mechanism may cost.

    `stroke_loss`: largest share of the static stroke [1]; `force`: largest force in the mechanism
    in a step of rated voltage [N]; `mass` [kg] and `damping` [N.s/m]: least and largest.
    """

    stroke_loss: float = 0.1
    force: float | None = None
    mass: tuple[float, float] = (0.0, 1.0)
    damping: tuple[float, float] = (0.0, 1e5)


@dataclass(frozen=True)
class Wish:
    """What is wanted, SI: least damping ratio, least bandwidth [Hz], or poles [rad/s]; limits.

    `starts` are those of the search. Raises an InputError that names everything that makes no
    sense.
    """

    damping: float | None
    bandwidth: float | None
    poles: Sequence[complex]
    limits: Limits
    starts: int

    def __post_init__(self) -> None:
        problems, damping, width = Problems(), self.damping, self.bandwidth
        if self.poles and (damping is not None or width is not None):
            problems.add(
                "Poles are wanted together with a damping or a bandwidth; leave one of them out."
            )
        if not self.poles and damping is None and width is None:
            problems.add("Nothing is wanted; give a damping ratio, a bandwidth in Hz, or poles.")
        if damping is not None and not 0.0 < damping <= 1.0:
            problems.add(f"The damping ratio {damping:g} is not in (0, 1]; 0.7 is usual.")
        if width is not None and not 0.0 < width < inf:
            problems.add(f"The bandwidth {width:g} Hz is not positive; give it in Hz.")
        _check_poles(self.poles, problems)
        _check_limits(self.limits, problems)
        if self.starts < 1:
            problems.add(f"{self.starts} starts find nothing; give 1 or more.")
        problems.raise_if_any()


def _check_poles(poles: Sequence[complex], problems: Problems) -> None:
    if not all(isfinite(p.real) and isfinite(p.imag) and p.real < 0.0 for p in poles):
        problems.add("A wanted pole has no negative real part; a mounted stack must be stable.")
    for p in poles:
        if p.imag and not any(abs(q - p.conjugate()) < 1e-9 * abs(p) for q in poles):
            problems.add(f"The wanted pole {p:.5g} comes without its conjugate; add it.")
    if len(poles) not in (0, 2, 4):
        problems.add(
            f"{len(poles)} poles are wanted; give one or two pairs: two or four poles in rad/s."
        )
    elif sum(p.imag == 0.0 for p in poles) % 2:
        problems.add("A real pole is wanted alone; real poles come in pairs too.")


def _check_limits(limits: Limits, problems: Problems) -> None:
    if not 0.0 <= limits.stroke_loss < 1.0:
        problems.add(
            f"The largest stroke loss is {limits.stroke_loss:g}; give a share of the stroke from 0"
            " up to, not including, 1."
        )
    if limits.force is not None and not 0.0 < limits.force < inf:
        problems.add(
            f"The largest force is {limits.force:g} N; give a positive one, or leave it out."
        )
    ranges = {"mass": (*limits.mass, "kg"), "damping": (*limits.damping, "N.s/m")}
    for what, (low, high, unit) in ranges.items():
        if not 0.0 <= low < high < inf:
            problems.add(
                f"The {what} may lie between {low:g} and {high:g} {unit}, which is no range; give"
                " a least value of 0 or more and a larger one."
            )


@dataclass(frozen=True)
class Candidate:
    """What one start led to: the mechanism, its cost, and whether the search ended well."""

    mounting: Mounting
    cost: float
    converged: bool


def search(mechanics: Mechanics, wish: Wish) -> list[Candidate]:
    """Search from several starts, and return what each led to, best first."""
    draw = np.random.default_rng(0)
    count, candidates = (len(mechanics.denominator) - 1) // 2, []
    # which pair of the stack's poles each wanted pair may become
    for order in permutations(range(count), len(pairs_of(wish.poles))):
        problem = _Problem(mechanics, wish, order)
        candidates += [problem.solve(draw) for _ in range(wish.starts)]
    return sorted(candidates, key=lambda c: (not c.converged, c.cost))


class _Problem:
    """The programme for one assignment of wanted pairs to pairs of poles."""

    def __init__(self, mechanics: Mechanics, wish: Wish, order: tuple[int, ...]) -> None:
        self.mechanics, self.wish, self.order = mechanics, wish, order
        self.w0 = w0 = mechanics.frequency
        self.K = float(mechanics.denominator[-1] / mechanics.path[-1])
        self.count = count = (len(mechanics.denominator) - 1) // 2
        polynomials = (mechanics.numerator, mechanics.denominator, mechanics.path)
        n, d, m = (in_units(p, w0) / p[-1] for p in polynomials)
        self.h, self.lw, self.lz = (ca.MX.sym(*q) for q in (("h", 3), ("w", count), ("z", count)))
        self.b, self.least, self.short = (ca.MX.sym(q) for q in ("b", "least", "short"))
        closed = total(ca.MX(ca.DM(d)), product(ca.MX(ca.DM(m)), self.h))
        # the closed polynomial's coefficients are those of the product of pairs
        pairs = closed[0]
        for i in range(count):
            w, z = ca.exp(self.lw[i]), ca.exp(self.lz[i])
            pairs = product(pairs, ca.vertcat(1.0, 2.0 * z * w, w * w))
        equal = pairs[1:] / closed[1:] - 1.0
        # |N/(D + M H)| over its static value is above 1/sqrt(2) up to w_b
        self.positive: list[Any] = []
        for part in _PARTS:
            w = part * ca.exp(self.b)
            above = log_square(ca.MX(ca.DM(n)), w) - log_square(closed, w)
            self.positive.append(above + 2.0 * ca.log(closed[-1]) + log(2.0))
        # |m x'' + c x' + k x| stays below the limit in the answer to a step of rated voltage
        if wish.limits.force is not None:
            largest = mechanics.force * self.K / mechanics.stiffness
            limit = _MARGIN * wish.limits.force / largest
            for force in self._force_history(closed[-1], float(n[0] / n[1])):
                self.positive += [limit - force, limit + force]
        cost = self._cost()
        x = ca.vertcat(self.h, self.lw, self.lz, self.b, self.least, self.short)
        g = ca.vertcat(equal, *self.positive)
        self.rows = equal.numel(), g.numel() - equal.numel()
        programme: dict[str, Any] = {"x": x, "f": cost, "g": g}
        self.solver = ca.nlpsol("mechanism", "ipopt", programme, _OPTIONS)

    def _force_history(self, static: Any, ahead: float) -> list[Any]:
        """Return the mechanism's force over k_L u_rated K N(0)/D(0) at every step.

        The chain drive, lag, pairs of poles is stepped with the method of Radau (order 3,
        L-stable): `z+ = (1 - 2/3 hA + h^2 A^2/6)^-1 (1 + hA/3) z`, z measured from its final value.
        `static` is 1 + kappa, `ahead` the numerator's s coefficient over its constant.
        """
        lag, drive = self.mechanics.lag * self.w0, self.mechanics.drive * self.w0
        size, last = 2 + 2 * self.count, 1
        A = ca.MX.zeros(size, size)
        A[0, 0] = -1.0 / drive
        A[1, 0], A[1, 1] = 1.0 / lag, -1.0 / lag
        for i in range(self.count):
            at, w, z = 2 + 2 * i, ca.exp(self.lw)[i], ca.exp(self.lz)[i]
            A[at, at + 1] = 1.0
            A[at + 1, last], A[at + 1, at], A[at + 1, at + 1] = w * w, -w * w, -2.0 * z * w
            last = at
        away: Any = -ca.vertcat(1.0, 1.0, *[1.0, 0.0] * self.count)
        row = ca.DM.zeros(1, size)
        row[last] = 1.0
        derivatives = [ca.MX(row)]
        for _ in range(3):
            derivatives.append(derivatives[-1] @ A)
        mu, chi, kappa = self.h[0], self.h[1], self.h[2]
        read = sum(
            weight * (derivatives[k] + ahead * derivatives[k + 1])
            for k, weight in enumerate((kappa, chi, mu))
        )
        h = 60.0 * max(lag, drive) / (_STEPS * (2.0**_PHASES - 1.0))
        history, unit = [], ca.DM.eye(size)
        for _ in range(_PHASES):
            step = ca.solve(unit - 2.0 / 3.0 * h * A + h * h / 6.0 * (A @ A), unit + h / 3.0 * A)
            for _ in range(_STEPS):
                away = step @ away
                history.append((kappa + read @ away) / static)
            h *= 2.0
        return history

    def _cost(self) -> Any:
        wish, lz = self.wish, self.lz
        cost = _STEEP * self.short + _SMALL * ca.sum1(self.h)
        if wish.poles:
            for (w, z), i in zip(pairs_of(wish.poles), self.order, strict=True):
                cost += (self.lw[i] - log(w / self.w0)) ** 2 + (lz[i] - log(z)) ** 2
            return cost
        if wish.damping is not None:
            self.positive.append(lz - log(wish.damping) + self.short)
        else:
            self.positive.append(lz - self.least)
            cost -= self.least
        if wish.bandwidth is not None:
            wanted = log(2.0 * np.pi * wish.bandwidth / self.w0)
            self.positive.append(self.b - wanted + self.short)
        else:
            cost -= self.b
        return cost

    def solve(self, draw: np.random.Generator) -> Candidate:
        """Search from one random start."""
        limits, unit = self.wish.limits, (self.K / self.w0**2, self.K / self.w0, self.K)
        most = limits.stroke_loss / (1.0 - limits.stroke_loss)
        low = [limits.mass[0] / unit[0], limits.damping[0] / unit[1], 0.0]
        high = [limits.mass[1] / unit[0], limits.damping[1] / unit[1], most]
        sizes = (*np.exp(draw.uniform(log(1e-2), log(30.0), 2)), most * draw.uniform(0.05, 0.95))
        start = np.clip(sizes, low, high)
        mounting = Mounting(*(float(s * u) for s, u in zip(start, unit, strict=True)))
        poles = pairs_of(mechanical_poles(self.mechanics, mounting) / self.w0)
        w, z = np.array(sorted(poles, key=lambda pair: pair[0])).T
        z = np.maximum(z, 1e-3)  # unstable ones are damped
        x0 = [*start, *np.log(w), *np.log(z), min(np.log(w).min(), 3.0), min(0.0, log(min(z))), 0.0]
        few = [-25.0] * self.count, [25.0] * self.count
        solution = self.solver(
            x0=x0,
            lbx=[*low, *few[0], *[log(1e-4)] * self.count, -25.0, -12.0, 0.0],
            ubx=[*high, *few[1], *[log(1e5)] * self.count, 25.0, 0.0, 50.0],
            lbg=[0.0] * sum(self.rows),
            ubg=[0.0] * self.rows[0] + [np.inf] * self.rows[1],
        )
        raise_if_stopped()  # which the solver takes for a failure
        h = np.clip(np.array(solution["x"]).ravel()[:3], low, high)
        cost = float(solution["f"])
        ended = bool(self.solver.stats()["success"]) and isfinite(cost)
        values = (float(a * u) for a, u in zip(h, unit, strict=True))
        return Candidate(Mounting(*values), cost, ended)


def pairs_of(poles: Iterable[complex]) -> list[tuple[float, float]]:
    """Return natural frequency and damping ratio of poles paired off: conjugates, then real ones.

    Real poles are paired with their neighbours in size.
    """
    every = list(poles)
    pairs = [(float(abs(p)), -2.0 * p.real) for p in every if p.imag > 1e-9 * abs(p)]
    real = sorted(p.real for p in every if abs(p.imag) <= 1e-9 * abs(p))
    pairs += [(sqrt(abs(a * b)), -(a + b)) for a, b in zip(real[::2], real[1::2], strict=True)]
    return [(w, float(both) / (2.0 * w)) for w, both in pairs]


_LIMITS = Limits()
#: A goal counts as reached if the shortfall is less than this share.
_REACHED = 1e-3
#: A wanted pole counts as reached if one lies within this share of its size.
_NEAR = 1e-2
#: Starts that lead to costs within this difference led to the same design.
_SAME = 1e-3


@dataclass(frozen=True)
class Reached:
    """What a mounted stack does: least damping ratio of its mechanical poles, bandwidths [Hz].

    `bandwidth` is that of X/F, `whole_bandwidth` that of X/V with lag and amplifier; `stroke_loss`
    [1]; `peak_force` [N] and `overshoot` [1] in a step of rated voltage.
    """

    damping: float
    bandwidth: float
    whole_bandwidth: float
    stroke_loss: float
    peak_force: float
    overshoot: float


@dataclass(frozen=True)
class MechanismDesign:
    """A designed mechanism, what was wanted, and what is reached without it and with it.

    `poles` and `free_poles` [rad/s] are those of the mechanics, slowest first; `lag_pole` is -1/tau
    [rad/s], which no mechanism moves. `attained`: every goal is reached within limits;
    `binding` names the limits that the design reaches. `agreeing` of `starts` searches led here.
    """

    mechanics: Mechanics
    mounting: Mounting
    acts_on: str
    goals: tuple[str, ...]
    limits: Limits
    poles: ComplexArray
    free_poles: ComplexArray
    lag_pole: float
    reached: Reached
    free: Reached
    attained: bool
    binding: tuple[str, ...]
    agreeing: int
    starts: int


def design_mechanism(
    model: Model,
    *,
    damping: float | None = None,
    bandwidth: float | None = None,
    poles: Sequence[complex] = (),
    limits: Limits = _LIMITS,
    acts_on: str = "wafers",
    starts: int = 6,
) -> MechanismDesign:
    """Return the mechanism that gives a stack the wanted dynamics within limits.

    `damping`: least damping ratio of all mechanical poles; the bandwidth is then the largest that
    it allows. `bandwidth` [Hz]: least -3 dB frequency of the mechanics; the damping is then the
    largest (up to 1). With both, both are demanded and the smallest mechanism is taken. `poles`
    [rad/s]: one or two pairs that the stack's poles shall come near to, in natural frequency and
    damping ratio. See `mechanism_loop` for `acts_on`.

    Raises InputError for goals or limits that make no sense; a goal out of reach is no error, the
    design then comes as near as the limits allow and `attained` is False.
    """
    wish, mechanics = Wish(damping, bandwidth, poles, limits, starts), mechanics_of(model, acts_on)
    searches = search(mechanics, wish)
    best = searches[0]
    if not best.converged:
        raise InputError(
            f"None of {len(searches)} searches for a mechanism ended well; the limits exclude each"
            " other, or the goals are far from what the stack can do: widen the limits."
        )
    agreeing = sum(c.converged and c.cost < best.cost + _SAME for c in searches)
    mounting, free = best.mounting, Mounting(0.0, 0.0, 0.0)
    reached, closed = _measured(mechanics, mounting), mechanical_poles(mechanics, mounting)
    goals, attained = [], True
    if damping is not None:
        goals.append(f"a damping ratio of {damping:g} or more")
        attained &= reached.damping >= damping * (1.0 - _REACHED)
    if bandwidth is not None:
        goals.append(f"a bandwidth of {bandwidth:g} Hz or more")
        attained &= reached.bandwidth >= bandwidth * (1.0 - _REACHED)
    if poles:
        goals.append("poles at " + ", ".join(f"{p:.5g}" for p in poles) + " rad/s")
        attained &= all(bool(np.abs(closed - p).min() < _NEAR * abs(p)) for p in poles)
    return MechanismDesign(
        mechanics, mounting, acts_on, tuple(goals), limits, poles=closed,
        free_poles=mechanical_poles(mechanics, free), lag_pole=-1.0 / mechanics.lag,
        reached=reached, free=_measured(mechanics, free), attained=attained,
        binding=_binding(mounting, reached, limits), agreeing=agreeing, starts=len(searches),
    )  # fmt: skip


def mechanism_model(design: MechanismDesign, name: str = "mechanism") -> Model:
    """Return the mechanism as a model that exports like any other; its notes say what it is for."""
    m = design.mounting
    notes = (
        f"Designed for {' and '.join(design.goals)}; acts on the {design.acts_on}.",
        f"Reached: damping ratio {design.reached.damping:.4g}, bandwidth of the mechanics"
        f" {design.reached.bandwidth:.5g} Hz, stroke loss {100 * design.reached.stroke_loss:.3g} %,"
        f" peak force {design.reached.peak_force:.4g} N.",
        f"The lag's pole at {design.lag_pole:.5g} rad/s stays where it is.",
    )
    values = {"m_m": m.mass, "c_m": m.damping, "k_m": m.stiffness}
    model = compose([prestress_mechanism], values, name=name, description="prestress mechanism")
    return model.with_values({}, provenance=Provenance(notes=notes))


def port_model(model: Model) -> Model:
    """Return a stack with the port for a mechanism's force and the motion of its tip."""
    return model.with_components((*model.plant().components, prestress_port))


def mounted_model(model: Model, design: MechanismDesign) -> Model:
    """Return a stack with its mechanism around it in one model; `mounted` = 0 is the free stack.

    Raises InputError where the mechanism acts on the tip and the stack has a load that does so too.
    """
    both = {c.name for c in model.components} & {"load_stiffness", "preload_loss"}
    if design.acts_on == "tip" and both:
        raise InputError(
            f"The mechanism and {' and '.join(sorted(both))} push on the same mass, which no model"
            " here solves for: take that effect out, or couple the two FMUs (--port)."
        )
    m = design.mounting
    plant, mount = model.plant(), PRESTRESS_MOUNTS[design.acts_on]
    whole = plant.with_components((*plant.components, mount))
    values = {"mounted": 1.0, "m_m": m.mass, "c_m": m.damping, "k_m": m.stiffness}
    notes = (f"With a prestress mechanism for {' and '.join(design.goals)}.",)
    return whole.with_values(values, provenance=Provenance(free=("m_m", "c_m", "k_m"), notes=notes))


def root_locus(design: MechanismDesign, gains: FloatArray) -> ComplexArray:
    """Return the mechanical poles (len(gains), order) with g H in place of H, as branches."""
    m = design.mounting
    rows: list[ComplexArray] = []
    for g in gains:
        mounting = Mounting(g * m.mass, g * m.damping, g * m.stiffness)
        poles = mechanical_poles(design.mechanics, mounting)
        if rows and len(poles) == len(rows[-1]):  # each next to the one it came from
            left = list(poles)
            nearest = [left.pop(int(np.argmin(np.abs(np.array(left) - b)))) for b in rows[-1]]
            poles = np.array(nearest)
        rows.append(poles)
    return np.array(rows)


def _measured(mechanics: Mechanics, mounting: Mounting) -> Reached:
    response = step_response(mechanics, mounting, response_times(mechanics, mounting, 8000))
    x = response.displacement
    final = (1.0 - stroke_loss(mechanics, mounting)) * mechanics.stroke
    return Reached(
        damping=float(damping_ratios(mechanical_poles(mechanics, mounting)).min()),
        bandwidth=bandwidth(mechanics, mounting),
        whole_bandwidth=bandwidth(mechanics, mounting, whole=True),
        stroke_loss=stroke_loss(mechanics, mounting),
        peak_force=float(np.abs(response.force).max()),
        overshoot=max(0.0, float(x.max()) / final - 1.0),
    )


def _binding(m: Mounting, r: Reached, limits: Limits) -> tuple[str, ...]:
    ends = (
        ("stroke loss", r.stroke_loss, limits.stroke_loss),
        ("force", r.peak_force, limits.force if limits.force is not None else inf),
        ("largest mass", m.mass, limits.mass[1]),
        ("largest damping", m.damping, limits.damping[1]),
    )
    names = [name for name, value, limit in ends if value > 0.99 * limit]
    if limits.mass[0] > 0.0 and m.mass < 1.01 * limits.mass[0]:
        names.append("least mass")
    return tuple(names)
