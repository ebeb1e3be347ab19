"""Hide an effect in a base simulation: draw it, scale it until it is as visible as wanted.

    visible ratio = rms(contribution - its least-squares fit by `base_directions`) / sigma

Directions: 1, base displacement, its rate, command, and the derivatives of the base displacement
with respect to R_s C_p, A, beta, gamma, n, delta and tau (central differences on a coarse grid).
The first four alone would call an effect visible that a re-fitted hysteresis absorbs.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq, least_squares

from tests.studies.plants.base import Run, simulate_base
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.stack import FloatArray, Stack
from tests.studies.plants.table import HIDDEN_EFFECTS

RATIO = (1.5, 4.0)
"""Visible ratio that is drawn."""
SEARCH = 12
"""Sub-intervals while a gain is searched; the record itself has the full number."""
WEAK = 0.02
"""If a ratio is demanded, gains go down to this share of the smallest that is plausible: a weaker
one is possible too.
"""

ATTEMPTS, ENOUGH = 4, 1.25
"""Base fits for an effect that asks for them, and the factor within which they stop."""

Visible = float | tuple[float, float]
"""A visible ratio, or a range from which it is drawn, uniform in its logarithm."""


@dataclass(frozen=True)
class Hidden:
    """One effect in a record.

    gain, parameters: those of the effect, SI. visible: rms of what the base cannot absorb over the
    noise's. gain_limited: the gain wanted was beyond the plausible range and was clipped (for
    an effect with `refit`: the ratio is off the wanted one by more than a quarter). added:
    what the effect adds to the displacement, (N,) [m].
    """

    effect: HiddenEffect
    gain: float
    parameters: Mapping[str, float]
    visible: float
    gain_limited: bool
    added: FloatArray


def effect_called(name: str) -> HiddenEffect:
    """The effect of that name."""
    if name not in HIDDEN_EFFECTS:
        raise KeyError(f"No hidden effect is called {name}; there are {sorted(HIDDEN_EFFECTS)}.")
    return HIDDEN_EFFECTS[name]


def hide(
    hidden: HiddenEffect,
    run: Run,
    rng: np.random.Generator,
    directions: FloatArray,
    noise_rms: float,
    visible: Visible | None,
    gain: float | None = None,
) -> Hidden:
    """Draw the effect and its gain. `visible` replaces a visible ratio drawn from RATIO, and a
    known `gain` the search for it.
    """
    parameters = hidden.draw(rng, run)
    if gain is not None:
        added = hidden.contribution(run, parameters, gain)
        value = visible_ratio(directions, added, noise_rms)
        return Hidden(hidden, gain, parameters, value, gain_limited=False, added=added)
    if isinstance(visible, tuple):
        low, high = visible
        wanted = math.exp(float(rng.uniform(math.log(low), math.log(high))))
    else:
        wanted = float(rng.uniform(*RATIO)) if visible is None else float(visible)
    weakest = hidden.plausible[0] * (1.0 if visible is None else WEAK)
    gains = (weakest, hidden.plausible[1])
    gain, limited = find_gain(hidden, run, parameters, directions, wanted * noise_rms, gains)
    refit = hidden.refit and gain > 0.0
    if refit:
        gain, reached = refit_gain(hidden, run, parameters, gain, wanted, noise_rms)
        limited = abs(math.log(reached / wanted)) > math.log(ENOUGH)
    added = hidden.contribution(run, parameters, gain)
    value = reached if refit else visible_ratio(directions, added, noise_rms)
    return Hidden(hidden, gain, parameters, value, limited, added)


def find_gain(
    hidden: HiddenEffect,
    run: Run,
    parameters: Mapping[str, float],
    directions: FloatArray,
    wanted: float,
    plausible: tuple[float, float],
) -> tuple[float, bool]:
    """Gain within `plausible` at which the part that the base cannot absorb has the rms `wanted`
    [m], and whether it was clipped.
    """
    if wanted <= 0.0:
        return 0.0, False

    trial = run if hidden.linear else simulate_base(run.stack, run.times, run.command, SEARCH)

    def excess(log_gain: float) -> float:
        added = hidden.contribution(trial, parameters, math.exp(log_gain))
        return math.log(max(visible_ratio(directions, added, wanted), 1e-9))

    low, high = (math.log(edge) for edge in plausible)
    if hidden.linear:
        log_gain = low - excess(low)
        return math.exp(min(max(log_gain, low), high)), not low <= log_gain <= high
    if excess(low) >= 0.0 or excess(high) <= 0.0:
        return math.exp(low if excess(low) >= 0.0 else high), True
    return math.exp(float(brentq(excess, low, high, xtol=0.02))), False


def refit_gain(
    hidden: HiddenEffect,
    run: Run,
    parameters: Mapping[str, float],
    gain: float,
    wanted: float,
    noise_rms: float,
) -> tuple[float, float]:
    """Gain near the visible ratio `wanted` of a base that is fitted again, and the ratio reached:
    the nearest of a few proportional corrections.
    """
    trial = simulate_base(run.stack, run.times, run.command, SEARCH)
    low, high = WEAK * hidden.plausible[0], hidden.plausible[1]
    tried: dict[float, float] = {}
    for _ in range(ATTEMPTS):
        added = hidden.contribution(trial, parameters, gain)
        reached = max(refitted_ratio(trial, added, noise_rms), 1e-9)
        tried[gain] = reached
        following = min(max(gain * wanted / reached, low), high)
        if max(reached / wanted, wanted / reached) < ENOUGH or following in tried:
            break
        gain = following
    best = min(tried, key=lambda one: abs(math.log(tried[one] / wanted)))
    return best, tried[best]


Effect = tuple[HiddenEffect, Parameters, float]
"""An effect with its secondary parameters and its gain, SI."""


def added_by(run: Run, effects: Sequence[Effect]) -> FloatArray:
    """What the effects add to the displacement of a run together, (N,) [m].

    Each acts on what those before it have left:

        command -> effects of the drive -> stack and its effects -> effects of the sensor

    A sum of what each adds to the base alone is no device where they are large: a lag or a delay
    that a base model takes over nearly as a whole may add forty times the noise, and two of them,
    summed, let a step begin the other way. Those of one place act in their order. Between
    the samples an effect of stack or sensor is a cubic spline.
    """
    total = np.zeros_like(run.times)
    order = sorted(effects, key=lambda e: (e[0].driven is None, e[0].of_sensor))
    for effect, parameters, gain in order:
        values = effect.contribution(run, parameters, gain)
        total = total + values
        if effect.driven is not None:
            run = run if gain == 0.0 else effect.driven(run, parameters, gain)
            continue
        between = CubicSpline(run.times, values)(run.path.time)
        run = replace(run, fine_displacement=run.fine_displacement + between)
    return total


COARSE_SUB_INTERVALS = 6
RELATIVE_STEP = 0.02
#: Largest change of a parameter in a fit, in its logarithm; residual of a loop that diverges.
_WIDEST, _DIVERGED = 12.0, 1e6
FREE = ("r_s", "a", "beta", "gamma", "n", "delta", "tau")


def base_directions(run: Run) -> FloatArray:
    """Orthonormal directions in which the base model can move, (N, 11)."""
    matrix = base_columns(run.stack, run.times, run.command, run.displacement)
    return np.asarray(np.linalg.qr(matrix / np.linalg.norm(matrix, axis=0))[0], dtype=np.float64)


def base_columns(
    stack: Stack, times: FloatArray, command: FloatArray, displacement: FloatArray
) -> FloatArray:
    """What moves the base's displacement (N,) [m], (N, 11): 1, it, its rate [m/s], the command [V],
    and the derivatives by the logarithms of FREE [m].
    """

    def moved(name: str, factor: float) -> FloatArray:
        changed: Stack = replace(stack, **{name: getattr(stack, name) * factor})
        return simulate_base(changed, times, command, COARSE_SUB_INTERVALS).displacement

    def derivative(name: str) -> FloatArray:
        step = RELATIVE_STEP / 2.0
        return (moved(name, 1.0 + step) - moved(name, 1.0 - step)) / RELATIVE_STEP

    rate = np.gradient(displacement, times)
    columns = [np.ones_like(displacement), displacement, rate, command]
    return np.column_stack([*columns, *(derivative(name) for name in FREE)])


def visible_ratio(directions: FloatArray, contribution: FloatArray, sigma: float) -> float:
    """Rms of what is left over the noise's sigma [1]."""
    left = contribution - directions @ (directions.T @ contribution)
    return math.sqrt(float(np.mean(left**2))) / sigma


def refitted_ratio(run: Run, contribution: FloatArray, sigma: float) -> float:
    """As `visible_ratio`, with the base fitted again instead of linearised: what a lag leaves once
    R_s C_p, tau and the dampings have taken over what they can. A few seconds; coarse grid.

    The dampings' lags, c_P/k_P and c_B/k_B, may be far below the sampling interval, where no
    slope leads out: a second fit frees them from half of it.
    """
    start = simulate_base(run.stack, run.times, run.command, COARSE_SUB_INTERVALS).displacement

    def rest(logs: FloatArray) -> FloatArray:
        # without the dampings' logarithms they stay as they are
        factors = dict(zip((*FREE, "k_l", "c_p", "c_b"), np.exp(logs).tolist(), strict=False))
        moved = {name: getattr(run.stack, name) * factor for name, factor in factors.items()}
        stack: Stack = replace(run.stack, **moved)
        try:
            fitted = simulate_base(stack, run.times, run.command, COARSE_SUB_INTERVALS).displacement
        except OverflowError:  # a loop that diverges explains nothing
            return np.full(run.times.size, _DIVERGED)
        left = (contribution + start - fitted) / sigma
        return np.asarray(left - left.mean(), dtype=np.float64)

    half = 0.5 * float(run.times[1] - run.times[0])
    lags = run.stack.c_p / run.stack.k_p, run.stack.c_b / run.stack.k_b
    plain = np.zeros(len(FREE) + 1)
    damped = np.concatenate([plain, np.clip(np.log(half / np.array(lags)), -_WIDEST, _WIDEST)])
    bounds = (-_WIDEST - 1.0, _WIDEST + 1.0)
    costs = [
        float(least_squares(rest, logs, bounds=bounds, diff_step=[1e-3], max_nfev=12).cost)
        for logs in (plain, damped)
    ]
    return math.sqrt(2.0 * min(costs) / run.times.size)
