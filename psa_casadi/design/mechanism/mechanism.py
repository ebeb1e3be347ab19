"""Design a prestress mechanism: mass, damping and stiffness for wanted dynamics (paper 5.2)."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, isfinite

import numpy as np

from psa_casadi.components.surroundings import PRESTRESS_MECHANISM, PRESTRESS_MOUNTS, PRESTRESS_PORT
from psa_casadi.design.mechanism.loop import (
    Mechanics,
    Mounting,
    bandwidth,
    damping_ratios,
    mechanical_poles,
    mechanics_of,
    response_times,
    step_response,
    stroke_loss,
)
from psa_casadi.design.mechanism.search import Limits, Wish, search
from psa_casadi.errors import InputError, Problems
from psa_casadi.model.compose import Model, compose
from psa_casadi.units import ComplexArray, FloatArray
from psa_casadi.variables import Provenance


def check_goals(
    damping: float | None, width: float | None, poles: Sequence[complex], limits: Limits,
    starts: int,
) -> None:  # fmt: skip
    """Raise an InputError that names every goal and limit that makes no sense."""
    problems = Problems()
    if poles and (damping is not None or width is not None):
        problems.add(
            "Poles are wanted together with a damping or a bandwidth; leave one of them out."
        )
    if not poles and damping is None and width is None:
        problems.add("Nothing is wanted; give a damping ratio, a bandwidth in Hz, or poles.")
    if damping is not None and not 0.0 < damping <= 1.0:
        problems.add(f"The damping ratio {damping:g} is not in (0, 1]; 0.7 is usual.")
    if width is not None and not 0.0 < width < inf:
        problems.add(f"The bandwidth {width:g} Hz is not positive; give it in Hz.")
    _check_poles(poles, problems)
    _check_limits(limits, problems)
    if starts < 1:
        problems.add(f"{starts} starts find nothing; give 1 or more.")
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
    check_goals(damping, bandwidth, poles, limits, starts)
    mechanics = mechanics_of(model, acts_on)
    searches = search(mechanics, Wish(damping, bandwidth, tuple(poles), limits), starts)
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
    model = compose([PRESTRESS_MECHANISM], values, name=name, description="prestress mechanism")
    return model.with_values({}, provenance=Provenance(notes=notes))


def port_model(model: Model) -> Model:
    """Return a stack with the port for a mechanism's force and the motion of its tip."""
    return model.with_components((*model.plant().components, PRESTRESS_PORT))


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
