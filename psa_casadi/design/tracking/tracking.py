"""The voltage that makes a stack's displacement follow a path within the amplifier's limits.

Direct collocation on the smooth form of the model, solved by IPOPT from the inverted model's
voltage; then the full simulator is run, and what it shows beside the program's own discretisation
is taken off the path before the program is solved once more.
"""

import time as clocks
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy

from psa_casadi.design.tracking.collocation import (
    interval_of,
    nodes_of,
    simulated_displacement,
    simulated_states,
)
from psa_casadi.design.tracking.inversion import InvertedInput, invert
from psa_casadi.design.tracking.program import NoSolutionError, Problem, Program, Solution
from psa_casadi.design.tracking.targets import (
    AmplifierLimits,
    Dynamics,
    Response,
    Target,
    TrackingError,
    broken,
    demand_stack,
    dynamics_of,
    error_of,
    respond,
    rest_at,
    smooth_form,
)
from psa_casadi.errors import InputError, PsaError
from psa_casadi.model.compose import Model
from psa_casadi.units import FloatArray

#: Rounding of the kinks at u' = 0, over the largest voltage rate of the inverted model.
WIDTH = 0.02
#: Solutions after the first, each with the discretisation's error taken off the path.
CORRECTIONS = 2
#: A solution that IPOPT did not finish must leave less than this share of the inversion's error.
_WORTH = 0.8


@dataclass(frozen=True, eq=False)
class TrackedInput:
    """A designed voltage and what became of it.

    `response` and `error` are the full simulator's; `predicted` (n,) [m] is what the program itself
    expected at the path's instants. Without `by_program` the answer is the inversion cut by the
    limits, because the program found none, or none that is better. `width` [V/s] is the rounding of
    the smooth form, `inverse` the inversion without limits, `iterations` IPOPT's, `seconds` the
    time it all took.
    """

    target: Target
    limits: AmplifierLimits
    minimax: bool
    response: Response
    error: TrackingError
    predicted: FloatArray
    by_program: bool
    converged: bool
    width: float
    inverse: InvertedInput
    iterations: int
    seconds: float

    @property
    def voltage(self) -> FloatArray:
        """The designed voltage (n,) [V] at the path's instants, linear in between."""
        return self.response.voltage


def track(
    model: Model,
    target: Target,
    limits: AmplifierLimits | None = None,
    *,
    minimax: bool = False,
    corrections: int = CORRECTIONS,
    equations: Callable[[Model], Dynamics] | None = None,
    progress: Callable[[str], None] = lambda step: None,
) -> TrackedInput:
    """Return the voltage for a path: least mean square error, or least largest with `minimax`.

    The stack rests where the path starts, and its voltage stays at rest over the first interval.
    `equations` gives the equations of the smooth form if they come from elsewhere (an imported
    FMU); those of the model are used by default. The best of the solutions, by the full simulator's
    error, is returned.

    Raises InputError for a model that is no stack, limits that contradict each other or the path's
    start, and PsaError if no voltage within the limits is found.
    """
    begun = clocks.perf_counter()
    bounds = limits or AmplifierLimits()
    rest, start = _rest(model, target, bounds)
    progress("inversion")
    inverse = invert(model, target)
    cut = inverse if bounds == AmplifierLimits() else invert(model, target, bounds)
    guess = cut.response.voltage.copy()
    guess[:2] = rest
    width = rounding(target, inverse.response.voltage)
    smooth = smooth_form(model, width)
    interval = interval_of((equations or dynamics_of)(smooth), symbolic=equations is None)
    problem = Problem(
        interval, target.time, target.span, rest, float(np.ptp(inverse.response.voltage)),
        start / interval.nominal, bounds, minimax, symbolic=equations is None,
    )  # fmt: skip
    solutions = _solve(model, smooth, target, problem, guess, corrections, progress)
    designed = _chosen(model, target, bounds, minimax, solutions, cut)
    return TrackedInput(
        target, bounds, minimax, *designed, width, inverse,
        sum(s.iterations for _, s in solutions), clocks.perf_counter() - begun,
    )  # fmt: skip


def _chosen(
    model: Model, target: Target, limits: AmplifierLimits, minimax: bool,
    solutions: list[tuple[float, Solution]], cut: InvertedInput,
) -> tuple[Response, TrackingError, FloatArray, bool, bool]:  # fmt: skip
    """Return the best answer: response, error, what was predicted, by the program, converged.

    The inversion cut by the limits is the answer where no solution is better; it predicts what the
    simulator shows. Raises PsaError if there is no solution and a limit that cuts break.
    """
    if solutions:
        _, best = min(solutions, key=lambda s: s[0])
        response = respond(model, target.time, best.voltage)
        error = error_of(target, response.displacement)
        share = 1.0 if best.converged else _WORTH
        better = (
            error.largest <= share * cut.error.largest
            if minimax
            else error.rms <= share * cut.error.rms
        )
        if better or broken(cut.response, limits):
            predicted = np.concatenate([target.displacement[:1], best.displacement[1]])
            return response, error, predicted, True, best.converged
    elif broken(cut.response, limits):
        raise PsaError(
            "No voltage within the limits was found that comes near the path; widen the limits or"
            " slow the path down."
        )
    return cut.response, cut.error, cut.response.displacement, False, False


def rounding(target: Target, voltage: FloatArray) -> float:
    """Return the width of the smooth form [V/s], small against the rates that the path needs."""
    return WIDTH * float(np.max(np.abs(np.diff(voltage) / np.diff(target.time))))


def _rest(model: Model, target: Target, limits: AmplifierLimits) -> tuple[float, FloatArray]:
    """Return voltage and state before the path; the limits must allow that voltage."""
    demand_stack(model)
    rest, start = rest_at(model, float(target.displacement[0]))
    room = 1e-9 * model.values.get("u_rated", 1.0)
    if not limits.min_voltage - room <= rest <= limits.max_voltage + room:
        raise InputError(
            f"The path starts at {1e6 * target.displacement[0]:.4g} um, where the stack rests at"
            f" {rest:.4g} V, outside the voltage limits; widen them or move the path."
        )
    return float(np.clip(rest, limits.min_voltage, limits.max_voltage)), start


def _solve(
    model: Model, smooth: Model, target: Target, problem: Problem, guess: FloatArray,
    corrections: int, progress: Callable[[str], None],
) -> list[tuple[float, Solution]]:  # fmt: skip
    """Return every solution with its error by the full simulator [m], rms or largest.

    There are fewer, or none, where IPOPT finds no further one.
    """
    nodes = nodes_of(target.time)
    path = np.asarray(scipy.interpolate.PchipInterpolator(target.time, target.displacement)(nodes))
    start = problem.start * problem.interval.nominal
    program, shown = Program(problem), path
    inner = simulated_states(smooth, nodes, target.time, guess, start)
    solutions: list[tuple[float, Solution]] = []
    for count in range(corrections + 1):
        progress(f"solution {count + 1} of {corrections + 1}")
        try:
            found = program.solve(shown, guess, inner)
        except NoSolutionError:
            break
        reached = simulated_displacement(model, nodes, target.time, found.voltage, start)
        solutions.append((_size(reached - path, problem.minimax), found))
        guess, inner = found.voltage, found.inner
        shown = path - (reached - found.displacement)
    return solutions


def _size(error: FloatArray, largest: bool) -> float:
    return float(np.max(np.abs(error)) if largest else np.sqrt(np.mean(error**2)))
