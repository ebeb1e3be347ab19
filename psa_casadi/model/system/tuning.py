"""A position controller tuned to a plant: the largest integral gain that keeps the margins.

The plant is linearised at its start and discretised exactly behind the controller's anti-aliasing
filter, with the command held for a period. For each notch and each ratio of proportional to
integral gain the loop is K L_0(z); the largest K with |1 + K L_0| >= 1/M at all frequencies follows
in closed form. It keeps the loop stable, since the curve has not met -1 on the way from K = 0. The
search takes the largest integral gain (Astrom, Panagopoulos and Hagglund, Automatica 34 (1998)
585-601), with the notch at its frequency and beside it by a tolerance, since no resonance stays
where it is.
"""

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import numpy.typing as npt

from psa_casadi.errors import Problems
from psa_casadi.model.compose import Model
from psa_casadi.model.parts import part_model
from psa_casadi.model.system.sampled_loop import (
    PlantResponse,
    controller_response,
    notch_response,
    plant_response,
)

__all__ = ["Margins", "controller_for", "margins_of"]

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

_WIDTHS = (0.2, 0.35, 0.5, 0.7, 1.0)
_FLOORS = (0.02, 0.05, 0.1, 0.2, 0.35)
#: Trial ratios of proportional to integral gain, in periods.
_RATIOS = np.concatenate([[0.0], np.geomspace(0.1, 300.0, 50)])


@dataclass(frozen=True)
class Margins:
    """How far a sampled loop is from instability, and how fast it is.

    `sensitivity` is the largest |1/(1 + L)|, `modulus` its inverse; `gain` is the factor on the
    loop gain that makes it unstable, `phase` [rad] the lag that does; `crossover` [Hz] is where |L|
    last falls below 1, `bandwidth` [Hz] where the response to a load disturbance, |1/(1 + L)|,
    first reaches 1/sqrt(2); `resonance` [Hz] is the mode that the notch is for, 0 without one.
    """

    sensitivity: float
    modulus: float
    gain: float
    phase: float
    crossover: float
    bandwidth: float
    resonance: float


def controller_for(
    plant: Model,
    *,
    position: str | None = None,
    sample_time: float = 5e-5,
    sensitivity: float = 1.6,
    resonance_tolerance: float = 0.1,
    lowest_command: float = -2.0,
    highest_command: float = 12.0,
    feed_forward: bool = True,
) -> Model:
    """Return a position controller for a plant from one command [V] to a position [m].

    `position` is the output that is fed back, by default the plant's only one.
    `sensitivity` is the largest |1/(1 + L)| allowed, also with the resonance off by the share
    `resonance_tolerance`. The corner of the anti-aliasing filter is the Nyquist frequency. With
    `feed_forward` the reference over the plant's gain at rest is part of the command. The margins
    are in the model's notes; `margins_of` gives them as numbers.

    Raises InputError for a plant with more than one input, with sampled states or without that
    output, one that is unstable or has no gain, and values out of range.
    """
    _check(plant, position, sample_time, sensitivity, resonance_tolerance)
    lag = sample_time / np.pi
    response = plant_response(plant, position, sample_time, lag)
    rest = float(response.response[0].real)
    found = _search(response, np.sign(rest), sensitivity, resonance_tolerance)
    model = part_model(
        "position_controller",
        **found,
        sample_time=sample_time,
        filter_time=lag,
        feed_forward=1.0 / rest if feed_forward else 0.0,
        lowest_command=lowest_command,
        highest_command=highest_command,
    )
    margins = margins_of(plant, model, position)
    note = (
        f"Tuned to {plant.name}: largest sensitivity {margins.sensitivity:.3g}, gain margin"
        f" {margins.gain:.3g}, phase margin {np.degrees(margins.phase):.3g} deg, crossover"
        f" {margins.crossover:.4g} Hz."
    )
    return model.with_values({}, provenance=replace(model.provenance, notes=(note,)))


def margins_of(plant: Model, controller: Model, position: str | None = None) -> Margins:
    """Return the margins of a plant, linearised at its start, in the loop with a controller."""
    p = controller.values
    response = plant_response(plant, position, p["sample_time"], p["filter_time"])
    loop = response.response * controller_response(p, response.z)
    modulus = float(np.min(np.abs(1.0 + loop)))
    size, angle = np.abs(loop), np.unwrap(np.angle(loop))
    falling = np.flatnonzero((size[:-1] >= 1.0) & (size[1:] < 1.0))
    crossover = float(response.frequencies[falling[-1]]) if falling.size else 0.0
    slow = np.flatnonzero(np.abs(1.0 + loop) < np.sqrt(2.0))
    lag = np.min(np.pi + angle[falling]) if falling.size else np.inf
    mode = response.resonance()
    return Margins(
        sensitivity=1.0 / modulus,
        modulus=modulus,
        gain=_gain_margin(loop),
        phase=float(lag),
        crossover=crossover,
        bandwidth=float(response.frequencies[slow[0]]) if slow.size else np.inf,
        resonance=mode[0] if mode else 0.0,
    )


def _gain_margin(loop: ComplexArray) -> float:
    """Return the smallest factor above 1 on the loop gain that puts the curve through -1."""
    im = loop.imag
    at = np.flatnonzero(im[:-1] * im[1:] <= 0.0)
    share = im[at] / np.where(im[at] == im[at + 1], 1.0, im[at] - im[at + 1])
    real = loop.real[at] + share * (loop.real[at + 1] - loop.real[at])
    crossings = -real[(real < 0.0) & (real > -1.0)]
    return float(1.0 / np.max(crossings)) if crossings.size else np.inf


def _check(
    plant: Model, position: str | None, period: float, sensitivity: float, tolerance: float
) -> None:
    problems = Problems()
    if len(plant.input_names) != 1 or plant.structure.sampled:
        problems.add(
            f"The plant '{plant.name}' has the inputs {plant.input_names} and the sampled states"
            f" {plant.sampled_names}; give one with one input, the command, and none sampled."
        )
    if position not in plant.output_names and (position or len(plant.output_names) != 1):
        problems.add(
            f"The position is '{position}' but the outputs of '{plant.name}' are"
            f" {plant.output_names}; name one of them."
        )
    if not 0.0 < period < 10.0:
        problems.add(f"sample_time is {period:g} s; give a positive period such as 5e-5.")
    if not 1.0 < sensitivity <= 4.0:
        problems.add(f"sensitivity is {sensitivity:g}; choose from 1.2 to 2, at most 4.")
    if not 0.0 <= tolerance < 0.5:
        problems.add(f"resonance_tolerance is {tolerance:g}; give a share from 0 to 0.5.")
    problems.raise_if_any()


def _search(
    plant: PlantResponse, sign: float, sensitivity: float, tolerance: float
) -> dict[str, float]:
    """Return the values of the controller with the largest integral gain."""
    z, period = plant.z, plant.period
    mode = plant.resonance()
    frequency = mode[0] if mode else 0.25 / period
    shapes = [(0.5, 0.5)]
    if mode:
        shapes += [(f, w) for f, w in product(_FLOORS, _WIDTHS) if f < w]
    best, found = 0.0, (0.5, 0.5, 0.0)
    for floor, width in shapes:
        beside = (1.0 - tolerance, 1.0, 1.0 + tolerance) if floor != width else (1.0,)
        notches = np.array([notch_response(z, period, frequency * b, floor, width) for b in beside])
        base = sign * plant.response * notches
        for ratio in _RATIOS * period:
            loop = base * (ratio + 0.5 * period * (z + 1.0) / (z - 1.0))
            gain = _largest_gain(loop, 1.0 / sensitivity)
            if gain > best:
                best, found = gain, (floor, width, ratio)
    floor, width, ratio = found
    return {
        "notch_frequency": frequency,
        "notch_floor": floor,
        "notch_width": width,
        "integral_gain": sign * best,
        "proportional_gain": sign * best * ratio,
    }


def _largest_gain(loop: ComplexArray, distance: float) -> float:
    """Return the largest K up to which |1 + K L| >= distance everywhere, 0 if there is no limit.

    The smallest root of |L|^2 K^2 + 2 Re(L) K + 1 - distance^2 = 0 where it has positive ones.
    """
    square, rest = np.abs(loop) ** 2, 1.0 - distance**2
    inside = loop.real**2 - square * rest
    met = (loop.real < 0.0) & (inside >= 0.0)
    if not met.any():
        return 0.0
    # the smaller root in the form that does not cancel
    return float(np.min(rest / (np.sqrt(inside[met]) - loop.real[met])))
